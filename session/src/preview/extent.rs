//! The extent of the space that a preview shows: the robot's base and the cameras. Viewers add the
//! robot itself.

use super::camera_poses::CameraPoses;
use crate::scene_hint::SceneView;
use capture::config::Rig;
use nalgebra::Vector3;
use viz::{Hub, SceneBounds};

/// Half the side of the box that is shown around the base, meters. It is the size of small arms.
/// Viewers enlarge it if the robot is larger.
const HALF_SIDE_M: f64 = 0.3;

/// Sends the extent to viewers.
pub(super) fn publish(hub: &Hub, rig: &Rig, cameras: &CameraPoses) {
    let bounds = bounds(rig, cameras);
    SceneView {
        world_from_camera: SceneView::outside(&bounds),
        bounds,
    }
    .publish(hub);
}

/// A box around the base and all cameras that do not move with the arm.
fn bounds(rig: &Rig, cameras: &CameraPoses) -> SceneBounds {
    let base = rig.base.world_from_base.translation.vector;
    let half = Vector3::repeat(HALF_SIDE_M);
    let (mut min, mut max) = (base - half, base + half);
    for position in cameras.fixed_positions() {
        min = min.inf(&Vector3::from(position));
        max = max.sup(&Vector3::from(position));
    }
    SceneBounds {
        min_m: min.into(),
        max_m: max.into(),
    }
}
