//! The camera of an image while its rows are read out.

use super::feature_image::Corner;
use crate::CameraCorrection;
use crate::registration::layout::Layout;
use keyframe::Keyframe;
use kinematics::{Transform, Twist};
use nalgebra::{Vector2, Vector3};

/// Corrected pose, motion and lens of an image's camera.
#[derive(Clone, Debug)]
pub(super) struct MovingCamera {
    /// Pose at mid-exposure.
    pub(super) world_from_camera: Transform,
    /// Velocity in the camera's own axes, and time from the first to the last row. Both are zero if
    /// unknown.
    twist: Twist,
    readout_secs: f64,
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    /// Focal lengths of the keyframe. Offsets of the principal point are relative to these focal
    /// lengths.
    keyframe_focal_px: [f64; 2],
}

/// Ray of a corner, and position of the camera at the readout of its row.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sighting {
    /// Direction of the corner in the axes that the camera has at mid-exposure, given by x and y at
    /// a depth of 1.
    pub(super) ray: Vector2<f64>,
    /// Position of the camera when it read out the corner's row, meters. The frame is the camera
    /// frame at mid-exposure.
    pub(super) center_m: Vector3<f64>,
}

impl MovingCamera {
    pub(super) fn new(keyframe: &Keyframe, correction: &CameraCorrection) -> Self {
        let corrected = correction.apply(keyframe);
        let shutter = corrected.shutter;
        Self {
            world_from_camera: corrected.world_from_camera,
            twist: shutter.map_or_else(Twist::zero, |shutter| shutter.twist),
            readout_secs: shutter.map_or(0.0, |shutter| shutter.readout_secs),
            focal_px: corrected.focal_px,
            principal_px: corrected.principal_px,
            keyframe_focal_px: keyframe.focal_px,
        }
    }

    /// Ray and camera position at which a corner was observed, to first order in the motion during
    /// readout.
    pub(super) fn sighting(&self, corner: &Corner) -> Sighting {
        // Time from mid-exposure to the readout of the row.
        let secs = self.readout_secs * corner.row_share;
        let plane =
            [0, 1].map(|axis| (corner.px[axis] - self.principal_px[axis]) / self.focal_px[axis]);
        let ray = Vector3::new(plane[0], plane[1], 1.0);
        let turned = ray + secs * self.twist.angular_rad_s.cross(&ray);
        Sighting {
            ray: turned.xy() / turned.z,
            center_m: secs * self.twist.linear_m_s,
        }
    }

    /// Motion of the camera per unit of each parameter. See [`CameraParamOffsets::motions`].
    ///
    /// [`CameraParamOffsets::motions`]: crate::registration::layout::CameraParamOffsets::motions
    pub(super) fn motions(
        &self,
        layout: &Layout,
        camera: usize,
    ) -> Vec<(usize, Vector3<f64>, Vector3<f64>)> {
        layout.of_camera(camera).motions(Some(&self.twist))
    }

    /// Difference between the rays of the image and the rays of the same image with other
    /// corrections. It consists of an angle in radians and the distance between the camera
    /// positions in meters.
    pub(super) fn difference(&self, other: &Self) -> [f64; 2] {
        let motion = self.world_from_camera.inverse() * other.world_from_camera;
        let of_lens = |axis: usize| {
            let focal = (self.focal_px[axis] / other.focal_px[axis]).ln().abs();
            focal + (self.principal_px[axis] - other.principal_px[axis]).abs() / self.focal_px[axis]
        };
        [
            motion.rotation.angle() + of_lens(0).max(of_lens(1)),
            motion.translation.vector.norm(),
        ]
    }

    /// Motion of a corner's ray per unit of each parameter of the lens.
    pub(super) fn ray_motions(
        &self,
        layout: &Layout,
        camera: usize,
        ray: &Vector2<f64>,
    ) -> [Option<(usize, Vector2<f64>)>; 4] {
        let Some(lens) = layout.of_camera(camera).lens else {
            return [None; 4];
        };
        // A longer focal length moves rays toward the axis. An offset of the principal point moves
        // all rays in the opposite direction.
        let offset = |axis: usize| -self.keyframe_focal_px[axis] / self.focal_px[axis];
        [
            Some((lens, Vector2::new(-ray.x, 0.0))),
            Some((lens + 1, Vector2::new(0.0, -ray.y))),
            Some((lens + 2, Vector2::new(offset(0), 0.0))),
            Some((lens + 3, Vector2::new(0.0, offset(1)))),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::{Miscalibration, capture};
    use kinematics::transform;

    #[test]
    fn sightings_follow_the_motion_of_the_camera() {
        let scan = capture(&Miscalibration {
            has_rolling_shutter: true,
            ..Miscalibration::none()
        });
        let keyframe = scan.iter().find(|keyframe| {
            keyframe
                .twist
                .is_some_and(|twist| twist.linear_m_s.norm() > 0.1)
        });
        let keyframe = keyframe.unwrap();
        let correction = CameraCorrection {
            rotation_rad: [0.02, -0.05, 0.03],
            translation_m: [0.01, 0.0, -0.02],
            ..CameraCorrection::default()
        };
        let camera = MovingCamera::new(keyframe, &correction);
        let raw_from_corrected = keyframe.world_from_camera.inverse() * camera.world_from_camera;
        for share in [-0.5, 0.2] {
            let ray = Vector2::new(0.3, -0.2);
            let px = [0, 1]
                .map(|axis| ray[axis] * keyframe.focal_px[axis] + keyframe.principal_px[axis]);
            let sighting = camera.sighting(&Corner::at(px, share));
            let raw_from_moved_raw =
                transform::exp(&keyframe.twist.unwrap(), share * keyframe.readout_secs);
            let moved = raw_from_corrected.inverse() * raw_from_moved_raw * raw_from_corrected;
            let turned = moved.rotation * ray.push(1.0);
            assert!(
                (sighting.ray - turned.xy() / turned.z).norm() < 1e-5,
                "{share}"
            );
            assert!(
                (sighting.center_m - moved.translation.vector).norm() < 1e-5,
                "{share}"
            );
        }
    }
}
