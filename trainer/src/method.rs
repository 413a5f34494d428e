//! The interface of all scene models.

use crate::bounds::Bounds;
use crate::floaters::PendingFloaters;
use crate::model_chunks::PendingChunks;
use crate::pending::PendingCheckpoint;
use crate::{CorrectedKeyframe, Error, Packing, Picture, QueuedPicture, RenderRequest, Rendered};
use calibration::{Alignment, CameraCorrection, TrialReport};
use gpu::PassTiming;
use keyframe::Keyframe;
use kinematics::Stamp;
use model_files::{Edits, InitialPoints};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// Progress of training.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Progress {
    /// Optimizer updates so far.
    pub step: u64,
    /// Splats, voxel blocks or table entries.
    pub primitives: u64,
    /// GPU memory of the model, bytes. It is 0 for a model in host memory.
    pub bytes: u64,
    /// Smoothed GPU time of a step, milliseconds.
    pub step_millis: f64,
}

/// A scene model that trains on keyframes.
///
/// Several models can share one device. Each model is owned by one thread.
/// [`AlignedModel`](crate::AlignedModel) adds the alignment of cameras.
pub trait Method {
    /// Adds a keyframe. Test keyframes are used for evaluation only. The method checks the parts of
    /// the keyframe that it uses ([`Keyframe::check`]).
    fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error>;
    /// Removes the keyframe with this camera and stamp, if there is one. The scene that was learned
    /// from the keyframe stays. Resuming from a later checkpoint must not require the keyframe.
    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error>;
    /// Sets points on the surfaces of the scene, from which the model starts if no keyframe has
    /// depth. This must be called before the first step. It must be called again after resuming,
    /// because checkpoints do not contain the points. Returns false if the method does not use
    /// initial points.
    fn set_initial_points(&mut self, _points: &Arc<InitialPoints>) -> bool {
        false
    }
    /// Queues up to `n` optimizer updates, but at most 20 ms of GPU work. While pictures are
    /// requested ([`Method::set_watched`]), the limit is 2 ms. Returns the number of queued
    /// updates. At any time, at most one submit runs and one further submit is queued.
    ///
    /// If a buffer is too small, a queued update is discarded and repeated later. If all `n`
    /// updates were queued, the call waits for them, so that [`Method::progress`] is exact. Call in
    /// a loop until the desired step is reached.
    fn step(&mut self, n: u64) -> Result<u64, Error>;
    /// Whether further steps have no effect until a keyframe arrives.
    fn is_idle(&self) -> bool;
    /// Waits for queued updates and returns the total number of updates, including updates of
    /// rejected trials. Unlike [`Progress::step`], it never decreases.
    fn n_total_steps(&mut self) -> Result<u64, Error>;
    /// Initializes the model from the keyframes added so far, so that it can be rendered without
    /// training. Does nothing if the model can be rendered only after training.
    fn seed(&mut self) -> Result<(), Error> {
        Ok(())
    }
    /// Waits until all training kernels are compiled. Without this call, the first [`Method::step`]
    /// waits for the compilation.
    fn prepare(&mut self) -> Result<(), Error> {
        Ok(())
    }
    /// Sets whether pictures are requested during training. If they are, submits are shorter. The
    /// trained parameters are bit-identical in both cases.
    fn set_watched(&mut self, _watched: bool) {}
    /// Renders a picture. If the model is empty, first initializes it as [`Method::seed`] does.
    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error>;
    /// Renders a picture as [`Method::render`] does and packs it on the GPU, if the model and the
    /// adapter support it.
    fn render_packed(
        &mut self,
        request: &RenderRequest,
        _packing: Packing,
    ) -> Result<Rendered, Error> {
        self.render(request).map(Rendered::Picture)
    }
    /// Starts [`Method::render_packed`] without waiting for the GPU, if the model supports this.
    fn queue_packed(
        &mut self,
        request: &RenderRequest,
        packing: Packing,
    ) -> Result<QueuedPicture, Error> {
        self.render_packed(request, packing)
            .map(QueuedPicture::ready)
    }
    /// Starts to encode the model for clients that draw it themselves. With `only_changed`, only
    /// the chunks that have changed since the last call are encoded. Erased space is left out.
    /// Later training does not affect the result. Waiting for the GPU and encoding take place in
    /// [`PendingChunks::finish`].
    ///
    /// `None` if the model is empty or if
    /// [`MethodEntry::has_chunks`](crate::method_entry::MethodEntry) is false.
    fn queue_chunks(
        &mut self,
        _only_changed: bool,
        _edits: &Arc<Edits>,
    ) -> Result<Option<PendingChunks>, Error> {
        Ok(None)
    }
    /// Starts to search for small parts that are not connected to the large parts of the model.
    /// Space that is already erased is ignored. Later training does not affect the result. The
    /// search takes place in [`PendingFloaters::finish`] and may take seconds. It fails if there
    /// are no floaters.
    ///
    /// # Errors
    ///
    /// Fails if the model does not support this.
    fn find_floaters(&mut self, _edits: &Arc<Edits>) -> Result<PendingFloaters, Error> {
        Err(Error::CannotFindFloaters)
    }
    /// PSNR of the requested picture against a keyframe's image of the same size, dB, computed on
    /// the GPU. The result is bit-identical to [`crate::eval::psnr`] of the 8-bit picture. `None`
    /// if the model cannot compute the PSNR, or cannot compute it yet.
    fn psnr(
        &mut self,
        _request: &RenderRequest,
        _keyframe: &Keyframe,
    ) -> Result<Option<f64>, Error> {
        Ok(None)
    }
    /// Background for comparisons with images, as sRGB values from 0 to 1. It is the expected color
    /// of unobserved areas.
    fn background_srgb(&self) -> [f32; 3] {
        [0.0; 3]
    }
    /// Pixel stride along both axes for rendered depth images that are compared with measured depth
    /// images. It is odd. It is above 1 if rendering a ray is expensive.
    fn depth_stride(&self) -> u32 {
        1
    }
    /// A sphere that contains most of the model. `None` if the model is empty or does not support
    /// this.
    fn bounds(&mut self) -> Result<Option<Bounds>, Error> {
        Ok(None)
    }
    /// Waits for queued work and returns the camera corrections that were optimized with the scene,
    /// by camera name. They are applied after the corrections of alignment.
    fn camera_corrections(&mut self) -> Result<BTreeMap<String, CameraCorrection>, Error> {
        Ok(BTreeMap::new())
    }
    /// Replaces all keyframes pushed so far. If the model can be moved, it moves with its
    /// keyframes. Otherwise, it forgets all training.
    ///
    /// * `keyframes`: in the order of their arrival, without test keyframes.
    /// * `alignment`: the source of the new corrections.
    fn recalibrate(
        &mut self,
        keyframes: &[CorrectedKeyframe],
        alignment: &Alignment,
    ) -> Result<(), Error>;
    /// Takes one step with timestamps around every pass. Returns an empty list if the adapter does
    /// not support timestamps.
    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error>;
    /// Pauses or continues the growth of the model. Returns false if the call changes nothing or is
    /// not possible now.
    fn pause_growth(&mut self, _is_paused: bool) -> Result<bool, Error> {
        Ok(false)
    }
    /// Progress of training.
    fn progress(&self) -> Progress;
    /// Reports of the trials, in the order in which they ran.
    fn report(&self) -> Vec<TrialReport> {
        Vec::new()
    }
    /// Writes the model into an existing folder. The files do not depend on the number of planned
    /// steps.
    fn save(&mut self, folder: &Path) -> Result<(), Error>;
    /// Writes the files of a saved model that only other programs read. These files leave out
    /// erased space. All other files contain the complete model.
    fn write_for_others(&mut self, _folder: &Path, _edits: &Edits) -> Result<(), Error> {
        Ok(())
    }
    /// Takes a checkpoint of everything needed to continue training. Later training does not change
    /// the checkpoint.
    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error>;
}
