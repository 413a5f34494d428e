//! Camera poses and velocities at a stamp, and the resulting image motion.

use super::base_corrections::{Corrections, JumpRemoval};
use super::station_detector::StationDetector;
use crate::config::{self, BaseDriver, Parent, Rig};
use anyhow::Context;
use drivers::BasePose;
use keyframe::BaseState;
use kinematics::urdf::JointLimits;
use kinematics::{
    Chain, HistoryError, Intrinsics, JointHistory, JointState, PoseHistory, Stamp, Transform, Twist,
};
use nalgebra::Vector3;
use std::f64::consts::TAU;
use std::sync::Arc;
use std::time::Duration;

/// Maximum number of readings kept. At 1 kHz, they cover 20 s, which is longer than any image
/// waits.
const MAX_READINGS: usize = 20_000;
/// Tolerance for joint positions beyond the limits, radians or meters. Calibration errors and soft
/// stops stay within it.
const MAX_LIMIT_EXCESS: f64 = 0.2;
/// Joint states that imply a joint speed above this multiple of the speed limit are ignored. They
/// are assumed to be states of another arm. The margin allows for an arm that is pushed, and for a
/// URDF with reduced limits. With a smaller value, the states of such arms would be ignored. With a
/// larger value, states of a second arm would be accepted if they happen to be close.
const MAX_SPEED_FACTOR: f64 = 3.0;
/// Time that is added to the time between two readings, because their stamps may be inaccurate. At
/// 1 kHz, two readings whose stamps are too close would otherwise seem to move at many times their
/// speed.
const MAX_STAMP_ERROR_SECS: f64 = 0.02;
/// If this many consecutive ignored states agree with each other, they are accepted. With a smaller
/// number, states of another arm that arrive between ours would be accepted. With a larger number,
/// longer parts of the motion would be lost after a real jump, for example after a pause of the
/// sender.
const MIN_CONSISTENT: u32 = 5;
/// Maximum gap for interpolating base poses from tags, in image periods. With this value, one image
/// in between may lack a pose.
const MAX_IMAGE_INTERVALS: f64 = 2.5;

/// The recent motion of the robot.
pub(crate) struct Motion {
    chain: Chain,
    /// Index of each chain joint in the readings.
    order: Vec<usize>,
    /// Offset added to the reading of each chain joint.
    offsets: Vec<f64>,
    joints: JointHistory,
    /// The last joint state that was ignored because of its speed, and how many such states in a
    /// row agree.
    ignored: Option<(JointState, u32)>,
    base: BaseMotion,
}

/// Distance that a joint moved. A joint without limits may report angles that wrap around.
fn distance(from: f64, to: f64, limits: &JointLimits) -> f64 {
    let moved = to - from;
    let n_turns = if limits.lower.is_finite() {
        0.0
    } else {
        // A continuous joint may report its angle modulo a full turn. The nearest number of full
        // turns is therefore subtracted.
        (moved / TAU).round()
    };
    (moved - n_turns * TAU).abs()
}

/// Why a joint reading was ignored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum JointsRejection {
    /// It is out of order or not finite, or has the wrong number of joints.
    Invalid,
    /// A joint moved faster than possible; the text names the joint.
    TooFast(String),
}

/// The pose of the base.
enum BaseMotion {
    Fixed(Transform),
    ReportedPoses(Box<ReportedPoses>),
}

/// Poses of a moving base.
struct ReportedPoses {
    poses: PoseHistory,
    /// Corrections for the drift of these poses.
    corrections: Corrections,
    /// `None` if jumps are kept, because nothing corrects these poses.
    jump_removal: Option<JumpRemoval>,
    station_detector: StationDetector,
    /// Ground truth poses from a simulator.
    truth: PoseHistory,
}

/// Whether range scans correct the poses of a rig's base.
pub(super) fn corrects_base(rig: &Rig) -> bool {
    rig.base.driver != BaseDriver::Fixed && rig.base.realign && !rig.scanners.is_empty()
}

impl ReportedPoses {
    /// The corrected pose at a stamp.
    fn at(&self, stamp: Stamp) -> Result<Transform, HistoryError> {
        Ok(self.corrections.at(stamp) * self.poses.at(stamp)?)
    }
}

/// A camera's pose and velocity at a stamp.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct CameraPose {
    pub(crate) world_from_camera: Transform,
    /// Twist in camera axes; `None` if the joint velocities are unknown.
    pub(crate) twist: Option<Twist>,
    /// Camera twist per unit velocity of each chain joint (1 rad/s or 1 m/s); empty if no joint
    /// moves the camera.
    pub(super) joint_twists: Arc<[Twist]>,
    /// State of a moving base that carries the camera.
    pub(super) base: Option<BaseState>,
}

impl CameraPose {
    /// The pose of a camera that no joint moves.
    fn without_joints(world_from_camera: Transform, twist: Twist, base: Option<BaseState>) -> Self {
        Self {
            world_from_camera,
            twist: Some(twist),
            joint_twists: [].into(),
            base,
        }
    }
}

impl Motion {
    /// The motion of the robot of a rig, without readings.
    pub(crate) fn new(rig: &Rig) -> anyhow::Result<Self> {
        let chain = Chain::from_urdf(&rig.arm.urdf_text, &rig.arm.base_link, &rig.arm.flange_link)
            .context("the arm's URDF")?;
        let order = chain.order_in(&rig.arm.joints).context("arm.joints")?;
        let max_gap = Duration::from_secs_f64(rig.join.max_gap_millis * 1e-3);
        // Tags give the base pose only at images, not in between. The slowest camera therefore
        // decides how far apart base poses are.
        let min_rate_hz = rig
            .cameras
            .iter()
            .map(|camera| camera.rate_hz)
            .fold(f64::INFINITY, f64::min);
        // A rate below 1 Hz counts as 1 Hz. Interpolating across several seconds of a driving base
        // would give wrong poses.
        let between_images = Duration::from_secs_f64(MAX_IMAGE_INTERVALS / min_rate_hz.max(1.0));
        let max_base_gap = if rig.base.driver == BaseDriver::Tags {
            max_gap.max(between_images)
        } else {
            max_gap
        };
        let base = match rig.base.driver {
            BaseDriver::Fixed => BaseMotion::Fixed(rig.base.world_from_base),
            BaseDriver::Tags | BaseDriver::Rgbd | BaseDriver::Udp | BaseDriver::Sim => {
                let poses = || PoseHistory::new(max_base_gap, MAX_READINGS);
                BaseMotion::ReportedPoses(Box::new(ReportedPoses {
                    poses: poses(),
                    corrections: Corrections::default(),
                    jump_removal: corrects_base(rig).then(JumpRemoval::default),
                    station_detector: StationDetector::default(),
                    truth: poses(),
                }))
            }
        };
        let offsets = order
            .iter()
            .map(|ix| rig.arm.joint_offsets.get(*ix).copied().unwrap_or(0.0))
            .collect();
        Ok(Self {
            chain,
            order,
            offsets,
            joints: JointHistory::new(max_gap, MAX_READINGS),
            ignored: None,
            base,
        })
    }

    /// A warning for the first joint whose reading lies outside its limits in the URDF.
    pub(super) fn joint_limit_warning(&self, state: &JointState) -> Option<String> {
        let joints = self
            .chain
            .joint_names()
            .iter()
            .zip(self.chain.limits())
            .zip(self.order.iter().zip(&self.offsets));
        joints.into_iter().find_map(|((name, limits), (ix, offset))| {
            let position = state.position.get(*ix)? + offset;
            let is_beyond_limits =
                position < limits.lower - MAX_LIMIT_EXCESS || position > limits.upper + MAX_LIMIT_EXCESS;
            is_beyond_limits.then(|| {
                format!(
                    "joint {name:?} reports {position:.3}, outside its range of {:.3} to {:.3}: are the readings in \
                     degrees, or is an offset missing?",
                    limits.lower, limits.upper
                )
            })
        })
    }

    /// Adds joint readings in the order of the device.
    ///
    /// # Errors
    /// If the readings are not valid, or imply an impossible speed. Such readings are ignored.
    pub(crate) fn push_joints(&mut self, state: JointState) -> Result<(), JointsRejection> {
        // Devices report joints in their own order. The chain needs the joints in its own order.
        // Offsets are added before interpolation, so that all code after this line uses URDF
        // positions.
        let state = match (self.ordered(&state.position), self.ordered(&state.velocity)) {
            (Some(position), Some(velocity)) if !position.is_empty() => {
                let position = position
                    .iter()
                    .zip(&self.offsets)
                    .map(|(reading, offset)| reading + offset)
                    .collect();
                JointState {
                    stamp: state.stamp,
                    position,
                    velocity,
                    effort: Vec::new(),
                }
            }
            _ => return Err(JointsRejection::Invalid),
        };
        // Joint states of a second program on the same bus or port mix with those of the arm. They
        // are recognized by speeds that the arm cannot reach.
        let newest = self
            .joints
            .newest()
            .and_then(|newest| self.joints.at(newest).ok());
        if let Some(jump) = newest.and_then(|newest| self.jump(&newest, &state)) {
            // If later states agree with the ignored state, the last accepted state was the wrong
            // one.
            let continues = self
                .ignored
                .as_ref()
                .is_some_and(|(ignored, _)| self.jump(ignored, &state).is_none());
            let n_ignored = 1 + self
                .ignored
                .as_ref()
                .filter(|_| continues)
                .map_or(0, |(_, n_ignored)| *n_ignored);
            if n_ignored < MIN_CONSISTENT {
                self.ignored = Some((state, n_ignored));
                return Err(JointsRejection::TooFast(jump));
            }
        }
        self.ignored = None;
        self.joints
            .push(state)
            .map_err(|_| JointsRejection::Invalid)
    }

    /// The numbers of a reading in the order of the chain. The list is empty if the device does not
    /// report these numbers. `None` if some of them are missing.
    fn ordered(&self, numbers: &[f64]) -> Option<Vec<f64>> {
        if numbers.is_empty() {
            return Some(Vec::new());
        }
        self.order
            .iter()
            .map(|ix| numbers.get(*ix).copied())
            .collect()
    }

    /// Describes the first joint that cannot have moved from one state to the other.
    fn jump(&self, before: &JointState, state: &JointState) -> Option<String> {
        let secs = state.stamp.secs_since(before.stamp);
        if secs <= 0.0 {
            return None; // It is out of order.
        }
        let joints = self.chain.joint_names().iter().zip(self.chain.limits());
        let mut joints = joints.zip(before.position.iter().zip(&state.position));
        let ((name, limits), (from, to)) = joints.find(|((_, limits), (from, to))| {
            // If the URDF has no speed limit or a limit of 0, the maximum speed is unknown, so
            // states are never ignored because of this joint.
            let max_speed = MAX_SPEED_FACTOR * limits.velocity;
            max_speed > 0.0
                && distance(**from, **to, limits) > max_speed * (secs + MAX_STAMP_ERROR_SECS)
        })?;
        Some(format!(
            "joint {name:?} moved from {from:.3} to {to:.3} in {:.0} ms, at most {:.2} rad/s or m/s are accepted ({MAX_SPEED_FACTOR} \
             times its limit in the URDF)",
            1e3 * secs,
            MAX_SPEED_FACTOR * limits.velocity
        ))
    }

    /// Adds a pose of a moving base; returns whether it was valid.
    pub(super) fn push_base(&mut self, pose: &BasePose) -> bool {
        match &mut self.base {
            BaseMotion::Fixed(_) => true,
            BaseMotion::ReportedPoses(reported) => {
                let odom_from_base = match &mut reported.jump_removal {
                    Some(jumps) => jumps.continued(pose.stamp, &pose.world_from_base),
                    None => pose.world_from_base,
                };
                let is_valid = reported.poses.push(pose.stamp, odom_from_base).is_ok();
                if is_valid {
                    // A pose that the history has rejected must not end a station, because it is
                    // out of order or not finite.
                    reported.station_detector.push(pose.stamp, &odom_from_base);
                }
                is_valid
            }
        }
    }

    /// Discards all readings.
    pub(super) fn restart(&mut self) {
        self.joints.clear();
        if let BaseMotion::ReportedPoses(reported) = &mut self.base {
            reported.poses.clear();
            reported.truth.clear();
            reported.corrections = Corrections::default();
            if let Some(jump_removal) = &mut reported.jump_removal {
                *jump_removal = JumpRemoval::default();
            }
            reported.station_detector.restart();
        }
    }

    /// Adds a ground truth base pose from a simulator.
    pub(super) fn push_base_truth(&mut self, truth: &BasePose) {
        if let BaseMotion::ReportedPoses(reported) = &mut self.base {
            // Ground truth is used only in reports, so an invalid pose is ignored.
            let _ = reported.truth.push(truth.stamp, truth.world_from_base);
        }
    }

    /// Moves base poses from this stamp on, in addition to earlier corrections.
    pub(super) fn correct_base(&mut self, stamp: Stamp, motion: &Transform) {
        if let BaseMotion::ReportedPoses(reported) = &mut self.base {
            let map_from_odom = motion * reported.corrections.newest();
            reported.corrections.push(stamp, map_from_odom);
        }
    }

    /// The newest correction of base poses as they are reported, with their jumps.
    pub(super) fn map_from_reported(&self) -> Transform {
        let BaseMotion::ReportedPoses(reported) = &self.base else {
            return Transform::identity();
        };
        let newest = reported.corrections.newest();
        let jumps = reported.jump_removal.as_ref();
        jumps.map_or(newest, |jumps| newest * jumps.continuous_from_reported())
    }

    /// The reported and the corrected base pose at a stamp; `None` if they are not known.
    pub(super) fn base_poses(&self, stamp: Stamp) -> Option<[Transform; 2]> {
        let BaseMotion::ReportedPoses(reported) = &self.base else {
            return None;
        };
        Some([reported.poses.at(stamp).ok()?, reported.at(stamp).ok()?])
    }

    /// The true base pose at a stamp, from a simulator.
    pub(super) fn true_base(&self, stamp: Stamp) -> Option<Transform> {
        let BaseMotion::ReportedPoses(reported) = &self.base else {
            return None;
        };
        reported.truth.at(stamp).ok()
    }

    /// The corrected base pose at a stamp; `NotYet` if no pose at or after the stamp has arrived.
    pub(super) fn world_from_base(&self, stamp: Stamp) -> Result<Transform, HistoryError> {
        match &self.base {
            BaseMotion::Fixed(pose) => Ok(*pose),
            BaseMotion::ReportedPoses(reported) => reported.at(stamp),
        }
    }

    /// The corrected `world_from_base` and the twist of the base in base axes at a stamp; `NotYet`
    /// if no pose at or after the stamp has arrived.
    pub(super) fn base_at(&self, stamp: Stamp) -> Result<(Transform, Twist), HistoryError> {
        match &self.base {
            BaseMotion::Fixed(pose) => Ok((*pose, Twist::zero())),
            BaseMotion::ReportedPoses(reported) => {
                let (odom_from_base, twist) = reported.poses.with_twist_at(stamp)?;
                Ok((reported.corrections.at(stamp) * odom_from_base, twist))
            }
        }
    }

    /// The pose and velocity of a camera at a stamp; `NotYet` if no reading at or after the stamp
    /// has arrived.
    pub(crate) fn at(
        &self,
        camera: &config::Camera,
        stamp: Stamp,
    ) -> Result<CameraPose, HistoryError> {
        // The state of the base is stored with each keyframe, so that a later correction of the
        // base pose can be applied to it. A camera that is fixed in the room does not need it,
        // because the base does not carry it.
        let (world_from_base, base_twist, base) = match &self.base {
            BaseMotion::Fixed(pose) => (*pose, Twist::zero(), None),
            BaseMotion::ReportedPoses(reported) if camera.parent != Parent::World => {
                let (odom_from_base, twist) = reported.poses.with_twist_at(stamp)?;
                let map_from_odom = reported.corrections.at(stamp);
                let world_from_base = map_from_odom * odom_from_base;
                let base_state = BaseState {
                    station: reported.station_detector.at(stamp),
                    world_from_base: odom_from_base,
                    map_from_odom,
                    truth: reported.truth.at(stamp).ok(),
                };
                (world_from_base, twist, Some(base_state))
            }
            BaseMotion::ReportedPoses(_) => (Transform::identity(), Twist::zero(), None),
        };
        match camera.parent {
            Parent::World => Ok(CameraPose::without_joints(
                camera.parent_from_camera,
                Twist::zero(),
                base,
            )),
            Parent::Base => Ok(CameraPose::without_joints(
                world_from_base * camera.parent_from_camera,
                base_twist.of_attached(&camera.parent_from_camera),
                base,
            )),
            Parent::Flange => {
                let joints = self.joints.at(stamp)?;
                // Readings of the wrong length are rejected when they are pushed, so the chain
                // cannot fail here.
                let Ok(base_from_flange) = self.chain.forward(&joints.position) else {
                    return Err(HistoryError::NotFinite);
                };
                // Both twists are twists of the flange in flange axes: one from the motion of the
                // base, and one from the joints. They can be added, because they are expressed in
                // the same axes.
                let by_base = base_twist.of_attached(&base_from_flange);
                let by_arm = self
                    .chain
                    .tip_twist(&joints.position, &joints.velocity)
                    .ok();
                let flange_twist = by_arm.map(|by_arm| Twist {
                    linear_m_s: by_arm.linear_m_s + by_base.linear_m_s,
                    angular_rad_s: by_arm.angular_rad_s + by_base.angular_rad_s,
                });
                // If joint offsets are estimated later, the pose of the camera changes along these
                // twists.
                let by_joint = self
                    .chain
                    .tip_twists_by_joint(&joints.position)
                    .unwrap_or_default();
                Ok(CameraPose {
                    world_from_camera: world_from_base
                        * base_from_flange
                        * camera.parent_from_camera,
                    twist: flange_twist.map(|twist| twist.of_attached(&camera.parent_from_camera)),
                    joint_twists: by_joint
                        .iter()
                        .map(|twist| twist.of_attached(&camera.parent_from_camera))
                        .collect(),
                    base,
                })
            }
        }
    }
}

/// Mean image speed in pixels per second for a scene at a constant depth, over the image center and
/// the centers of its quadrants.
pub(super) fn image_speed_px_s(twist: &Twist, intrinsics: &Intrinsics, depth_m: f64) -> f64 {
    // Rotation about the optical axis moves only the outer points, and translation along it moves
    // no point at the center. With five points, both motions are measured.
    let sample_points = [
        [0.5, 0.5],
        [0.25, 0.25],
        [0.75, 0.25],
        [0.25, 0.75],
        [0.75, 0.75],
    ];
    sample_points
        .into_iter()
        .map(|point_frac| point_speed_px_s(twist, intrinsics, depth_m, point_frac))
        .sum::<f64>()
        / 5.0
}

/// Image speed in pixels per second of the scene point at a depth, seen at this fraction of the
/// image width and height.
fn point_speed_px_s(
    twist: &Twist,
    intrinsics: &Intrinsics,
    depth_m: f64,
    [x_frac, y_frac]: [f64; 2],
) -> f64 {
    let [width, height] = intrinsics.size_px.map(f64::from);
    let [fx, fy] = intrinsics.focal_px;
    let [cx, cy] = intrinsics.principal_px;
    let ray = Vector3::new((x_frac * width - cx) / fx, (y_frac * height - cy) / fy, 1.0);
    let velocity = twist.apparent_velocity(&(ray * depth_m));
    // Time derivative of the pinhole projection u = fx * x / z, with x / z = ray.x and z = depth_m.
    let du = fx * (velocity.x - ray.x * velocity.z) / depth_m;
    let dv = fy * (velocity.y - ray.y * velocity.z) / depth_m;
    du.hypot(dv)
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Lens;

    #[test]
    fn predicted_image_speed_matches_projected_points() {
        let intrinsics = Intrinsics {
            size_px: [1280, 720],
            focal_px: [915.0, 914.0],
            principal_px: [640.0, 361.0],
            lens: Lens::Pinhole,
            rectified: false,
        };
        // Motion of 0.1 m/s at a distance of 0.3 m shears a 720p image by 4.6 px in 15 ms.
        let sideways = Twist {
            linear_m_s: Vector3::new(0.1, 0.0, 0.0),
            angular_rad_s: Vector3::zeros(),
        };
        assert!((image_speed_px_s(&sideways, &intrinsics, 0.3) * 0.015 - 4.6).abs() < 0.05);

        let twist = Twist {
            linear_m_s: Vector3::new(0.1, -0.2, 0.3),
            angular_rad_s: Vector3::new(0.2, 0.4, -0.9),
        };
        let secs = 1e-6;
        let moved = kinematics::transform::exp(&twist, secs).inverse();
        let numeric: f64 = [
            [0.5, 0.5],
            [0.25, 0.25],
            [0.75, 0.25],
            [0.25, 0.75],
            [0.75, 0.75],
        ]
        .map(|[x, y]| {
            let before = [x * 1280.0, y * 720.0];
            let point = intrinsics.unproject(before).expect("a pinhole") * 0.7;
            let after = intrinsics
                .project(&(moved * nalgebra::Point3::from(point)).coords)
                .expect("in front");
            (after[0] - before[0]).hypot(after[1] - before[1]) / secs
        })
        .iter()
        .sum::<f64>()
            / 5.0;
        let predicted = image_speed_px_s(&twist, &intrinsics, 0.7);
        assert!(
            (predicted - numeric).abs() < 1e-3 * numeric,
            "{predicted} {numeric}"
        );
    }
}
