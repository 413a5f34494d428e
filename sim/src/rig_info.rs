//! True parameters of a rig and its cameras.

use crate::config::Parent;
use kinematics::{Intrinsics, Transform};

/// True parameters of a rig, which calibration should recover.
#[derive(Clone, Debug, PartialEq)]
pub struct RigInfo {
    /// The cameras in the order of the configuration.
    pub cameras: Vec<CameraInfo>,
    /// Names of the joints in the order of the readings.
    pub joint_names: Vec<String>,
    /// The scanners in the order of the configuration.
    pub scanner_names: Vec<String>,
    /// Whether the base moves and reports its pose.
    pub has_moving_base: bool,
    /// URDF of the robot, with its own joint names.
    pub urdf: String,
    /// Pose of the robot's base at the start.
    pub world_from_base: Transform,
    /// The renderer's name as reported by OpenGL.
    pub renderer: String,
}

/// True parameters of a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraInfo {
    /// Name in the rig file.
    pub name: String,
    /// Lens parameters of color and depth.
    pub intrinsics: Intrinsics,
    /// Frame that the camera is attached to.
    pub parent: Parent,
    /// Camera pose in the parent frame.
    pub parent_from_camera: Transform,
    /// Images per second.
    pub rate_hz: f64,
    /// Time from the first row's exposure to the last row's, microseconds.
    pub readout_micros: f64,
    /// Whether it delivers depth.
    pub has_depth: bool,
}
