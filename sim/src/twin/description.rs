//! The robot of a rig file, as its caller describes it.

use kinematics::Transform;
use std::collections::BTreeMap;
use std::sync::Arc;

/// The robot of a rig file, which replaces the robot of a scene. The scene is placed where the
/// cameras of this robot see it.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotConfig {
    /// Text of the URDF.
    pub urdf: String,
    /// Link that is the base of the robot.
    pub base_link: String,
    /// Link to which cameras with the parent [`Parent::Flange`](crate::Parent::Flange) are
    /// attached.
    pub flange_link: String,
    /// Contents of mesh files, by their names in the URDF. A link without its meshes is drawn with
    /// its collision shapes, or with bars between its joints.
    pub meshes: BTreeMap<String, Arc<[u8]>>,
    /// Pose of a fixed base. A moving base starts at the place that the scene defines.
    pub world_from_base: Transform,
    /// Whether the base moves and reports its pose.
    pub has_moving_base: bool,
    /// Images with more motion blur than this are not used, pixels. The scan is slow enough for
    /// this limit.
    pub max_blur_px: f64,
    /// Images with more rolling-shutter shear than this are not used, pixels.
    pub max_shear_px: f64,
}
