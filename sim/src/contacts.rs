//! Counts how often the robot touches the scene, in a separate model.
//!
//! The model of the images has no contacts: its meshes are not convex, and an arm that could be
//! blocked would not follow its tour. In this model, the scene consists of convex pieces. The robot
//! passes through them, and MuJoCo reports where it does.

use crate::render::set_base_pose;
use crate::robot::RobotPose;
use mujoco_rs::prelude::{MjData, MjModel};
use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Counts the contacts of a robot with its scene.
pub(crate) struct ContactCounter {
    data: MjData<Arc<MjModel>>,
    /// Pairs of bodies that touch at the first check, such as a robot and its pedestal. They are
    /// not counted. `None` before the first check.
    always: Option<BTreeSet<[i32; 2]>>,
    /// Pairs that touched at the last check.
    touching: BTreeSet<[i32; 2]>,
    n_contacts: Arc<AtomicU64>,
}

impl ContactCounter {
    /// * `model`: built by [`crate::scene::build_contacts`].
    pub(crate) fn new(model: MjModel) -> Self {
        Self {
            data: MjData::new(Arc::new(model)),
            always: None,
            touching: BTreeSet::new(),
            n_contacts: Arc::default(),
        }
    }

    /// How often a part of the robot has begun to touch an object.
    pub(crate) fn n_contacts(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.n_contacts)
    }

    /// Checks where the robot touches the scene now.
    pub(crate) fn check(&mut self, robot: &RobotPose) {
        let touching = self.touching(robot);
        let Some(always) = &self.always else {
            self.always = Some(touching);
            return;
        };
        let is_new = |pair: &&[i32; 2]| !self.touching.contains(*pair) && !always.contains(*pair);
        let n_new = touching.iter().filter(is_new).count() as u64;
        self.n_contacts.fetch_add(n_new, Ordering::Relaxed);
        self.touching = touching;
    }

    /// The pairs of bodies that touch.
    fn touching(&mut self, robot: &RobotPose) -> BTreeSet<[i32; 2]> {
        set_base_pose(&mut self.data, &robot.world_from_base);
        if !robot.model_positions.is_empty() {
            self.data.qpos_mut().copy_from_slice(&robot.model_positions);
        }
        self.data.forward_kinematics();
        self.data.collision();
        let bodies = self.data.model().geom_bodyid();
        let contacts = self.data.contact().iter();
        contacts
            .filter(|contact| contact.dist < 0.0)
            .filter_map(|contact| {
                let body = |geom: i32| bodies.get(usize::try_from(geom).ok()?).copied();
                let [a, b] = contact.geom;
                Some([body(a)?, body(b)?])
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::objects::{TABLE_Z_M, TARGET_XY_M};
    use crate::panda;
    use crate::scene;
    use kinematics::Transform;
    use kinematics::inverse::{InverseSolver, Target};
    use nalgebra::Vector3;

    /// The arm with its flange above the table, pointing down.
    fn above_table(height_m: f64) -> RobotPose {
        let chain = kinematics::Chain::from_urdf(crate::PANDA_URDF, "panda_link0", "panda_link8")
            .expect("valid");
        let down =
            nalgebra::UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        let [x, y] = [TARGET_XY_M[0] - 0.15, TARGET_XY_M[1] - 0.2];
        let place = nalgebra::Translation3::new(x, y, TABLE_Z_M + height_m);
        let target = Target::pose(Transform::from_parts(place, down));
        let mut solver = InverseSolver::new(chain).expect("a chain with joints");
        let start = [0.0, -0.3, 0.0, -2.2, 0.0, 2.2, 0.8];
        let joints = solver.solve(&target, &start).expect("within reach");
        RobotPose {
            world_from_base: Transform::identity(),
            world_from_flange: panda::base_from_flange(&panda::Joints::from_column_slice(&joints)),
            model_positions: joints,
        }
    }

    #[test]
    fn a_flange_in_the_table_is_counted_once_until_it_leaves() {
        let config = Config {
            cameras: Vec::new(),
            ..Config::default()
        };
        let model = scene::build_contacts(&config, None).expect("the scene is valid");
        let mut counter = ContactCounter::new(model);
        let n_contacts = counter.n_contacts();
        let [above, inside] = [above_table(0.15), above_table(-0.002)];
        counter.check(&above);
        counter.check(&above);
        assert_eq!(n_contacts.load(Ordering::Relaxed), 0);
        counter.check(&inside);
        let first = n_contacts.load(Ordering::Relaxed);
        assert!(first > 0, "the flange is in the table");
        counter.check(&inside);
        assert_eq!(
            n_contacts.load(Ordering::Relaxed),
            first,
            "it is still there"
        );
        counter.check(&above);
        counter.check(&inside);
        assert_eq!(n_contacts.load(Ordering::Relaxed), 2 * first);
    }
}
