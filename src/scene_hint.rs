//! Where an orbiting view starts: around the point the cameras look at.

use kinematics::Transform;
use nalgebra::{Matrix3, Point3, Vector3};
use std::sync::Arc;
use trainer::Keyframe;
use viz::SceneHint;

/// How far ahead of the cameras the scene is believed to be when their axes do not say, metres.
const BELIEVED_AHEAD_M: f64 = 0.5;
/// Weight of that belief against one camera's axis: it decides only along directions that no axis decides.
const BELIEF: f64 = 0.01;

/// The point nearest to all optical axes, from the first camera; `None` without keyframes.
pub(crate) fn from_keyframes(keyframes: &[Arc<Keyframe>]) -> Option<SceneHint> {
    let poses: Vec<Transform> = keyframes.iter().map(|keyframe| keyframe.world_from_camera).collect();
    let world_from_camera = *poses.first()?;
    let center = nearest_to_axes(&poses)?;
    let distances_m = poses.iter().map(|pose| (center.coords - pose.translation.vector).norm());
    Some(SceneHint {
        center_m: center.coords.into(),
        radius_m: distances_m.sum::<f64>() / poses.len() as f64,
        world_from_camera,
    })
}

/// Least squares over the distances to the axes, with a weak pull towards a point ahead of each camera.
fn nearest_to_axes(world_from_cameras: &[Transform]) -> Option<Point3<f64>> {
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for pose in world_from_cameras {
        let axis = pose.rotation * Vector3::z();
        let across = Matrix3::identity() - axis * axis.transpose();
        let ahead = pose.translation.vector + BELIEVED_AHEAD_M * axis;
        normal += across + BELIEF * Matrix3::identity();
        right += across * pose.translation.vector + BELIEF * ahead;
    }
    Some(Point3::from(normal.cholesky()?.solve(&right)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Translation3, UnitQuaternion};

    fn camera_at(eye: [f64; 3], target: Point3<f64>) -> Transform {
        let eye = Point3::from(eye);
        let rotation = UnitQuaternion::rotation_between(&Vector3::z(), &(target - eye)).expect("not opposite");
        Transform::from_parts(Translation3::from(eye.coords), rotation)
    }

    #[test]
    fn cameras_round_an_object_meet_in_it() {
        /// The belief pulls by about its weight times how wrong it is, 0.5 m here.
        const ABS_M: f64 = 0.01;
        let target = Point3::new(0.5, 0.1, 0.05);
        let eyes = [[1.5, 0.1, 0.05], [0.5, 1.1, 0.1], [0.4, 0.1, 1.05], [0.5, -0.9, 0.3]];
        let center = nearest_to_axes(&eyes.map(|eye| camera_at(eye, target))).expect("cameras");
        assert!((center - target).norm() < ABS_M, "{center}");
    }

    #[test]
    fn one_camera_looks_half_a_metre_ahead() {
        const ABS_M: f64 = 1e-9;
        let pose = camera_at([1.0, 2.0, 3.0], Point3::new(1.0, 3.0, 3.0));
        let center = nearest_to_axes(&[pose]).expect("a camera");
        assert!((center - Point3::new(1.0, 2.5, 3.0)).norm() < ABS_M, "{center}");
        assert!(from_keyframes(&[]).is_none());
    }
}
