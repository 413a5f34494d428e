//! Per-camera parameters that are optimized together with the splats: extrinsics, time offset, lens and exposure.
//!
//! All images of a camera share its parameters; each image can have its own in addition. Nothing is read back during
//! training: `correct_view` prepares the view of a step, and `refine_camera` updates its parameters.

use super::kernels::LearnPipelines;
use super::params::{CameraRule, Lens, N_PARAMS};
use super::passes::ViewPasses;
use crate::checkpoint::Checkpoint;
use crate::gpu::{Buffer, Gpu, Passes, Pipeline, f32_of, f32s_of};
use crate::{DepthMap, Error, Keyframe, Shutter};
use kinematics::{Stamp, Transform, Twist, transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The set of camera parameters to estimate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct ParamSet {
    /// Extrinsics of each camera: rotation and translation relative to its parent (hand-eye if the parent is the
    /// flange).
    pub extrinsics: bool,
    /// Time by which the poses of each camera lag behind its images.
    pub time_offset: bool,
    /// Focal lengths and principal point of each camera.
    pub lens: bool,
    /// A small pose error of each image.
    pub image_poses: bool,
    /// Gains of red, green and blue of each image.
    pub image_gains: bool,
    /// Offset added to the reading of each joint that carries a camera. Only alignment estimates this parameter and
    /// the following ones.
    pub joints: bool,
    /// Pose of the depth frame in the camera frame.
    pub depth_pose: bool,
    /// Factor on depth readings.
    pub depth_scale: bool,
    /// Time from the exposure of the first row to that of the last row.
    pub readout: bool,
}

impl ParamSet {
    /// No parameters.
    pub const NONE: Self = Self {
        extrinsics: false,
        time_offset: false,
        lens: false,
        image_poses: false,
        image_gains: false,
        joints: false,
        depth_pose: false,
        depth_scale: false,
        readout: false,
    };

    /// Whether the set contains any parameter.
    pub fn any(self) -> bool {
        self != Self::NONE
    }

    /// Union of both sets.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self {
            extrinsics: self.extrinsics || other.extrinsics,
            time_offset: self.time_offset || other.time_offset,
            lens: self.lens || other.lens,
            image_poses: self.image_poses || other.image_poses,
            image_gains: self.image_gains || other.image_gains,
            joints: self.joints || other.joints,
            depth_pose: self.depth_pose || other.depth_pose,
            depth_scale: self.depth_scale || other.depth_scale,
            readout: self.readout || other.readout,
        }
    }

    fn camera_mask(self) -> u32 {
        let bits = |on: bool, bits: u32| if on { bits } else { 0 };
        bits(self.extrinsics, 0b11_1111) | bits(self.time_offset, 1 << 6) | bits(self.lens, 0b1111 << 7)
    }

    fn image_mask(self) -> u32 {
        let bits = |on: bool, bits: u32| if on { bits } else { 0 };
        bits(self.image_poses, 0b11_1111) | bits(self.image_gains, 0b111 << 11)
    }
}

impl std::fmt::Display for ParamSet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let names = [
            (self.extrinsics, "extrinsics"),
            (self.time_offset, "time offsets"),
            (self.lens, "lenses"),
            (self.image_poses, "image poses"),
            (self.image_gains, "image gains"),
            (self.joints, "joint offsets"),
            (self.depth_pose, "depth poses"),
            (self.depth_scale, "depth scales"),
            (self.readout, "readout times"),
        ];
        let names: Vec<&str> = names.into_iter().filter(|(on, _)| *on).map(|(_, name)| name).collect();
        f.write_str(&if names.is_empty() { "nothing".to_owned() } else { names.join(", ") })
    }
}

/// Estimated calibration correction of one camera.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct CameraCorrection {
    /// Rotation vector in the camera's own axes, radians. The rotation, then the translation, are applied after
    /// `camera_from_world`.
    pub rotation_rad: [f64; 3],
    /// Translation in the camera's axes, meters.
    pub translation_m: [f64; 3],
    /// Time from the nominal pose of an image to its exposure, seconds.
    pub time_offset_secs: f64,
    /// Logarithm of the factor on the focal lengths.
    pub log_focal: [f64; 2],
    /// Offset of the principal point, in focal lengths.
    pub principal_offset_focals: [f64; 2],
    /// Offsets added to the readings of the joints that carry the camera, radians or meters; may be empty.
    pub joint_offsets: Vec<f64>,
    /// Rotation vector in the camera's own axes, radians. The rotation, then the translation, are applied after
    /// `color_from_depth`.
    pub depth_rotation_rad: [f64; 3],
    /// Translation in the camera's axes, meters.
    pub depth_translation_m: [f64; 3],
    /// Logarithm of the factor on depth readings.
    pub log_depth_scale: f64,
    /// Offset added to the readout time, seconds.
    pub readout_secs: f64,
    /// Rotation vector (radians) and translation (meters) of each training image, by stamp in nanoseconds;
    /// interpolated linearly in between.
    pub drift: BTreeMap<i64, [f64; 6]>,
    /// Share of the interpolated drift that is applied to images that were not trained on, 0 to 1.
    pub drift_weight: f64,
    /// Logarithms of the gains of red, green and blue of each training image, by stamp in nanoseconds.
    pub log_gains: BTreeMap<i64, [f64; 3]>,
    /// Appearance embeddings of each training image in a neural field, by stamp in nanoseconds. The values have no
    /// meaning outside the field.
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
    /// Factors on red, green and blue of a picture that match it to the image: exposure and white balance.
    pub gains: [f64; 3],
}

impl CalibratedCamera {
    /// The camera of a keyframe without any correction.
    pub fn of(keyframe: &Keyframe) -> Self {
        Self {
            world_from_camera: keyframe.world_from_camera,
            focal_px: keyframe.focal_px,
            principal_px: keyframe.principal_px,
            shutter: keyframe.twist.map(|twist| Shutter { twist, readout_secs: keyframe.readout_secs }),
            color_from_depth: keyframe
                .depth
                .as_ref()
                .map(|depth| keyframe.world_from_camera.inverse() * depth.world_from_camera),
            gains: [1.0; 3],
        }
    }
}

impl CameraCorrection {
    /// The corrected camera of a keyframe; [`CalibratedCamera::of`] is the uncorrected one.
    pub fn apply(&self, keyframe: &Keyframe) -> CalibratedCamera {
        let lens = CalibratedCamera::of(keyframe);
        let time_offset = self.time_corrected_from_input(keyframe);
        let mut by_joints = Twist::zero();
        for (twist, offset) in keyframe.joint_twists.iter().zip(&self.joint_offsets) {
            by_joints.linear_m_s += twist.linear_m_s * *offset;
            by_joints.angular_rad_s += twist.angular_rad_s * *offset;
        }
        let joints = transform::exp(&by_joints, -1.0);
        let extrinsics = rigid_transform(self.rotation_rad.into(), self.translation_m.into());
        let [rotation_x, rotation_y, rotation_z, x, y, z] = self.drift_at(keyframe.stamp);
        let drift = rigid_transform(Vector3::new(rotation_x, rotation_y, rotation_z), Vector3::new(x, y, z));
        let world_from_camera =
            (extrinsics * drift * joints * time_offset * lens.world_from_camera.inverse()).inverse();
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
            color_from_depth: keyframe.depth.as_ref().map(|depth| self.color_from_depth(keyframe, depth)),
            gains: interpolate(&self.log_gains, keyframe.stamp).unwrap_or_default().map(f64::exp),
        }
    }

    /// Drift of an image: its own, or the weighted interpolation between its neighbors in time.
    pub(crate) fn drift_at(&self, stamp: Stamp) -> [f64; 6] {
        let share = if self.drift.contains_key(&stamp.0) { 1.0 } else { self.drift_weight };
        interpolate(&self.drift, stamp).unwrap_or_default().map(|part| share * part)
    }

    /// Transform from the uncorrected camera to the camera at the exposure of the image.
    pub(crate) fn time_corrected_from_input(&self, keyframe: &Keyframe) -> Transform {
        keyframe.twist.map_or(Transform::identity(), |twist| {
            rigid_transform(-self.time_offset_secs * twist.angular_rad_s, -self.time_offset_secs * twist.linear_m_s)
        })
    }

    /// Corrected pose of a keyframe's depth frame in its color frame.
    pub fn color_from_depth(&self, keyframe: &Keyframe, depth: &DepthMap) -> Transform {
        let rigid_transform = rigid_transform(self.depth_rotation_rad.into(), self.depth_translation_m.into());
        rigid_transform * keyframe.world_from_camera.inverse() * depth.world_from_camera
    }

    /// The keyframe with corrected pose, intrinsics, depth and readout time.
    pub fn corrected(&self, keyframe: &Keyframe) -> Keyframe {
        let CalibratedCamera { world_from_camera, focal_px, principal_px, .. } = self.apply(keyframe);
        let depth = keyframe.depth.as_ref().map(|depth| {
            let has_same_lens = shares_lens(keyframe, depth);
            let focal = |axis: usize| depth.focal_px[axis] * self.log_focal[axis].exp();
            let principal =
                |axis: usize| depth.principal_px[axis] + self.principal_offset_focals[axis] * depth.focal_px[axis];
            let factor = f32_of(self.log_depth_scale.exp());
            DepthMap {
                size_px: depth.size_px,
                focal_px: if has_same_lens { [0, 1].map(focal) } else { depth.focal_px },
                principal_px: if has_same_lens { [0, 1].map(principal) } else { depth.principal_px },
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
            twist: keyframe.twist.map(|twist| twist.of_attached(&raw_from_corrected)),
            readout_secs: (keyframe.readout_secs + self.readout_secs).max(0.0),
            joint_twists: keyframe.joint_twists.iter().map(|twist| twist.of_attached(&raw_from_corrected)).collect(),
            ..keyframe.clone()
        }
    }
}

/// Linear interpolation at a stamp between the entries before and after it; `None` if there are no entries.
pub(crate) fn interpolate<const N: usize>(known: &BTreeMap<i64, [f64; N]>, stamp: Stamp) -> Option<[f64; N]> {
    let before = known.range(..=stamp.0).next_back();
    let after = known.range(stamp.0..).next();
    match (before, after) {
        (Some((begin, from)), Some((end, to))) if end > begin => {
            let share = (stamp.0 - begin) as f64 / (end - begin) as f64;
            Some(std::array::from_fn(|ix| from[ix] + share * (to[ix] - from[ix])))
        }
        (Some((_, value)), _) | (None, Some((_, value))) => Some(*value),
        (None, None) => None,
    }
}

/// Share of the drift between images that also applies to other images, 0 to 1.
///
/// Leaves out each image, predicts its drift from its neighbors in time, and returns 1 minus the ratio of the squared
/// prediction errors to the squared drifts.
///
/// Returns 0 if the errors of images are independent, if predicting is worse than assuming no drift, or if there are
/// too few images.
///
/// * `scene_size_m`: lever arm that converts rotations to lengths.
pub(crate) fn drift_weight(drift: &BTreeMap<i64, [f64; 6]>, scene_size_m: f64) -> f64 {
    /// Smaller weights may be due to chance.
    const MIN_WEIGHT: f64 = 0.2;
    let known: Vec<(f64, &[f64; 6])> = drift.iter().map(|(stamp, parts)| (*stamp as f64, parts)).collect();
    let squares = |parts: [f64; 6]| {
        let [rotation, translation] = [&parts[..3], &parts[3..]].map(|parts| parts.iter().map(|x| x * x).sum::<f64>());
        rotation * scene_size_m * scene_size_m + translation
    };
    let (mut residual, mut all) = (0.0, 0.0);
    for neighbors in known.windows(3) {
        let [(begin, from), (stamp, own), (end, to)] = [neighbors[0], neighbors[1], neighbors[2]];
        let frac = (stamp - begin) / (end - begin);
        residual += squares(std::array::from_fn(|ix| own[ix] - from[ix] - frac * (to[ix] - from[ix])));
        all += squares(*own);
    }
    let share = if all > 0.0 { 1.0 - residual / all } else { 0.0 };
    if share < MIN_WEIGHT { 0.0 } else { share }
}

/// Rotation, then translation.
pub(crate) fn rigid_transform(rotation_rad: Vector3<f64>, translation_m: Vector3<f64>) -> Transform {
    Transform::from_parts(Translation3::from(translation_m), UnitQuaternion::from_scaled_axis(rotation_rad))
}

/// Whether the depth image has the lens of the color image, for example because it was registered to it. If so, lens
/// corrections apply to both.
pub(crate) fn shares_lens(keyframe: &Keyframe, depth: &DepthMap) -> bool {
    const TOLERANCE_FRAC: f64 = 1e-4; // Sizes are rounded to pixels.
    [0, 1].into_iter().all(|axis| {
        let share = f64::from(depth.size_px[axis]) / f64::from(keyframe.size_px[axis]);
        let difference_px = (depth.focal_px[axis] - share * keyframe.focal_px[axis]).abs()
            + (depth.principal_px[axis] - share * keyframe.principal_px[axis]).abs();
        difference_px <= TOLERANCE_FRAC * depth.focal_px[axis]
    })
}

/// Index of the first gain among the parameters, as in `shared/camera_params.wgsl`.
const LOG_GAIN: u32 = 11;
/// Initial learning rate of rotations, radians per step; the other rates are derived from it.
const ROTATION_RATE: f64 = 1e-3;
/// Fraction of the rates that remains at the end of the planned steps.
const FINAL_FRAC: f64 = 0.01;
const IMAGE_DECAY: f64 = 0.001;

/// The camera parameters on the GPU.
#[derive(Debug)]
pub(crate) struct CameraParams {
    pub(crate) set: ParamSet,
    pub(crate) params: Buffer,
    rule: Buffer,
    /// View of the current step.
    pub(crate) corrected: Buffer,
    pub(crate) gains: Buffer,
    cameras: BTreeMap<Arc<str>, Slots>,
    n_used: u32,
}

/// For each camera, the slot of its parameters and the slots of its images by stamp in nanoseconds.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub(crate) struct CameraSlots(BTreeMap<String, (u32, BTreeMap<i64, u32>)>);

/// Slots of [`N_PARAMS`] parameters for a camera and for its images.
#[derive(Debug)]
struct Slots {
    camera: u32,
    images: BTreeMap<Stamp, u32>,
}

impl CameraParams {
    pub(crate) fn new(gpu: &Gpu, set: ParamSet) -> Result<Self, Error> {
        Ok(Self {
            set,
            params: gpu.storage("splat.camera_params", SLOT_BYTES)?,
            rule: gpu.uniform_with("splat.camera_rule", &<CameraRule as bytemuck::Zeroable>::zeroed()),
            corrected: gpu.uniform_and_storage("splat.corrected_view", size_of::<super::params::View>() as u64),
            gains: gpu.storage_with("splat.gains", bytemuck::cast_slice(&[1.0f32; 4]))?,
            cameras: BTreeMap::new(),
            n_used: 0,
        })
    }

    /// Adds parameters to the set that is optimized.
    pub(crate) fn enable(&mut self, more: ParamSet) {
        self.set = self.set.and(more);
    }

    /// Uploads the lens of a keyframe; allocates slots for the parameters of its camera and of the image if they are
    /// new.
    pub(crate) fn lens(&mut self, gpu: &Gpu, keyframe: &Keyframe) -> Result<Buffer, Error> {
        let camera = match self.cameras.get(&keyframe.camera) {
            Some(slots) => slots.camera,
            None => {
                let slots = Slots { camera: self.allocate_slot(gpu)?, images: BTreeMap::new() };
                self.cameras.entry(keyframe.camera.clone()).or_insert(slots).camera
            }
        };
        let known = self.cameras.get(&keyframe.camera).and_then(|slots| slots.images.get(&keyframe.stamp).copied());
        let image = match known {
            Some(slot) => slot,
            None => self.allocate_slot(gpu)?,
        };
        if let Some(slots) = self.cameras.get_mut(&keyframe.camera) {
            slots.images.insert(keyframe.stamp, image);
        }
        let part = |of: fn(&Twist) -> Vector3<f64>| {
            let [x, y, z] = keyframe.twist.as_ref().map_or([0.0; 3], |twist| f32s_of(of(twist).into()));
            [x, y, z, 0.0]
        };
        let lens = Lens {
            linear: part(|twist| twist.linear_m_s),
            angular: part(|twist| twist.angular_rad_s),
            camera_params: camera * N_PARAMS,
            image_params: image * N_PARAMS,
            unused: [0; 2],
        };
        Ok(gpu.uniform_with("splat.lens", &lens))
    }

    /// Sets the initial logarithms of the gains of an image.
    pub(crate) fn initialize_gains(&self, gpu: &Gpu, keyframe: &Keyframe, log_gains: [f64; 3]) {
        let slot = self.cameras.get(&keyframe.camera).and_then(|slots| slots.images.get(&keyframe.stamp));
        let values = log_gains.map(|value| [f32_of(value), 0.0, 0.0, 0.0]);
        if let Some(slot) = slot {
            gpu.write(
                &self.params,
                SLOT_BYTES * u64::from(*slot) + 16 * u64::from(LOG_GAIN),
                bytemuck::cast_slice(&values),
            );
        }
    }

    /// Copies all parameters.
    pub(crate) fn copy(&self, gpu: &Gpu) -> Result<Buffer, Error> {
        let copy = gpu.storage("splat.camera_params", self.params.bytes())?;
        gpu.copy((&self.params, 0), (&copy, 0), self.params.bytes());
        Ok(copy)
    }

    /// Restores a copy. Slots allocated since then stay allocated, with parameters of zero.
    pub(crate) fn restore_snapshot(&mut self, gpu: &Gpu, (set, params): (ParamSet, Buffer)) -> Result<(), Error> {
        self.set = set;
        if params.bytes() < self.used_bytes() {
            self.params = gpu.storage("splat.camera_params", self.used_bytes())?; // Zeros.
            gpu.copy((&params, 0), (&self.params, 0), params.bytes());
        } else {
            self.params = params;
        }
        Ok(())
    }

    fn allocate_slot(&mut self, gpu: &Gpu) -> Result<u32, Error> {
        self.n_used += 1;
        let bytes = SLOT_BYTES * u64::from(self.n_used);
        if bytes > self.params.bytes() {
            let larger = gpu.storage("splat.camera_params", 2 * bytes)?;
            gpu.copy((&self.params, 0), (&larger, 0), self.params.bytes());
            self.params = larger;
        }
        Ok(self.n_used - 1)
    }

    /// Uploads the learning rates; `progress` is the completed fraction of the planned steps.
    pub(crate) fn write_rule(&self, gpu: &Gpu, progress: f64, scene_size_m: f64) {
        let rate = ROTATION_RATE * FINAL_FRAC.powf(progress.clamp(0.0, 1.0));
        let rule = CameraRule {
            camera_mask: self.set.camera_mask(),
            image_mask: self.set.image_mask(),
            rotation_rate: f32_of(rate),
            translation_rate_m: f32_of(rate * scene_size_m),
            time_offset_rate: f32_of(rate),
            focal_rate: f32_of(rate),
            gain_rate: f32_of(10.0 * rate),
            image_decay: f32_of(IMAGE_DECAY),
        };
        gpu.write(&self.rule, 0, bytemuck::bytes_of(&rule));
    }

    /// Records the pass that prepares the view of a step.
    pub(crate) fn correct(&self, gpu: &Gpu, passes: &mut Passes, learn: &LearnPipelines, base: &Buffer, lens: &Buffer) {
        let buffers = [
            ("base", base),
            ("lens", lens),
            ("rule", &self.rule),
            ("params", &self.params),
            ("corrected", &self.corrected),
            ("gains", &self.gains),
        ];
        passes.dispatch(gpu, &learn.correct_view, 1, &buffers);
    }

    /// Records the pass that updates the parameters.
    pub(crate) fn refine(&self, view: &ViewPasses<'_>, passes: &mut Passes, learn: &LearnPipelines, lens: &Buffer) {
        self.refine_with(view, passes, &learn.refine_camera, lens);
    }

    pub(crate) fn refine_with(&self, view: &ViewPasses<'_>, passes: &mut Passes, refine: &Pipeline, lens: &Buffer) {
        let buffers = [
            ("view", view.view),
            ("model", &view.splats.model),
            ("lens", lens),
            ("rule", &self.rule),
            ("camera_sums", &view.scratch.camera_sums),
            ("gain_sums", &view.image_buffers.gain_sums),
            ("status", view.status),
            ("params", &self.params),
        ];
        passes.dispatch(view.gpu, refine, 1, &buffers);
    }

    /// Values of the first camera's parameters.
    #[cfg(test)]
    pub(crate) fn param_values(&self, gpu: &Gpu) -> Vec<f64> {
        let params: Vec<[f32; 4]> = gpu.read(&self.params, N_PARAMS as usize).unwrap();
        params.iter().map(|param| f64::from(param[0])).collect()
    }

    /// Bytes of the slots in use.
    pub(crate) fn used_bytes(&self) -> u64 {
        SLOT_BYTES * u64::from(self.n_used)
    }

    /// Slot assignment, for a checkpoint.
    pub(crate) fn slots(&self) -> CameraSlots {
        let images = |slots: &Slots| slots.images.iter().map(|(stamp, slot)| (stamp.0, *slot)).collect();
        CameraSlots(
            self.cameras.iter().map(|(name, slots)| (name.to_string(), (slots.camera, images(slots)))).collect(),
        )
    }

    /// Restores the parameters from a checkpoint.
    pub(crate) fn restore(
        &mut self,
        gpu: &Gpu,
        slots: &CameraSlots,
        set: ParamSet,
        checkpoint: &Checkpoint,
    ) -> Result<(), Error> {
        let n_slots: usize = slots.0.values().map(|(_, images)| 1 + images.len()).sum();
        let all = slots.0.values().flat_map(|(camera, images)| std::iter::once(camera).chain(images.values()));
        self.n_used = all.map(|slot| slot + 1).max().unwrap_or(0);
        if (self.n_used as usize) < n_slots {
            return Err(Error::CheckpointState {
                reason: "two cameras or images share a slot of camera parameters".to_owned(),
            });
        }
        let bytes = checkpoint.array("camera_params", self.used_bytes())?;
        self.params = gpu.storage_with("splat.camera_params", bytes)?;
        self.set = set;
        self.cameras = slots
            .0
            .iter()
            .map(|(name, (camera, images))| {
                let images = images.iter().map(|(stamp, slot)| (Stamp(*stamp), *slot)).collect();
                (Arc::from(name.as_str()), Slots { camera: *camera, images })
            })
            .collect();
        Ok(())
    }

    /// Corrections of all cameras from the parameters or from a copy of them.
    pub(crate) fn corrections(
        &self,
        gpu: &Gpu,
        set: ParamSet,
        params: &Buffer,
        scene_size_m: f64,
    ) -> Result<BTreeMap<String, CameraCorrection>, Error> {
        // A copy may be older than the newest slots.
        let mut params: Vec<[f32; 4]> = gpu.read(params, (self.used_bytes().min(params.bytes()) / 16) as usize)?;
        params.resize((self.n_used * N_PARAMS) as usize, [0.0; 4]);
        let value = |slot: u32, param: u32, learned: u32| {
            let on = learned & (1 << param) != 0;
            if on { f64::from(params[(slot * N_PARAMS + param) as usize][0]) } else { 0.0 }
        };
        let correction_of = |slots: &Slots| {
            let camera_value = |param| value(slots.camera, param, set.camera_mask());
            let drift = |slot: &u32| [0, 1, 2, 3, 4, 5].map(|param| value(*slot, param, set.image_mask()));
            let log_gains =
                |slot: &u32| [LOG_GAIN, LOG_GAIN + 1, LOG_GAIN + 2].map(|param| value(*slot, param, set.image_mask()));
            let drift: BTreeMap<i64, [f64; 6]> = if set.image_poses {
                slots.images.iter().map(|(stamp, slot)| (stamp.0, drift(slot))).collect()
            } else {
                BTreeMap::new()
            };
            CameraCorrection {
                rotation_rad: [0, 1, 2].map(camera_value),
                translation_m: [3, 4, 5].map(camera_value),
                time_offset_secs: camera_value(6),
                log_focal: [7, 8].map(camera_value),
                principal_offset_focals: [9, 10].map(camera_value),
                drift_weight: if set.image_poses { drift_weight(&drift, scene_size_m) } else { 1.0 },
                drift,
                log_gains: if set.image_gains {
                    slots.images.iter().map(|(stamp, slot)| (stamp.0, log_gains(slot))).collect()
                } else {
                    BTreeMap::new()
                },
                ..CameraCorrection::default()
            }
        };
        Ok(self.cameras.iter().map(|(name, slots)| (name.to_string(), correction_of(slots))).collect())
    }
}

/// Bytes of the parameters of one camera or image.
const SLOT_BYTES: u64 = 16 * N_PARAMS as u64;
