//! What every scene model can do.

use crate::align::Alignment;
use crate::checkpoint::PendingCheckpoint;
use crate::gpu::PassTiming;
use crate::splat::CalibratedCamera;
use crate::{Error, Keyframe, Picture, RenderRequest};
use kinematics::Stamp;
use std::path::Path;
use std::sync::Arc;

/// Where training stands.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Progress {
    /// Optimiser updates so far.
    pub step: u64,
    /// Splats, voxel blocks or table entries.
    pub primitives: u64,
    /// Bytes of GPU memory the model holds.
    pub bytes: u64,
    /// GPU time of a step, milliseconds, smoothed.
    pub step_millis: f64,
}

/// What a part of the model was found to be worth, on images held back for it.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct TrialReport {
    /// What it is, in words.
    pub part: String,
    /// Mean PSNR with it less that without it, dB.
    pub gain_db: f64,
    /// Standard error of the mean, dB.
    pub standard_error_db: f64,
    /// Images it was measured on.
    pub n_images: usize,
    /// Whether the model has it.
    pub kept: bool,
}

/// Maximum GPU time of a training submit, short enough for checkpoints, keyframes and Ctrl-C to get their turn.
const SUBMIT_MILLIS: f64 = 20.0;
/// The same while pictures are requested: a picture waits for one running submit and one queued submit.
const SUBMIT_MILLIS_WATCHED: f64 = 4.0;

/// Maximum GPU time of a training submit, milliseconds.
pub(crate) fn submit_millis(watched: bool) -> f64 {
    if watched { SUBMIT_MILLIS_WATCHED } else { SUBMIT_MILLIS }
}

/// One scene model that learns from keyframes.
///
/// Several models can share one device; each is owned by one thread.
pub trait Method {
    /// Adds a keyframe. Test keyframes are evaluated, never trained on.
    fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error>;
    /// Forgets the keyframe of this camera and stamp, if it is held.
    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error>;
    /// Queues at most `n` optimizer updates, few enough to hold the GPU for no more than 20 ms ([`Method::set_watched`]: 4 ms),
    /// and returns how many. At most one submit runs and one is queued.
    ///
    /// A queued update is lost, and done again later, when it turns out that a buffer was too small. When all `n` were
    /// queued the call waits for them, so that [`Method::progress`] is exact; loop until it has reached the step you want.
    fn step(&mut self, n: u64) -> Result<u64, Error>;
    /// Whether more steps would do nothing until a keyframe comes.
    fn is_idle(&self) -> bool;
    /// What [`Progress::primitives`] counts, in the singular.
    fn primitive(&self) -> &'static str;
    /// Waits for what is queued, and says how many updates were made in all, those included that a trial took back: unlike
    /// [`Progress::step`] it never goes back.
    fn n_total_steps(&mut self) -> Result<u64, Error>;
    /// Makes of the keyframes so far what can be drawn without learning, as [`Method::render`] does.
    fn seed(&mut self) -> Result<(), Error>;
    /// Waits until everything that learning needs is compiled; [`Method::step`] would wait for it otherwise.
    fn prepare(&mut self) -> Result<(), Error>;
    /// Sets whether pictures are requested during training: submits are shorter then, but the learned parameters are bit-identical.
    fn set_watched(&mut self, watched: bool);
    /// Draws a picture; works from the first keyframe on.
    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error>;
    /// PSNR of the requested picture against a keyframe's image of the same size, dB, without reading the picture back. The same
    /// bits as [`crate::eval::psnr`] of the picture, which also has 8 bits. `None` if the model cannot compare on the GPU, or not
    /// yet.
    fn psnr(&mut self, _request: &RenderRequest, _keyframe: &Keyframe) -> Result<Option<f64>, Error> {
        Ok(None)
    }
    /// Pixels from one to the next, along both axes, of a depth image that is drawn to be compared with a measured one: an odd number,
    /// more than 1 where a ray is dear.
    fn depth_stride(&self) -> u32 {
        1
    }
    /// The camera of a keyframe as the model has it: with what was learned about all its images, not about this one.
    fn calibrated_camera(&mut self, keyframe: &Keyframe) -> Result<CalibratedCamera, Error>;
    /// Takes one step with a timestamp around every pass; empty where the adapter has none.
    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error>;
    /// What alignment of the keyframes found, once that is settled; none where it was not asked for or could not be done.
    fn alignment(&self) -> Option<&Alignment>;
    /// Where training stands.
    fn progress(&self) -> Progress;
    /// What the parts of the model that were tried bought, in the order of the trials.
    fn report(&self) -> Vec<TrialReport>;
    /// Writes the model into a folder.
    fn save(&mut self, folder: &Path) -> Result<(), Error>;
    /// Takes all that training needs to go on from here; what is learned afterwards does not change it.
    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error>;
}
