//! Calibration corrections of one camera, and their application to keyframes.

use keyframe::masked_robot::Pinhole;
use keyframe::{DepthMap, Keyframe, MaskViews, Shutter};
use kinematics::{Stamp, Transform, Twist, transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use numbers::f32_of;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Estimated calibration correction of one camera.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraCorrection {
    /// Rotation vector in the camera's own axes, radians. The rotation is applied after
    /// `camera_from_world`, and the translation after the rotation.
    pub rotation_rad: [f64; 3],
    /// Translation in the camera's axes, meters.
    pub translation_m: [f64; 3],
    /// Time from the stamp at which the pose was computed to the exposure of the image, seconds.
    pub time_offset_secs: f64,
    /// Logarithm of the factor on the focal lengths.
    pub log_focal: [f64; 2],
    /// Offset of the principal point, in focal lengths.
    pub principal_offset_focals: [f64; 2],
    /// Offsets added to the readings of the joints that carry the camera, radians or meters. The
    /// list may be empty.
    pub joint_offsets: Vec<f64>,
    /// Rotation vector in the camera's own axes, radians. The rotation is applied after
    /// `color_from_depth`, and the translation after the rotation.
    pub depth_rotation_rad: [f64; 3],
    /// Translation in the camera's axes, meters.
    pub depth_translation_m: [f64; 3],
    /// Logarithm of the factor on depth readings.
    pub log_depth_scale: f64,
    /// Offset added to the readout time, seconds.
    pub readout_secs: f64,
    /// Pose correction of each training image, by stamp in nanoseconds: rotation vector (radians)
    /// and translation (meters). Between images, the correction is interpolated linearly.
    pub drift: BTreeMap<i64, [f64; 6]>,
    /// Share of the interpolated drift that is applied to images without an entry in `drift`, 0 to
    /// 1.
    pub drift_weight: f64,
    /// Logarithms of the gains of red, green and blue of each training image, by stamp in
    /// nanoseconds.
    pub log_gains: BTreeMap<i64, [f64; 3]>,
    /// Appearance embedding of each training image in a neural field, by stamp in nanoseconds. The
    /// values have no meaning outside this field.
    pub appearance_embeddings: BTreeMap<i64, [f64; EMBEDDING_DIM]>,
}

/// Dimension of an appearance embedding.
pub const EMBEDDING_DIM: usize = 1;

impl Default for CameraCorrection {
    fn default() -> Self {
        Self {
            rotation_rad: [0.0; 3],
            translation_m: [0.0; 3],
            time_offset_secs: 0.0,
            log_focal: [0.0; 2],
            principal_offset_focals: [0.0; 2],
            joint_offsets: Vec::new(),
            depth_rotation_rad: [0.0; 3],
            depth_translation_m: [0.0; 3],
            log_depth_scale: 0.0,
            readout_secs: 0.0,
            drift: BTreeMap::new(),
            drift_weight: 1.0,
            log_gains: BTreeMap::new(),
            appearance_embeddings: BTreeMap::new(),
        }
    }
}

/// A pinhole camera with its pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CalibratedCamera {
    /// Pose of the camera in the world.
    pub world_from_camera: Transform,
    /// Focal length, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels.
    pub principal_px: [f64; 2],
    /// Motion of the camera while its rows are read out, if known.
    pub shutter: Option<Shutter>,
    /// Pose of the depth frame in the camera frame, if there is depth.
    pub color_from_depth: Option<Transform>,
    /// Factors on red, green and blue that match a render to the exposure and white balance of the
    /// image.
    pub gains: [f64; 3],
}

/// Relative differences of focal lengths up to this value are negligible. At the border of an image
/// of 1280 px, this value corresponds to 0.6 px.
const NOTICEABLE_FOCAL: f64 = 1e-3;

impl CalibratedCamera {
    /// Whether another calibration of the same image has a noticeably different pose or focal
    /// length.
    pub fn differs_noticeably(&self, other: &Self) -> bool {
        let motion = self.world_from_camera.inverse() * other.world_from_camera;
        let focal_change =
            (0..2).map(|axis| (other.focal_px[axis] / self.focal_px[axis] - 1.0).abs());
        transform::is_noticeable(&motion) || focal_change.fold(0.0, f64::max) > NOTICEABLE_FOCAL
    }

    /// The uncorrected camera of a keyframe.
    pub fn of(keyframe: &Keyframe) -> Self {
        Self {
            world_from_camera: keyframe.world_from_camera,
            focal_px: keyframe.focal_px,
            principal_px: keyframe.principal_px,
            shutter: keyframe.twist.map(|twist| Shutter {
                twist,
                readout_secs: keyframe.readout_secs,
            }),
            color_from_depth: keyframe
                .depth
                .as_ref()
                .map(|depth| keyframe.world_from_camera.inverse() * depth.world_from_camera),
            gains: [1.0; 3],
        }
    }
}

impl CameraCorrection {
    /// The correction without the parts that apply to single images.
    #[must_use]
    pub fn of_all_images(self) -> Self {
        Self {
            drift: BTreeMap::new(),
            log_gains: BTreeMap::new(),
            appearance_embeddings: BTreeMap::new(),
            ..self
        }
    }

    /// The corrected camera of a keyframe. [`CalibratedCamera::of`] returns the uncorrected camera.
    pub fn apply(&self, keyframe: &Keyframe) -> CalibratedCamera {
        let lens = CalibratedCamera::of(keyframe);
        // Each correction is a motion in camera axes, from the raw to the corrected camera.
        let time_offset = self.time_corrected_from_input(keyframe);
        let mut by_joints = Twist::zero();
        for (twist, offset) in keyframe.joint_twists.iter().zip(&self.joint_offsets) {
            by_joints.linear_m_s += twist.linear_m_s * *offset;
            by_joints.angular_rad_s += twist.angular_rad_s * *offset;
        }
        let joints = transform::exp(&by_joints, -1.0);
        let extrinsics = rigid_transform(self.rotation_rad.into(), self.translation_m.into());
        let [rotation_x, rotation_y, rotation_z, x, y, z] = self.drift_at(keyframe.stamp);
        let drift = rigid_transform(
            Vector3::new(rotation_x, rotation_y, rotation_z),
            Vector3::new(x, y, z),
        );
        // From right to left, the factors correct the time of the exposure, the joints, the pose of
        // this image, and the extrinsics of the camera. This is the order in which the errors
        // arise.
        let world_from_camera =
            (extrinsics * drift * joints * time_offset * lens.world_from_camera.inverse())
                .inverse();
        // Velocities are given at the raw camera. At the corrected camera, they differ because of
        // the lever arm between the two.
        let raw_from_corrected = lens.world_from_camera.inverse() * world_from_camera;
        let shutter = |shutter: Shutter| Shutter {
            twist: shutter.twist.of_attached(&raw_from_corrected),
            readout_secs: (shutter.readout_secs + self.readout_secs).max(0.0),
        };
        CalibratedCamera {
            world_from_camera,
            shutter: lens.shutter.map(shutter),
            focal_px: std::array::from_fn(|axis| lens.focal_px[axis] * self.log_focal[axis].exp()),
            principal_px: std::array::from_fn(|axis| {
                lens.principal_px[axis] + self.principal_offset_focals[axis] * lens.focal_px[axis]
            }),
            color_from_depth: keyframe
                .depth
                .as_ref()
                .map(|depth| self.color_from_depth(keyframe, depth)),
            gains: interpolate(&self.log_gains, keyframe.stamp)
                .unwrap_or_default()
                .map(f64::exp),
        }
    }

    /// Drift of an image. An image with an entry in `drift` has the drift of this entry. For other
    /// images, the drift is interpolated between the neighbors in time and multiplied by
    /// `drift_weight`.
    pub fn drift_at(&self, stamp: Stamp) -> [f64; 6] {
        let share = if self.drift.contains_key(&stamp.0) {
            1.0
        } else {
            self.drift_weight
        };
        interpolate(&self.drift, stamp)
            .unwrap_or_default()
            .map(|part| share * part)
    }

    /// Motion of the camera from the uncorrected pose to the pose at the exposure of the image.
    pub fn time_corrected_from_input(&self, keyframe: &Keyframe) -> Transform {
        keyframe.twist.map_or(Transform::identity(), |twist| {
            rigid_transform(
                -self.time_offset_secs * twist.angular_rad_s,
                -self.time_offset_secs * twist.linear_m_s,
            )
        })
    }

    /// Corrected pose of a keyframe's depth frame in its color frame.
    pub fn color_from_depth(&self, keyframe: &Keyframe, depth: &DepthMap) -> Transform {
        let rigid_transform = rigid_transform(
            self.depth_rotation_rad.into(),
            self.depth_translation_m.into(),
        );
        rigid_transform * keyframe.world_from_camera.inverse() * depth.world_from_camera
    }

    /// The keyframe with corrected pose, intrinsics, depth and readout time. The mask of a robot is
    /// drawn again for the corrected camera.
    pub fn corrected(&self, keyframe: &Keyframe) -> Keyframe {
        self.moved(&self.remasked(keyframe))
    }

    /// The keyframe with the mask of the robot as the corrected camera sees it. Its calibration
    /// stays the same. Only extrinsics, lens and pose of the depth frame move the mask: the other
    /// corrections move the camera relative to the robot by less than the margin of the mask, or
    /// not at all.
    pub fn remasked(&self, keyframe: &Keyframe) -> Keyframe {
        let mut remasked = keyframe.clone();
        let Some(robot) = keyframe.robot.as_ref().filter(|_| self.moves_robot()) else {
            return remasked;
        };
        let [corrected_from_camera, depth_correction] = [
            (self.rotation_rad, self.translation_m),
            (self.depth_rotation_rad, self.depth_translation_m),
        ]
        .map(|(rotation_rad, translation_m)| {
            rigid_transform(rotation_rad.into(), translation_m.into())
        });
        let robot = robot.seen_by_corrected(&corrected_from_camera, &depth_correction);
        let mut views = MaskViews::of(keyframe);
        self.correct_view(&mut views.color);
        if let (Some(view), Some(depth)) = (&mut views.depth, &keyframe.depth)
            && shares_lens(keyframe, depth)
        {
            self.correct_view(view);
        }
        remasked.mask_robot(robot, &views);
        remasked
    }

    /// Whether the correction moves the robot in the image.
    fn moves_robot(&self) -> bool {
        let poses = [
            self.rotation_rad,
            self.translation_m,
            self.depth_rotation_rad,
            self.depth_translation_m,
        ];
        let lens = [self.log_focal, self.principal_offset_focals];
        poses.as_flattened().iter().any(|number| *number != 0.0)
            || lens.as_flattened().iter().any(|number| *number != 0.0)
    }

    fn correct_view(&self, view: &mut Pinhole) {
        let focal_px = view.focal_px;
        view.focal_px = std::array::from_fn(|axis| focal_px[axis] * self.log_focal[axis].exp());
        for (axis, principal_px) in view.principal_px.iter_mut().enumerate() {
            *principal_px += self.principal_offset_focals[axis] * focal_px[axis];
        }
    }

    /// The keyframe with corrected pose, intrinsics, depth and readout time. The mask of a robot is
    /// not drawn again.
    pub fn moved(&self, keyframe: &Keyframe) -> Keyframe {
        let CalibratedCamera {
            world_from_camera,
            focal_px,
            principal_px,
            ..
        } = self.apply(keyframe);
        // Without a correction, the readings are shared instead of copied.
        let factor = f32_of(self.log_depth_scale.exp());
        let depth = keyframe.depth.as_ref().map(|depth| {
            let has_same_lens = shares_lens(keyframe, depth);
            let focal = |axis: usize| depth.focal_px[axis] * self.log_focal[axis].exp();
            let principal = |axis: usize| {
                depth.principal_px[axis] + self.principal_offset_focals[axis] * depth.focal_px[axis]
            };
            DepthMap {
                size_px: depth.size_px,
                focal_px: if has_same_lens {
                    [0, 1].map(focal)
                } else {
                    depth.focal_px
                },
                principal_px: if has_same_lens {
                    [0, 1].map(principal)
                } else {
                    depth.principal_px
                },
                depth_m: match factor {
                    1.0 => depth.depth_m.clone(),
                    factor => depth.depth_m.iter().map(|z| z * factor).collect(),
                },
                world_from_camera: world_from_camera * self.color_from_depth(keyframe, depth),
            }
        });
        let raw_from_corrected = keyframe.world_from_camera.inverse() * world_from_camera;
        Keyframe {
            focal_px,
            principal_px,
            depth,
            world_from_camera,
            twist: keyframe
                .twist
                .map(|twist| twist.of_attached(&raw_from_corrected)),
            readout_secs: (keyframe.readout_secs + self.readout_secs).max(0.0),
            joint_twists: keyframe
                .joint_twists
                .iter()
                .map(|twist| twist.of_attached(&raw_from_corrected))
                .collect(),
            robot: match &keyframe.robot {
                Some(robot) if factor != 1.0 => Some(Arc::new(robot.with_depth_scaled(factor))),
                robot => robot.clone(),
            },
            ..keyframe.clone()
        }
    }
}

/// Linear interpolation at a stamp between the entries before and after it. `None` if there are no
/// entries.
pub fn interpolate<const N: usize>(
    known: &BTreeMap<i64, [f64; N]>,
    stamp: Stamp,
) -> Option<[f64; N]> {
    let before = known.range(..=stamp.0).next_back();
    let after = known.range(stamp.0..).next();
    match (before, after) {
        (Some((begin, from)), Some((end, to))) if end > begin => {
            let share = (stamp.0 - begin) as f64 / (end - begin) as f64;
            Some(std::array::from_fn(|ix| {
                from[ix] + share * (to[ix] - from[ix])
            }))
        }
        (Some((_, value)), _) | (None, Some((_, value))) => Some(*value),
        (None, None) => None,
    }
}

/// Share of the interpolated drift that applies to images without an entry, 0 to 1.
///
/// Leaves out each image in turn and predicts its drift from its neighbors in time. Returns 1 minus
/// the ratio of the squared prediction errors to the squared drifts.
///
/// Returns 0 if the errors of images are independent, if predicting is worse than assuming no
/// drift, or if there are too few images.
///
/// * `scene_size_m`: lever arm that converts rotations to lengths.
pub fn drift_weight(drift: &BTreeMap<i64, [f64; 6]>, scene_size_m: f64) -> f64 {
    /// Smaller weights are set to zero, because they may be due to chance.
    const MIN_WEIGHT: f64 = 0.2;
    let known: Vec<(f64, &[f64; 6])> = drift
        .iter()
        .map(|(stamp, parts)| (*stamp as f64, parts))
        .collect();
    // Squared length of a motion.
    let squares = |parts: [f64; 6]| {
        let [rotation, translation] =
            [&parts[..3], &parts[3..]].map(|parts| parts.iter().map(|x| x * x).sum::<f64>());
        rotation * scene_size_m * scene_size_m + translation
    };
    let mut residual = 0.0;
    let mut all = 0.0;
    for neighbors in known.windows(3) {
        let [(begin, from), (stamp, own), (end, to)] = [neighbors[0], neighbors[1], neighbors[2]];
        let frac = (stamp - begin) / (end - begin);
        residual += squares(std::array::from_fn(|ix| {
            own[ix] - from[ix] - frac * (to[ix] - from[ix])
        }));
        all += squares(*own);
    }
    let share = if all > 0.0 { 1.0 - residual / all } else { 0.0 };
    if share < MIN_WEIGHT { 0.0 } else { share }
}

/// The rigid motion that rotates by a rotation vector, then translates.
pub fn rigid_transform(rotation_rad: Vector3<f64>, translation_m: Vector3<f64>) -> Transform {
    Transform::from_parts(
        Translation3::from(translation_m),
        UnitQuaternion::from_scaled_axis(rotation_rad),
    )
}

/// Whether the depth image has the same lens as the color image, for example because it was
/// registered to the color image. If so, lens corrections apply to both.
pub fn shares_lens(keyframe: &Keyframe, depth: &DepthMap) -> bool {
    // Sizes are rounded to pixels.
    const TOLERANCE_FRAC: f64 = 1e-4;
    [0, 1].into_iter().all(|axis| {
        let share = f64::from(depth.size_px[axis]) / f64::from(keyframe.size_px[axis]);
        let difference_px = (depth.focal_px[axis] - share * keyframe.focal_px[axis]).abs()
            + (depth.principal_px[axis] - share * keyframe.principal_px[axis]).abs();
        difference_px <= TOLERANCE_FRAC * depth.focal_px[axis]
    })
}
