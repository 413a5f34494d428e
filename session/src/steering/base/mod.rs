//! The base of a steered robot: its configuration, and what the devices of the run report about the
//! robot (`robot_watch.rs`).

#[cfg(test)]
mod base_loop_tests;
mod footprint;
mod pose_tracker;
mod robot_watch;

pub(super) use robot_watch::{RobotWatch, SeenRobot};

use super::robot::ChainAndBody;
use capture::config::{ArmDriver, BaseMotion, Rig};
use capture::open::{self, SteeredBase};
use clearance_map::MapBase;
use kinematics::Chain;
use steering::{BaseClearanceConfig, BaseSteeringConfig, Stowed};
use viz::{BaseAvoidance, BaseDescription};

/// Margin of swept space in simulations, meters. Their tours keep this distance from the scene.
const SIMULATED_MARGIN_M: f64 = 0.15;

/// The base of a robot, before its input is read.
pub(super) struct PreparedBase {
    pub(super) base: SteeredBase,
    pub(super) config: BaseSteeringConfig,
    /// The base in the map of free space; `None` if its footprint is not known.
    pub(super) in_map: Option<MapBase>,
    pub(super) joint_offsets: Vec<f64>,
}

impl PreparedBase {
    /// Prepares the base of a rig for its operators.
    ///
    /// * `robot`: the robot description, if the rig has one with shapes.
    /// * `is_arm_steered`: whether operators also move the arm on it.
    ///
    /// # Errors
    ///
    /// If the footprint is not valid, or not known although the base must avoid what it does not
    /// know.
    pub(super) fn new(
        base: SteeredBase,
        rig: &Rig,
        robot: Option<&ChainAndBody>,
        is_arm_steered: bool,
    ) -> anyhow::Result<Self> {
        let motion = rig.base.motion.clone().unwrap_or_default();
        let stowed = stowed(rig, &motion, robot.filter(|_| is_arm_steered))?;
        let in_map = footprint::of(rig, &motion, robot)?.map(|footprint| MapBase {
            footprint,
            is_unseen_free: motion.allow_unseen,
            swept_margin_m: if open::is_any_simulated(rig) {
                motion.swept_margin_m.max(SIMULATED_MARGIN_M)
            } else {
                motion.swept_margin_m
            },
        });
        let clearance = in_map.as_ref().map(|base| BaseClearanceConfig {
            is_unseen_free: base.is_unseen_free,
            ..BaseClearanceConfig::new(base.footprint.clone())
        });
        Ok(Self {
            config: BaseSteeringConfig {
                area_m: motion.area_m,
                stowed,
                clearance,
                ..BaseSteeringConfig::new(*base.port().limits())
            },
            base,
            in_map,
            joint_offsets: rig.arm.joint_offsets.clone(),
        })
    }

    /// What clients need to know.
    pub(super) fn description(&self) -> BaseDescription {
        let limits = &self.config.limits;
        BaseDescription {
            max_forward_m_s: limits.max_forward_m_s,
            max_left_m_s: limits.max_left_m_s,
            max_yaw_rad_s: limits.max_yaw_rad_s,
            area_m: self.config.area_m,
            avoidance: match &self.in_map {
                None => BaseAvoidance::Nothing,
                Some(base) if base.is_unseen_free => BaseAvoidance::SeenSurfaces,
                Some(_) => BaseAvoidance::UnknownSpace,
            },
            stowed: self.config.stowed.as_ref().map(|it| it.position.clone()),
        }
    }

    /// Passes the newest reports of the devices on.
    pub(super) fn report_to(&self, watch: &RobotWatch) {
        if let Some(pose) = self.base.reported_pose() {
            watch.report_pose(pose.stamp, pose.world_from_base);
        }
        if let Some(joints) = self.base.reported_joints() {
            watch.report_joints(&joints, &self.joint_offsets);
        }
    }
}

/// Where the arm must be while the base moves, in the order of the chain if operators move the arm,
/// too.
fn stowed(
    rig: &Rig,
    motion: &BaseMotion,
    steered: Option<&ChainAndBody>,
) -> anyhow::Result<Option<Stowed>> {
    let has_arm = rig.arm.driver != ArmDriver::None && !rig.arm.joints.is_empty();
    if !has_arm {
        return Ok(None);
    }
    let (joints, position) = match steered {
        None => (rig.arm.joints.clone(), motion.stowed.clone()),
        Some(robot) => (
            robot.chain.joint_names().to_vec(),
            in_chain(&robot.chain, rig, &motion.stowed)?,
        ),
    };
    Ok(Some(Stowed {
        joints,
        position,
        tolerance: motion.stowed_tolerance,
    }))
}

/// Positions in the order of a chain.
fn in_chain(chain: &Chain, rig: &Rig, positions: &[f64]) -> anyhow::Result<Vec<f64>> {
    let order = chain.order_in(&rig.arm.joints)?;
    let at = |ix: &usize| positions.get(*ix).copied();
    Ok(order.iter().filter_map(at).collect())
}
