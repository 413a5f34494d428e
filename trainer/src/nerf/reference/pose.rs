//! Correction of rays by the pose of their image. A ray is rotated about its origin and translated.

use nalgebra::{UnitQuaternion, Vector3};

/// Pose correction of an image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ImagePose {
    /// Rotation vector in the world frame, radians.
    pub rotation_rad: [f64; 3],
    /// Translation in the world frame, in units of the scene's radius.
    pub translation: [f64; 3],
}

impl ImagePose {
    /// Corrected origin and direction of a ray.
    pub fn apply_pose(&self, origin: [f64; 3], direction: [f64; 3]) -> ([f64; 3], [f64; 3]) {
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::from(self.rotation_rad));
        (
            (Vector3::from(origin) + Vector3::from(self.translation)).into(),
            (rotation * Vector3::from(direction)).into(),
        )
    }

    /// Gradients with respect to a small additional rotation and translation of a ray, computed
    /// from the gradients of its sample positions.
    ///
    /// * `direction`: corrected direction of the ray, of length 1.
    /// * `sample_positions`: distance along the ray and gradient of each sample.
    pub fn gradients(direction: [f64; 3], sample_positions: &[(f64, [f64; 3])]) -> Self {
        // A sample is at origin + distance * direction. A small rotation w changes the direction by
        // w x direction, so the gradient with respect to w is direction x v_direction.
        let mut v_origin = Vector3::zeros();
        let mut v_direction = Vector3::zeros();
        for (distance, gradient) in sample_positions {
            v_origin += Vector3::from(*gradient);
            v_direction += *distance * Vector3::from(*gradient);
        }
        Self {
            rotation_rad: Vector3::from(direction).cross(&v_direction).into(),
            translation: v_origin.into(),
        }
    }
}
