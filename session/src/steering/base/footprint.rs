//! The space that a base occupies, from the rig file or from the shapes of its robot.

use super::in_chain;
use crate::steering::robot::ChainAndBody;
use anyhow::Context;
use capture::config::{BaseMotion, Rig};
use messages::BadInput;
use steering::Footprint;

/// Height of the lowest part of a robot that is not compared with the map, meters: it touches the
/// floor, whose readings have noise.
const FLOOR_MARGIN_M: f64 = 0.1;
/// Heights of a footprint that is given without heights for a robot without shapes, meters.
const DEFAULT_HEIGHT_M: [f64; 2] = [0.1, 0.5];

/// The footprint of the base of a rig; `None` if it is not known and the base may enter space that
/// nothing has seen.
///
/// # Errors
///
/// If the footprint is not valid, or must be known.
pub(super) fn of(
    rig: &Rig,
    motion: &BaseMotion,
    robot: Option<&ChainAndBody>,
) -> anyhow::Result<Option<Footprint>> {
    let capsules = robot
        .map(|robot| posture(rig, motion, robot).map(|q| robot.body.capsules(&q)))
        .transpose()?;
    let whole = capsules
        .as_ref()
        .and_then(|it| Footprint::of_robot(it, motion.footprint_height_m, FLOOR_MARGIN_M).ok());
    let height_m = motion
        .footprint_height_m
        .or_else(|| whole.as_ref().map(Footprint::height_m))
        .unwrap_or(DEFAULT_HEIGHT_M);
    let corners = motion.footprint_corners_m();
    if !corners.is_empty() {
        let footprint = Footprint::of_points(&corners, height_m);
        return footprint.context("base.motion.footprint_m").map(Some);
    }
    if let Some(radius_m) = motion.footprint_radius_m {
        let footprint = Footprint::circle(radius_m, height_m);
        return footprint
            .context("base.motion.footprint_radius_m")
            .map(Some);
    }
    if whole.is_none() && !motion.allow_unseen {
        return Err(BadInput(
            "the base cannot be driven, because its size is unknown: set \
             base.motion.footprint_radius_m or footprint_m, or base.motion.allow_unseen = true for a \
             base that its operator alone keeps away from obstacles"
                .to_owned(),
        )
        .into());
    }
    Ok(whole)
}

/// The posture while the base moves, in the order of the chain: stowed, or anything without a
/// stowed posture, because there are then no joints.
fn posture(rig: &Rig, motion: &BaseMotion, robot: &ChainAndBody) -> anyhow::Result<Vec<f64>> {
    if motion.stowed.is_empty() {
        return Ok(vec![0.0; robot.chain.n_joints()]);
    }
    in_chain(&robot.chain, rig, &motion.stowed)
}
