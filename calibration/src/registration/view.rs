//! Views of images with the current corrections, and their derivatives with respect to each
//! parameter.

use super::layout::Layout;
use super::prepared_image::PreparedImage;
use crate::CameraCorrection;
use kinematics::{Transform, Twist};
use nalgebra::{Matrix3, Vector3};

/// A rigid motion with a rotation matrix, which transforms many points faster than a quaternion.
#[derive(Clone, Copy, Debug)]
pub(super) struct RigidTransform {
    pub(super) rotation: Matrix3<f64>,
    pub(super) translation: Vector3<f64>,
}

impl RigidTransform {
    fn of(transform: &Transform) -> Self {
        Self {
            rotation: transform.rotation.to_rotation_matrix().into_inner(),
            translation: transform.translation.vector,
        }
    }

    pub(super) fn apply(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point + self.translation
    }

    pub(super) fn apply_inverse(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation.tr_mul(&(point - self.translation))
    }
}

/// Unit motion of one part: along an axis for parts 0 to 2, or about an axis for parts 3 to 5.
pub(super) fn unit_twist(part: usize) -> Twist {
    let unit = |axis: usize| Vector3::from_fn(|row, _| if row == axis { 1.0 } else { 0.0 });
    let (linear_m_s, angular_rad_s) = if part < 3 {
        (unit(part), Vector3::zeros())
    } else {
        (Vector3::zeros(), unit(part - 3))
    };
    Twist {
        linear_m_s,
        angular_rad_s,
    }
}

/// View of an image with the current corrections.
#[derive(Clone, Debug)]
pub(super) struct CorrectedView {
    pub(super) world_from_camera: RigidTransform,
    pub(super) color_from_depth: RigidTransform,
    pub(super) focal_px: [f64; 2],
    pub(super) principal_px: [f64; 2],
    /// Focal lengths of the keyframe. Lens parameters are relative to these focal lengths.
    pub(super) keyframe_focal_px: [f64; 2],
    pub(super) height_px: f64,
    pub(super) twist: Twist,
    pub(super) readout_secs: f64,
    pub(super) depth_focal_px: [f64; 2],
    pub(super) depth_principal_px: [f64; 2],
    pub(super) depth_factor: f64,
    /// Motion of the camera per unit of each parameter, in the camera's axes. Each entry has the
    /// parameter index, the translation in meters and the rotation in radians.
    pub(super) columns: Vec<(usize, Vector3<f64>, Vector3<f64>)>,
    pub(super) depth_pose: Option<usize>,
    pub(super) lens: Option<usize>,
    pub(super) depth_scale: Option<usize>,
    pub(super) readout: Option<usize>,
    pub(super) shares_lens: bool,
}

impl CorrectedView {
    pub(super) fn new(
        image: &PreparedImage,
        correction: &CameraCorrection,
        layout: &Layout,
    ) -> Option<Self> {
        let keyframe = image.keyframe.as_ref();
        let depth = keyframe.depth.as_ref()?;
        let posed = correction.apply(keyframe);
        let raw_from_corrected = keyframe.world_from_camera.inverse() * posed.world_from_camera;
        let params = layout.of_camera(image.camera);
        let twist_of_corrected = keyframe
            .twist
            .map(|twist| twist.of_attached(&raw_from_corrected));
        let mut columns = params.motions(twist_of_corrected.as_ref());
        // Velocities per joint are given at the raw camera. Joints are corrected before drift and
        // extrinsics, so their motion is converted to the axes of the corrected camera.
        if let Some(joints) = layout.joints() {
            let time_corrected_from_corrected =
                correction.time_corrected_from_input(keyframe) * raw_from_corrected;
            for (joint, twist) in keyframe.joint_twists.iter().enumerate() {
                let twist = twist.of_attached(&time_corrected_from_corrected);
                columns.push((joints + joint, twist.linear_m_s, twist.angular_rad_s));
            }
        }
        // Depth that was registered to the color image also has the errors of the color lens.
        let mut depth_focal_px = depth.focal_px;
        let mut depth_principal_px = depth.principal_px;
        if image.shares_lens {
            for axis in 0..2 {
                depth_focal_px[axis] = depth.focal_px[axis] * correction.log_focal[axis].exp();
                depth_principal_px[axis] = depth.principal_px[axis]
                    + correction.principal_offset_focals[axis] * depth.focal_px[axis];
            }
        }
        Some(Self {
            world_from_camera: RigidTransform::of(&posed.world_from_camera),
            color_from_depth: RigidTransform::of(&correction.color_from_depth(keyframe, depth)),
            focal_px: posed.focal_px,
            principal_px: posed.principal_px,
            keyframe_focal_px: keyframe.focal_px,
            height_px: f64::from(keyframe.size_px[1]),
            twist: keyframe.twist.map_or(Twist::zero(), |twist| {
                twist.of_attached(&raw_from_corrected)
            }),
            readout_secs: (keyframe.readout_secs + correction.readout_secs).max(0.0),
            depth_focal_px,
            depth_principal_px,
            depth_factor: correction.log_depth_scale.exp(),
            columns,
            depth_pose: params.depth_pose,
            lens: params.lens,
            depth_scale: params.depth_scale,
            readout: params.readout,
            shares_lens: image.shares_lens,
        })
    }

    /// The view with another camera pose, for a camera that moves rigidly with a frame. Parameters
    /// 0 to 5 are the motion of the frame in its own axes (meters, then radians).
    pub(super) fn moved_with_frame(
        &self,
        world_from_camera: &Transform,
        world_from_frame: &Transform,
    ) -> Self {
        let frame_from_camera = world_from_frame.inverse() * world_from_camera;
        let columns = (0..6)
            .map(|param| {
                let twist = unit_twist(param).of_attached(&frame_from_camera);
                (param, twist.linear_m_s, twist.angular_rad_s)
            })
            .collect();
        Self {
            world_from_camera: RigidTransform::of(world_from_camera),
            columns,
            ..self.clone()
        }
    }

    /// Indices of all parameters that affect the view, ascending.
    pub(super) fn params(&self) -> Vec<usize> {
        let mut params: Vec<usize> = self.columns.iter().map(|(param, _, _)| *param).collect();
        let range = |begin: Option<usize>, n: usize| {
            begin.into_iter().flat_map(move |begin| begin..begin + n)
        };
        params.extend(range(self.depth_pose, 6));
        params.extend(range(self.lens, 4));
        params.extend(range(self.depth_scale, 1));
        params.extend(range(self.readout, 1));
        params.sort_unstable();
        params
    }

    /// Computes the camera-frame position of a static point at the readout time of its row from its
    /// position at mid-exposure. Also returns this readout time as a share of the total readout
    /// time.
    pub(super) fn at_readout(&self, still: &Vector3<f64>) -> (Vector3<f64>, f64) {
        if self.readout_secs == 0.0 {
            return (*still, 0.0);
        }
        // The row depends on the position, and the position depends on the time of the row. Two
        // iterations are sufficient, because points move by a few rows at most during the readout.
        let drift = -self.readout_secs * self.twist.apparent_velocity(still);
        let mut at = *still;
        let mut share = 0.0;
        for _ in 0..2 {
            let row = self.focal_px[1] * at.y / at.z + self.principal_px[1];
            share = (row / self.height_px).clamp(0.0, 1.0) - 0.5;
            at = still - drift * share;
        }
        (at, share)
    }

    pub(super) fn pixel(&self, point: &Vector3<f64>) -> [f64; 2] {
        [0, 1].map(|axis| self.focal_px[axis] * point[axis] / point.z + self.principal_px[axis])
    }

    pub(super) fn depth_pixel(&self, point: &Vector3<f64>) -> [f64; 2] {
        [0, 1].map(|axis| {
            self.depth_focal_px[axis] * point[axis] / point.z + self.depth_principal_px[axis]
        })
    }
}
