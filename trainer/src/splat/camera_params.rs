//! Per-camera parameters that are optimized together with the splats. They are extrinsics, time
//! offset, lens and exposure.
//!
//! All images of a camera share its parameters. Each image can have additional parameters. The
//! parameters stay on the GPU during training. `correct_view` applies them to the view of a step,
//! and `refine_camera` updates them.

use super::kernels::TrainPipelines;
use super::params::{CameraRule, Lens, N_PARAMS};
use super::passes::ViewPasses;
use crate::Error;
use calibration::{CameraCorrection, ParamSet, drift_weight};
use gpu::{Buffer, Gpu, Passes, Pipeline};
use keyframe::Keyframe;
use kinematics::{Stamp, Twist};
use model_files::checkpoint::Checkpoint;
use nalgebra::Vector3;
use numbers::{f32_of, f32s_of};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Bit mask of the parameters that all images of a camera share.
fn camera_mask(set: ParamSet) -> u32 {
    let bits = |params: ParamSet, bits: u32| if set.contains(params) { bits } else { 0 };
    bits(ParamSet::EXTRINSICS, 0b11_1111)
        | bits(ParamSet::TIME_OFFSET, 1 << 6)
        | bits(ParamSet::LENS, 0b1111 << 7)
}

/// Bit mask of the per-image parameters.
fn image_mask(set: ParamSet) -> u32 {
    let bits = |params: ParamSet, bits: u32| if set.contains(params) { bits } else { 0 };
    bits(ParamSet::IMAGE_POSES, 0b11_1111) | bits(ParamSet::IMAGE_GAINS, 0b111 << 11)
}

/// Index of the first gain among the parameters, as in `shared/camera_params.wgsl`.
const LOG_GAIN: u32 = 11;
/// Initial learning rate of rotations, radians per step. All other rates are derived from it. With
/// larger rates, large errors are corrected sooner, but cameras follow the noise of single images.
const ROTATION_RATE: f64 = 1e-3;
/// Fraction of the learning rates that remains after the planned steps, as for the means of splats.
const FINAL_FRAC: f64 = 0.01;
/// Fraction by which each step moves the parameters of its image toward zero. Without this decay,
/// all images of a camera could drift together. Such a drift cannot be distinguished from a motion
/// of the scene.
const IMAGE_DECAY: f64 = 0.001;

/// The camera parameters on the GPU.
#[derive(Debug)]
pub(crate) struct CameraParams {
    pub(crate) set: ParamSet,
    pub(crate) params: Buffer,
    rule: Buffer,
    /// Corrected view of the current step.
    pub(crate) corrected: Buffer,
    pub(crate) gains: Buffer,
    cameras: BTreeMap<Arc<str>, Slots>,
    n_used: u32,
}

/// For each camera by name, the slot of the camera, and the slots of its images by stamp in
/// nanoseconds.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub(crate) struct CameraSlots(BTreeMap<String, (u32, BTreeMap<i64, u32>)>);

/// Slots of a camera and its images. Each slot holds [`N_PARAMS`] parameters.
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
            rule: gpu.uniform_with(
                "splat.camera_rule",
                &<CameraRule as bytemuck::Zeroable>::zeroed(),
            ),
            corrected: gpu.uniform_and_storage(
                "splat.corrected_view",
                size_of::<super::params::View>() as u64,
            ),
            gains: gpu.storage_with("splat.gains", bytemuck::cast_slice(&[1.0f32; 4]))?,
            cameras: BTreeMap::new(),
            n_used: 0,
        })
    }

    /// Adds parameters to the optimized set.
    pub(crate) fn enable(&mut self, more: ParamSet) {
        self.set |= more;
    }

    /// Uploads the lens of a keyframe. Allocates parameter slots for the camera and the image if
    /// they are new.
    pub(crate) fn lens(&mut self, gpu: &Gpu, keyframe: &Keyframe) -> Result<Buffer, Error> {
        // A keyframe keeps its slots if it is pushed again, so its estimates are not lost.
        let camera = match self.cameras.get(&keyframe.camera) {
            Some(slots) => slots.camera,
            None => {
                let slots = Slots {
                    camera: self.allocate_slot(gpu)?,
                    images: BTreeMap::new(),
                };
                self.cameras
                    .entry(keyframe.camera.clone())
                    .or_insert(slots)
                    .camera
            }
        };
        let known = self
            .cameras
            .get(&keyframe.camera)
            .and_then(|slots| slots.images.get(&keyframe.stamp).copied());
        let image = match known {
            Some(slot) => slot,
            None => self.allocate_slot(gpu)?,
        };
        if let Some(slots) = self.cameras.get_mut(&keyframe.camera) {
            slots.images.insert(keyframe.stamp, image);
        }
        let lens = Lens {
            linear: twist_part(keyframe, |twist| twist.linear_m_s),
            angular: twist_part(keyframe, |twist| twist.angular_rad_s),
            camera_params: camera * N_PARAMS,
            image_params: image * N_PARAMS,
            unused: [0; 2],
        };
        Ok(gpu.uniform_with("splat.lens", &lens))
    }

    /// Sets the initial log gains of an image.
    pub(crate) fn initialize_gains(&self, gpu: &Gpu, keyframe: &Keyframe, log_gains: [f64; 3]) {
        let slot = self
            .cameras
            .get(&keyframe.camera)
            .and_then(|slots| slots.images.get(&keyframe.stamp));
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

    /// Restores a copy. Slots allocated after the copy was made remain allocated, and their
    /// parameters become zero.
    pub(crate) fn restore_snapshot(
        &mut self,
        gpu: &Gpu,
        (set, params): (ParamSet, Buffer),
    ) -> Result<(), Error> {
        self.set = set;
        if params.bytes() < self.used_bytes() {
            // New buffers are zeroed.
            self.params = gpu.storage("splat.camera_params", self.used_bytes())?;
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
            // The new buffer has twice the required size, so that it is rarely copied while images
            // arrive.
            let larger = gpu.storage("splat.camera_params", 2 * bytes)?;
            gpu.copy((&self.params, 0), (&larger, 0), self.params.bytes());
            self.params = larger;
        }
        Ok(self.n_used - 1)
    }

    /// Uploads the learning rates. `progress` is the completed fraction of the planned steps.
    pub(crate) fn write_rule(&self, gpu: &Gpu, progress: f64, scene_size_m: f64) {
        let rate = ROTATION_RATE * FINAL_FRAC.powf(progress.clamp(0.0, 1.0));
        let rule = CameraRule {
            camera_mask: camera_mask(self.set),
            image_mask: image_mask(self.set),
            rotation_rate: f32_of(rate),
            // With this rate, a translation moves the image by the same amount as a rotation, at
            // the distance of the scene.
            translation_rate_m: f32_of(rate * scene_size_m),
            time_offset_rate: f32_of(rate),
            focal_rate: f32_of(rate),
            // Exposure can change by a factor of two between two images, so its logarithm needs
            // larger steps.
            gain_rate: f32_of(10.0 * rate),
            image_decay: f32_of(IMAGE_DECAY),
        };
        gpu.write(&self.rule, 0, bytemuck::bytes_of(&rule));
    }

    /// Records the pass that prepares the view of a step.
    pub(crate) fn correct(
        &self,
        gpu: &Gpu,
        passes: &mut Passes,
        pipelines: &TrainPipelines,
        base: &Buffer,
        lens: &Buffer,
    ) {
        let buffers = [
            ("base", base),
            ("lens", lens),
            ("rule", &self.rule),
            ("params", &self.params),
            ("corrected", &self.corrected),
            ("gains", &self.gains),
        ];
        passes.dispatch(gpu, &pipelines.correct_view, 1, &buffers);
    }

    /// Records the pass that updates the parameters.
    pub(crate) fn refine(
        &self,
        view: &ViewPasses<'_>,
        passes: &mut Passes,
        pipelines: &TrainPipelines,
        lens: &Buffer,
    ) {
        self.refine_with(view, passes, &pipelines.refine_camera, lens);
    }

    pub(crate) fn refine_with(
        &self,
        view: &ViewPasses<'_>,
        passes: &mut Passes,
        refine: &Pipeline,
        lens: &Buffer,
    ) {
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
        CameraSlots(
            self.cameras
                .iter()
                .map(|(name, slots)| (name.to_string(), (slots.camera, slots.of_images())))
                .collect(),
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
        let all = slots
            .0
            .values()
            .flat_map(|(camera, images)| std::iter::once(camera).chain(images.values()));
        // All slots must be distinct, because two cameras with the same slot would change each
        // other's parameters. There must be at least as many slot numbers as slots.
        self.n_used = all.map(|slot| slot + 1).max().unwrap_or(0);
        if (self.n_used as usize) < n_slots {
            return Err(Error::CheckpointState {
                reason: "two cameras or images share a parameter slot".to_owned(),
            });
        }
        let bytes = checkpoint.array("camera_params", self.used_bytes())?;
        self.params = gpu.storage_with("splat.camera_params", bytes)?;
        self.set = set;
        self.cameras = slots
            .0
            .iter()
            .map(|(name, (camera, images))| {
                let images = images
                    .iter()
                    .map(|(stamp, slot)| (Stamp(*stamp), *slot))
                    .collect();
                (
                    Arc::from(name.as_str()),
                    Slots {
                        camera: *camera,
                        images,
                    },
                )
            })
            .collect();
        Ok(())
    }

    /// Computes the corrections of all cameras from `params`, which is the parameter buffer or a
    /// copy of it.
    pub(crate) fn corrections(
        &self,
        gpu: &Gpu,
        set: ParamSet,
        params: &Buffer,
        scene_size_m: f64,
    ) -> Result<BTreeMap<String, CameraCorrection>, Error> {
        // A copy may lack the newest slots.
        let mut params: Vec<[f32; 4]> = gpu.read(
            params,
            (self.used_bytes().min(params.bytes()) / 16) as usize,
        )?;
        params.resize((self.n_used * N_PARAMS) as usize, [0.0; 4]);
        let values = ParamValues { params, set };
        Ok(self
            .cameras
            .iter()
            .map(|(name, slots)| (name.to_string(), values.correction(slots, scene_size_m)))
            .collect())
    }
}

impl Slots {
    /// Slots of the images by stamp in nanoseconds.
    fn of_images(&self) -> BTreeMap<i64, u32> {
        self.images
            .iter()
            .map(|(stamp, slot)| (stamp.0, *slot))
            .collect()
    }
}

/// The parameters of all slots, in host memory.
struct ParamValues {
    /// Each parameter has its value first, followed by the state of the optimizer.
    params: Vec<[f32; 4]>,
    /// The optimized parameters.
    set: ParamSet,
}

impl ParamValues {
    /// The correction of a camera and its images.
    fn correction(&self, slots: &Slots, scene_size_m: f64) -> CameraCorrection {
        let camera_value = |param| self.value(slots.camera, param, camera_mask(self.set));
        let drift: BTreeMap<i64, [f64; 6]> = if self.set.contains(ParamSet::IMAGE_POSES) {
            self.of_images(slots, [0, 1, 2, 3, 4, 5])
        } else {
            BTreeMap::new()
        };
        // The indices are the same as in `shared/camera_params.wgsl`.
        CameraCorrection {
            rotation_rad: [0, 1, 2].map(camera_value),
            translation_m: [3, 4, 5].map(camera_value),
            time_offset_secs: camera_value(6),
            log_focal: [7, 8].map(camera_value),
            principal_offset_focals: [9, 10].map(camera_value),
            drift_weight: if self.set.contains(ParamSet::IMAGE_POSES) {
                drift_weight(&drift, scene_size_m)
            } else {
                1.0
            },
            drift,
            log_gains: if self.set.contains(ParamSet::IMAGE_GAINS) {
                self.of_images(slots, [LOG_GAIN, LOG_GAIN + 1, LOG_GAIN + 2])
            } else {
                BTreeMap::new()
            },
            ..CameraCorrection::default()
        }
    }

    /// Parameters of each image of a camera, by stamp in nanoseconds.
    fn of_images<const N: usize>(
        &self,
        slots: &Slots,
        params: [u32; N],
    ) -> BTreeMap<i64, [f64; N]> {
        slots
            .images
            .iter()
            .map(|(stamp, slot)| {
                let values = params.map(|param| self.value(*slot, param, image_mask(self.set)));
                (stamp.0, values)
            })
            .collect()
    }

    /// Value of a parameter. It is 0 if the mask of optimized parameters does not contain the
    /// parameter.
    fn value(&self, slot: u32, param: u32, mask: u32) -> f64 {
        // Kernels also do not apply such a parameter, even if a trial has changed it.
        if mask & (1 << param) == 0 {
            return 0.0;
        }
        f64::from(self.params[(slot * N_PARAMS + param) as usize][0])
    }
}

/// One part of the velocity of a keyframe's camera, padded to `vec4f`. It is zero if the velocity
/// is unknown.
fn twist_part(keyframe: &Keyframe, of: fn(&Twist) -> Vector3<f64>) -> [f32; 4] {
    let [x, y, z] = keyframe
        .twist
        .as_ref()
        .map_or([0.0; 3], |twist| f32s_of(of(twist).into()));
    [x, y, z, 0.0]
}

/// Bytes of the parameters of one camera or image.
const SLOT_BYTES: u64 = 16 * N_PARAMS as u64;
