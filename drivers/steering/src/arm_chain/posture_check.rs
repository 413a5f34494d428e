//! Whether the arm could rest at a posture, for previews of goals.

use super::ArmChain;
use crate::capsule::Capsule;
use crate::clearance::{Clearance, Restriction};
use crate::reason::{Limit, Link, refused};
use kinematics::Stamp;

impl ArmChain {
    /// Checks a posture with the links that depend on it: limits, self-collision and clearance. It
    /// changes nothing, and says nothing about the way to the posture.
    ///
    /// * `q`: joint values in the order of the chain.
    /// * `scene`: what is known about the scene.
    ///
    /// # Errors
    /// The first limit that would refuse the posture.
    pub(crate) fn check_posture(
        &self,
        now: Stamp,
        q: &[f64],
        scene: &dyn Clearance,
    ) -> Result<(), Limit> {
        if let Some(reason) = self.limits.outside(&self.chain, q) {
            return Err(refused(Link::Limits, reason));
        }
        let capsules: Vec<Capsule> = self.body.capsules(q);
        let close_pairs = self.self_collision.close_pairs(&capsules);
        if let Some(reason) = self.self_collision.refusal(&[], &close_pairs, &self.body) {
            return Err(refused(Link::SelfCollision, reason));
        }
        let points_in_base = self.clearance.in_base(&capsules);
        let readings = scene.readings(&points_in_base, now);
        let there: Vec<Restriction> = self.clearance.restrictions(&readings);
        match self
            .clearance
            .refusal(&[], &there, &points_in_base, &self.body)
        {
            Some(reason) => Err(refused(Link::Clearance, reason)),
            None => Ok(()),
        }
    }
}
