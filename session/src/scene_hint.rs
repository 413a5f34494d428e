//! The initial view of a scene, centered on the point that the cameras look at or, without cameras,
//! on the model.

use keyframe::Keyframe;
use kinematics::Transform;
use nalgebra::{Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use std::sync::Arc;
use trainer::Bounds;
use viz::SceneHint;

/// Assumed distance of the scene from each camera if the optical axes do not determine it, meters:
/// a typical distance between the camera of an arm and its table. With a single camera, the view
/// turns about a point at this distance.
const PRIOR_DISTANCE_M: f64 = 0.5;
/// Weight of the assumed distance relative to one optical axis. It matters only in directions that
/// the axes do not constrain. A larger weight pulls the center away from the point where the axes
/// meet; a smaller one leaves it undefined for nearly parallel axes.
const PRIOR_WEIGHT: f64 = 0.01;

/// Distance of an outside view, in outer radii of the model. The whole sphere is then visible in a
/// field of view of 50 degrees (`1 / sin(25 degrees)` is 2.4), also on an upright phone whose view is
/// a quarter narrower than high.
const DISTANCE_RADII: f64 = 3.0;
/// Direction from the model to an outside view: from the front right, 30 degrees above the horizon.
const VIEW_DIRECTION: [f64; 3] = [0.5, -0.707, 0.5];

/// The view of the first camera, centered on the point nearest to all optical axes; `None` without
/// keyframes.
pub fn from_keyframes(keyframes: &[Arc<Keyframe>]) -> Option<SceneHint> {
    from_cameras(
        keyframes
            .iter()
            .map(|keyframe| keyframe.world_from_camera)
            .collect(),
    )
}

/// The view of the first camera, centered on the point nearest to all optical axes; `None` without
/// cameras.
pub fn from_cameras(world_from_cameras: Vec<Transform>) -> Option<SceneHint> {
    let world_from_camera = *world_from_cameras.first()?;
    let center = nearest_to_axes(&world_from_cameras)?;
    let distances_m = world_from_cameras
        .iter()
        .map(|pose| (center.coords - pose.translation.vector).norm());
    Some(SceneHint {
        center_m: center.coords.into(),
        radius_m: distances_m.sum::<f64>() / world_from_cameras.len() as f64,
        world_from_camera,
    })
}

/// A view of the whole model from outside and slightly above, z up.
pub fn from_bounds(bounds: &Bounds) -> SceneHint {
    let view_direction = Vector3::from(VIEW_DIRECTION).normalize();
    // The axes of a camera: x right, y down, z forward. `right` is horizontal, so that z of the
    // world points up in the picture.
    let forward = -view_direction;
    let right = forward.cross(&Vector3::z()).normalize();
    let axes = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let position_m =
        Vector3::from(bounds.center_m) + DISTANCE_RADII * bounds.outer_radius_m * view_direction;
    SceneHint {
        center_m: bounds.center_m,
        radius_m: bounds.outer_radius_m,
        world_from_camera: Transform::from_parts(Translation3::from(position_m), rotation),
    }
}

/// The point with the least squared distances to all optical axes, with a weak prior on the
/// distance from each camera.
fn nearest_to_axes(world_from_cameras: &[Transform]) -> Option<Point3<f64>> {
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for pose in world_from_cameras {
        let axis = pose.rotation * Vector3::z();
        // The distance of `x` from the axis through `c` is the length of `P (x - c)`, where
        // `P = I - a a^T` removes the component along the axis. The sum of the squares over all
        // axes is smallest where `sum P x = sum P c`. The prior adds `w (x - ahead)^2` per camera.
        let projector = Matrix3::identity() - axis * axis.transpose();
        let ahead = pose.translation.vector + PRIOR_DISTANCE_M * axis;
        normal += projector + PRIOR_WEIGHT * Matrix3::identity();
        right += projector * pose.translation.vector + PRIOR_WEIGHT * ahead;
    }
    Some(Point3::from(normal.cholesky()?.solve(&right)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Translation3, UnitQuaternion};

    fn camera_at(position: [f64; 3], target: Point3<f64>) -> Transform {
        let position = Point3::from(position);
        let rotation = UnitQuaternion::rotation_between(&Vector3::z(), &(target - position))
            .expect("not opposite");
        Transform::from_parts(Translation3::from(position.coords), rotation)
    }

    #[test]
    fn cameras_around_an_object_converge_on_it() {
        /// The prior shifts the result by about its weight times its error, which is 0.5 m here.
        const TOLERANCE_M: f64 = 0.01;
        let target = Point3::new(0.5, 0.1, 0.05);
        let positions = [
            [1.5, 0.1, 0.05],
            [0.5, 1.1, 0.1],
            [0.4, 0.1, 1.05],
            [0.5, -0.9, 0.3],
        ];
        let center = nearest_to_axes(&positions.map(|position| camera_at(position, target)))
            .expect("cameras");
        assert!((center - target).norm() < TOLERANCE_M, "{center}");
    }

    #[test]
    fn single_camera_uses_the_prior_distance() {
        const TOLERANCE_M: f64 = 1e-9;
        let pose = camera_at([1.0, 2.0, 3.0], Point3::new(1.0, 3.0, 3.0));
        let center = nearest_to_axes(&[pose]).expect("a camera");
        assert!(
            (center - Point3::new(1.0, 2.5, 3.0)).norm() < TOLERANCE_M,
            "{center}"
        );
        assert!(from_keyframes(&[]).is_none());
    }

    #[test]
    fn outside_view_looks_at_center_and_is_upright() {
        const TOLERANCE_M: f64 = 1e-9;
        let bounds = Bounds {
            center_m: [1.0, 2.0, 3.0],
            radius_m: 0.5,
            outer_radius_m: 0.8,
        };
        let pose = from_bounds(&bounds).world_from_camera;
        let center_in_camera = pose.inverse() * Point3::from(bounds.center_m);
        assert!(
            (center_in_camera - Point3::new(0.0, 0.0, 2.4)).norm() < TOLERANCE_M,
            "{center_in_camera}"
        );
        // The edge of the field of view is 25 degrees from the axis.
        let angle = (bounds.outer_radius_m / center_in_camera.z).asin();
        assert!(angle < 25_f64.to_radians(), "{angle} rad");
        let right = pose.rotation * Vector3::x();
        let down = pose.rotation * Vector3::y();
        assert!(
            right.z.abs() < TOLERANCE_M && down.z < -0.5,
            "{right} {down}"
        );
        assert!(pose.translation.vector.z > bounds.center_m[2]);
    }
}
