//! Takes the place of a model whose GPU failed.

use kinematics::Stamp;
use std::path::Path;
use std::sync::Arc;
use trainer::align::Alignment;
use trainer::checkpoint::PendingCheckpoint;
use trainer::gpu::PassTiming;
use trainer::splat::PosedLens;
use trainer::{Error, Keyframe, Method, Part, Picture, Progress, RenderRequest};

/// No model: every operation fails.
pub(crate) struct Absent;

impl Method for Absent {
    fn push(&mut self, _: Arc<Keyframe>) -> Result<(), Error> {
        Err(Error::DeviceLost)
    }

    fn remove(&mut self, _: &str, _: Stamp) -> Result<(), Error> {
        Err(Error::DeviceLost)
    }

    fn step(&mut self, _: u64) -> Result<u64, Error> {
        Err(Error::DeviceLost)
    }

    fn is_idle(&self) -> bool {
        true
    }

    fn set_watched(&mut self, _: bool) {}

    fn primitive(&self) -> &'static str {
        "primitive"
    }

    fn n_taken(&mut self) -> Result<u64, Error> {
        Err(Error::DeviceLost)
    }

    fn seed(&mut self) -> Result<(), Error> {
        Err(Error::DeviceLost)
    }

    fn prepare(&mut self) -> Result<(), Error> {
        Err(Error::DeviceLost)
    }

    fn render(&mut self, _: &RenderRequest) -> Result<Picture, Error> {
        Err(Error::DeviceLost)
    }

    fn posed_lens(&mut self, _: &Keyframe) -> Result<PosedLens, Error> {
        Err(Error::DeviceLost)
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        Err(Error::DeviceLost)
    }

    fn alignment(&self) -> Option<&Alignment> {
        None
    }

    fn progress(&self) -> Progress {
        Progress::default()
    }

    fn report(&self) -> Vec<Part> {
        Vec::new()
    }

    fn save(&mut self, _: &Path) -> Result<(), Error> {
        Err(Error::DeviceLost)
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        Err(Error::DeviceLost)
    }
}
