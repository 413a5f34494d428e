//! The interface of all scene models.

use crate::bounds::Bounds;
use crate::checkpoint::PendingCheckpoint;
use crate::gpu::PassTiming;
use crate::{Error, Picture, RenderRequest};
use calibration::{Alignment, CalibratedCamera, TrialReport};
use keyframe::Keyframe;
use kinematics::Stamp;
use std::path::Path;
use std::sync::Arc;

/// Progress of training.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Progress {
    /// Optimizer updates so far.
    pub step: u64,
    /// Splats, voxel blocks or table entries.
    pub primitives: u64,
    /// GPU memory of the model, bytes; 0 for a model in host memory.
    pub bytes: u64,
    /// GPU time of a step, milliseconds, smoothed.
    pub step_millis: f64,
}

/// Maximum GPU time of a training submit. Short enough that checkpoints, keyframes and Ctrl-C are handled soon.
const SUBMIT_MILLIS: f64 = 20.0;
/// Maximum while pictures are requested: a picture waits for one running submit and one queued submit.
const SUBMIT_MILLIS_WATCHED: f64 = 4.0;

/// Maximum GPU time of a training submit, milliseconds.
pub(crate) fn submit_millis(watched: bool) -> f64 {
    if watched { SUBMIT_MILLIS_WATCHED } else { SUBMIT_MILLIS }
}

/// A scene model that trains on keyframes.
///
/// Several models can share one device; each is owned by one thread.
pub trait Method {
    /// Adds a keyframe. Test keyframes are evaluated, never trained on. The method checks what it uses of it
    /// ([`Keyframe::check`]).
    fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error>;
    /// Forgets the keyframe with this camera and stamp, if there is one. What was learned from it stays, and resuming
    /// from a later checkpoint must not need it.
    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error>;
    /// Queues at most `n` optimizer updates, few enough to occupy the GPU for at most 20 ms ([`Method::set_watched`]: 4
    /// ms), and returns their number. At most one submit runs and one is queued.
    ///
    /// If a buffer turns out to be too small, a queued update is discarded and repeated later. If all `n` were queued,
    /// the call waits for them, so that [`Method::progress`] is exact; loop until it reaches the desired step.
    fn step(&mut self, n: u64) -> Result<u64, Error>;
    /// Whether more steps would do nothing until a keyframe arrives.
    fn is_idle(&self) -> bool;
    /// Waits for queued updates and returns the total number of updates, including those of rejected trials. Unlike
    /// [`Progress::step`], it never decreases.
    fn n_total_steps(&mut self) -> Result<u64, Error>;
    /// Initializes the model from the keyframes so far, so that it can be rendered without training.
    fn seed(&mut self) -> Result<(), Error>;
    /// Waits until all kernels needed for training are compiled; otherwise [`Method::step`] waits for them.
    fn prepare(&mut self) -> Result<(), Error>;
    /// Sets whether pictures are requested during training. Submits are then shorter, but the trained parameters are
    /// bit-identical.
    fn set_watched(&mut self, watched: bool);
    /// Renders a picture. If the model is empty, first initializes it as [`Method::seed`] does.
    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error>;
    /// PSNR of the requested picture against a keyframe's image of the same size, dB, without reading the picture back.
    /// Bit-identical to [`crate::eval::psnr`] of the picture, which also has 8 bits. `None` if the model cannot compare
    /// on the GPU, or not yet.
    fn psnr(&mut self, _request: &RenderRequest, _keyframe: &Keyframe) -> Result<Option<f64>, Error> {
        Ok(None)
    }
    /// Stride along both axes for rendering a depth image that is compared with a measured one: an odd number, above 1
    /// if rays are expensive.
    fn depth_stride(&self) -> u32 {
        1
    }
    /// A sphere that contains most of the model; `None` if the model is empty or does not support this.
    fn bounds(&mut self) -> Result<Option<Bounds>, Error> {
        Ok(None)
    }
    /// The camera of a keyframe with the model's corrections for the camera, but not those for this single image.
    fn calibrated_camera(&mut self, keyframe: &Keyframe) -> Result<CalibratedCamera, Error>;
    /// Takes one step with timestamps around every pass; returns an empty list if the adapter has none.
    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error>;
    /// Result of keyframe alignment once it is done; `None` if it was not requested or not possible.
    fn alignment(&self) -> Option<&Alignment>;
    /// In a live run, applies the result of an alignment in the background if it is ready, or waits for it if `wait`.
    /// Returns whether a result was applied, which depends on timing unless `wait` is set.
    fn poll_alignment(&mut self, _wait: bool) -> Result<bool, Error> {
        Ok(false)
    }
    /// Progress of training.
    fn progress(&self) -> Progress;
    /// Results of the trials, in their order.
    fn report(&self) -> Vec<TrialReport>;
    /// Writes the model into an existing folder. The files depend only on the model, not on how many steps are planned.
    fn save(&mut self, folder: &Path) -> Result<(), Error>;
    /// Takes a checkpoint of everything needed to continue training; later training does not change it.
    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error>;
}
