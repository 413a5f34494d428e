//! Masks of the robot in the images of cameras that see it move.
//!
//! A model is trained on a static scene. A robot that moves through the view of a camera is no part
//! of this scene, so its pixels are masked. The pixels follow from the shapes in the URDF and from
//! the joint state at the time of the image.
//!
//! **Margin.** A mask extends beyond the robot, because three inputs have errors:
//! - The rotation of the camera. An error of `a` radians moves the robot by at most
//!   `a (1 + t^2)` focal lengths, where `t` is the tangent of the angle to the optical axis.
//! - The position of the robot's surface in the frame of the camera: extrinsics, and parts that the
//!   URDF omits, such as cables. An error of `d` moves the surface by at most
//!   `d / z sqrt(1 + t^2)` focal lengths at a depth of `z`.
//! - The time of the image. The mask covers the robot at the start and at the end of the interval
//!   in which the image was exposed, and the convex hull of both positions of each piece. A robot
//!   at rest therefore needs no margin for the time.
//!
//! The first two errors are independent, so their squares are added.

mod convex_pieces;
#[cfg(test)]
mod recorded_tests;
mod robot_shape;
#[cfg(test)]
mod tests;

use crate::config::{ArmDriver, Camera, CameraDriver, Parent, Rig};
use anyhow::Context;
use keyframe::masked_robot::{HiddenPixels, MaskedRobot, Sweep, Uncertainty};
use keyframe::{Keyframe, MaskViews};
use kinematics::urdf::Robot;
use kinematics::{
    Chain, HistoryError, JointHistory, JointState, Stamp, Transform, Twist, transform,
};
use messages::counted;
use robot_shape::{Extent, RobotShape};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// Maximum number of joint states kept. At 1 kHz, they cover 20 s, which is longer than any image
/// waits.
const MAX_READINGS: usize = 20_000;
/// Error of the rotation of a camera that is covered, radians: twice the standard deviation of a
/// calibration with few poses.
const ROTATION_RAD: f64 = 0.5 / 180.0 * std::f64::consts::PI;
/// Exposure and readout that are assumed if the rig file omits them, seconds. Indoors, cameras with
/// an automatic exposure rarely expose longer, and most rolling shutters are faster.
const UNKNOWN_EXPOSURE_SECS: f64 = 0.02;
const UNKNOWN_READOUT_SECS: f64 = 0.02;
/// Error of the stamp that is covered if it was not measured, seconds. Webcams deliver their images
/// one or two frame periods after the exposure.
const UNKNOWN_STAMP_ERROR_SECS: f64 = 0.02;

/// The robot of a rig, and the cameras in whose images it is masked.
pub(crate) struct RobotMasks {
    shape: RobotShape,
    base_from_flange: Chain,
    /// Index of each joint of this chain in the joint states.
    flange_order: Vec<usize>,
    /// Offset of each joint in the joint states.
    joint_offsets: Vec<f64>,
    joints: JointHistory,
    cameras: BTreeMap<Arc<str>, MaskedCamera>,
}

/// A camera in whose images the robot is masked.
struct MaskedCamera {
    extent: Extent,
    parent: Parent,
    parent_from_camera: Transform,
    camera_from_depth: Transform,
    /// Half the length of the interval in which the image may have been exposed, seconds.
    half_interval_secs: f64,
    uncertainty: Uncertainty,
}

/// The robot at the time of an image.
#[derive(Clone, Debug)]
pub(crate) struct RobotAt {
    joints: JointState,
    world_from_base: Transform,
    base_twist: Twist,
}

/// How much of an image the robot covers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RobotCover {
    /// Number of pixels in which the robot is masked.
    pub n_masked: u64,
    /// Number of pixels.
    pub n_pixels: u64,
}

impl RobotCover {
    /// Adds the pixels of another image.
    pub(crate) fn add(&mut self, other: Self) {
        self.n_masked += other.n_masked;
        self.n_pixels += other.n_pixels;
    }

    /// The covered share of the image, percent. It is 0 without images.
    #[must_use]
    pub fn percent(&self) -> u64 {
        (100 * self.n_masked + self.n_pixels / 2)
            .checked_div(self.n_pixels)
            .unwrap_or(0)
    }
}

impl RobotMasks {
    /// The robot of a rig. `None` if it is not masked in the images of any camera.
    ///
    /// # Errors
    ///
    /// If the robot description does not match the rig.
    pub(crate) fn new(rig: &Rig) -> anyhow::Result<Option<Self>> {
        let mut cameras: BTreeMap<_, _> = rig
            .cameras
            .iter()
            .filter(|camera| is_masked(camera, rig))
            .map(|camera| (Arc::clone(&camera.name), MaskedCamera::new(camera, rig)))
            .collect();
        if cameras.is_empty() {
            return Ok(None);
        }
        let arm = &rig.arm;
        let robot = Robot::parse(&arm.urdf_text).context("the arm's URDF")?;
        let needs_all = cameras
            .values()
            .any(|camera: &MaskedCamera| camera.extent == Extent::WholeRobot);
        let extent = if needs_all {
            Extent::WholeRobot
        } else {
            Extent::MovingLinks
        };
        let shape = RobotShape::new(
            &robot,
            &arm.base_link,
            &arm.joints,
            extent,
            &arm.urdf_folder,
        )
        .context("the arm's URDF")?;
        cameras.retain(|_, camera| shape.has_links(camera.extent));
        if cameras.is_empty() {
            return Ok(None);
        }
        let base_from_flange =
            Chain::new(&robot, &arm.base_link, &arm.flange_link).context("the arm's URDF")?;
        let max_gap = Duration::from_secs_f64(rig.join.max_gap_millis * 1e-3);
        let offset = |ix: usize| arm.joint_offsets.get(ix).copied().unwrap_or_default();
        Ok(Some(Self {
            shape,
            flange_order: base_from_flange
                .order_in(&arm.joints)
                .context("arm.joints")?,
            base_from_flange,
            joint_offsets: (0..arm.joints.len()).map(offset).collect(),
            joints: JointHistory::new(max_gap, MAX_READINGS),
            cameras,
        }))
    }

    /// Names of the cameras in whose images the robot is masked.
    pub(crate) fn cameras(&self) -> impl Iterator<Item = &str> {
        self.cameras.keys().map(|name| &**name)
    }

    /// Whether images of a camera need the state of the robot.
    pub(crate) fn masks(&self, camera: &str) -> bool {
        let camera = self.cameras.get(camera);
        camera.is_some_and(|camera| self.shape.has_pieces(camera.extent))
    }

    /// The parts of the robot that are not masked because their shapes are unknown, in one
    /// sentence. `None` if there are none.
    pub(crate) fn warning(&self) -> Option<String> {
        let cameras: Vec<String> = self.cameras().map(|name| format!("{name:?}")).collect();
        let subject = if let [camera] = &cameras[..] {
            format!("camera {camera} may see the robot")
        } else {
            format!("cameras {} may see the robot", cameras.join(", "))
        };
        let unknown = self.shape.unknown();
        let first = unknown
            .iter()
            .next()
            .map(|(link, reason)| format!("{link:?}: {reason}"));
        let is_known = self.cameras().any(|camera| self.masks(camera));
        match (!is_known, first) {
            (true, None) => Some(format!(
                "{subject}, but no moving link of the URDF has a shape, so the moving robot will be trained into the model; \
                 add <visual> or <collision> shapes, or keep the robot out of view"
            )),
            (_, Some(first)) => Some(format!(
                "{subject}, but the shape of {} is unknown ({first}), so these parts of the moving robot will be trained \
                 into the model; add <collision> shapes, or meshes as .stl, .dae or .obj",
                counted(unknown.len() as u64, "link"),
            )),
            (false, None) => None,
        }
    }

    /// Adds a joint state in the order of the device.
    pub(crate) fn push_joints(&mut self, state: &JointState) {
        if state.position.len() != self.joint_offsets.len() {
            return;
        }
        let positions = state.position.iter().zip(&self.joint_offsets);
        // A state that the history rejects is counted by the join, which has its own history.
        let _ = self.joints.push(JointState {
            stamp: state.stamp,
            position: positions
                .map(|(reading, offset)| reading + offset)
                .collect(),
            velocity: state.velocity.clone(),
            effort: Vec::new(),
        });
    }

    /// Discards all joint states.
    pub(crate) fn restart(&mut self) {
        self.joints.clear();
    }

    /// The robot at a stamp.
    ///
    /// * `base`: `world_from_base` and the twist of the base at the stamp.
    ///
    /// # Errors
    ///
    /// If there are no joint states around the stamp, or not yet.
    pub(crate) fn at(
        &self,
        stamp: Stamp,
        (world_from_base, base_twist): (Transform, Twist),
    ) -> Result<RobotAt, HistoryError> {
        let joints = if self.joint_offsets.is_empty() {
            JointState {
                stamp,
                position: Vec::new(),
                velocity: Vec::new(),
                effort: Vec::new(),
            }
        } else {
            self.joints.at(stamp)?
        };
        Ok(RobotAt {
            joints,
            world_from_base,
            base_twist,
        })
    }

    /// Masks the robot in a keyframe: color has no alpha and depth has no readings where it may be.
    /// Returns how much of the image it covers. `None` if the camera is not masked.
    ///
    /// * `depth_delay_secs`: time from the image to its depth image.
    pub(crate) fn apply(
        &self,
        keyframe: &mut Keyframe,
        robot: &RobotAt,
        depth_delay_secs: f64,
    ) -> Option<RobotCover> {
        let camera = self.cameras.get(&keyframe.camera)?;
        let during = |half_interval_secs: f64| self.sweeps(camera, robot, half_interval_secs);
        let during_depth = if keyframe.depth.is_some() {
            during(camera.half_interval_secs + depth_delay_secs.abs())
        } else {
            Vec::new()
        };
        let masked = MaskedRobot {
            links: Arc::clone(self.shape.pieces()),
            uncertainty: camera.uncertainty,
            during_color: during(camera.half_interval_secs),
            during_depth,
            camera_from_depth: camera.camera_from_depth,
            hidden: HiddenPixels::default(),
        };
        let views = MaskViews::of(keyframe);
        let n_masked = keyframe.mask_robot(masked, &views);
        let [width, height] = keyframe.size_px.map(u64::from);
        Some(RobotCover {
            n_masked,
            n_pixels: width * height,
        })
    }

    /// Where the links may be in the frame of a camera.
    fn sweeps(
        &self,
        camera: &MaskedCamera,
        robot: &RobotAt,
        half_interval_secs: f64,
    ) -> Vec<Sweep> {
        let instants = [-half_interval_secs, half_interval_secs].map(|delay_secs| {
            let (positions, world_from_base) = robot.after(delay_secs);
            let camera_from_base = self.camera_from_base(camera, &positions, &world_from_base);
            (positions, camera_from_base)
        });
        self.shape.sweeps_in_camera(camera.extent, &instants)
    }

    fn camera_from_base(
        &self,
        camera: &MaskedCamera,
        positions: &[f64],
        world_from_base: &Transform,
    ) -> Transform {
        let camera_from_parent = camera.parent_from_camera.inverse();
        match camera.parent {
            Parent::World => camera_from_parent * world_from_base,
            Parent::Base => camera_from_parent,
            Parent::Flange => {
                let q: Vec<f64> = self
                    .flange_order
                    .iter()
                    .map(|ix| positions.get(*ix).copied().unwrap_or_default())
                    .collect();
                let base_from_flange = self
                    .base_from_flange
                    .forward(&q)
                    .expect("one position for each joint of the chain");
                camera_from_parent * base_from_flange.inverse()
            }
        }
    }
}

impl RobotAt {
    /// Joint positions and `world_from_base` some time later, at constant velocity.
    fn after(&self, secs: f64) -> (Vec<f64>, Transform) {
        let velocity = |ix: usize| self.joints.velocity.get(ix).copied().unwrap_or_default();
        let positions = self.joints.position.iter().enumerate();
        (
            positions.map(|(ix, q)| q + secs * velocity(ix)).collect(),
            self.world_from_base * transform::exp(&self.base_twist, secs),
        )
    }
}

impl MaskedCamera {
    fn new(camera: &Camera, rig: &Rig) -> Self {
        let depth = camera.depth.as_ref();
        // Only a camera that the base does not carry depends on the pose of the base.
        let base_error_m = if camera.parent == Parent::World && rig.has_moving_base() {
            rig.base.max_sigma_m
        } else {
            0.0
        };
        // A base that does not move is a part of the static scene, and a camera on a moving base is
        // mounted so that the base does not hide its view.
        let extent = if camera.parent == Parent::World && rig.has_moving_base() {
            Extent::WholeRobot
        } else {
            Extent::MovingLinks
        };
        Self {
            extent,
            parent: camera.parent,
            parent_from_camera: camera.parent_from_camera,
            camera_from_depth: depth
                .map_or_else(Transform::identity, |depth| depth.camera_from_depth),
            half_interval_secs: half_interval_secs(camera),
            uncertainty: Uncertainty {
                rotation_rad: ROTATION_RAD,
                position_m: camera.mask_margin_m.hypot(base_error_m),
            },
        }
    }
}

/// Whether the robot is masked in the images of a camera.
fn is_masked(camera: &Camera, rig: &Rig) -> bool {
    let has_robot = rig.arm.driver != ArmDriver::None || rig.has_moving_base();
    // A camera on the flange usually sees little of the robot, and its own gripper does not move in
    // its images.
    has_robot && camera.mask_robot.unwrap_or(camera.parent != Parent::Flange)
}

/// Half the length of the interval in which an image may have been exposed, seconds.
fn half_interval_secs(camera: &Camera) -> f64 {
    let secs = |micros: Option<f64>, unknown_secs: f64| micros.map_or(unknown_secs, |us| 1e-6 * us);
    let period_secs = 1.0 / camera.rate_hz;
    let exposure_secs = secs(
        camera.exposure_micros,
        UNKNOWN_EXPOSURE_SECS.min(period_secs),
    );
    let readout_secs = secs(camera.readout_micros, UNKNOWN_READOUT_SECS.min(period_secs));
    let stamp_error_secs = match &camera.stamp_to_mid_exposure {
        Some(offset) => 2e-3 * offset.sigma_millis,
        None if camera.driver == CameraDriver::Sim => 0.0,
        None => UNKNOWN_STAMP_ERROR_SECS,
    };
    0.5 * (exposure_secs + readout_secs) + stamp_error_secs
}
