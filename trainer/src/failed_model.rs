//! Placeholder for a model whose GPU failed.

use crate::pending::PendingCheckpoint;
use crate::{CorrectedKeyframe, Error, Method, Picture, Progress, RenderRequest};
use calibration::Alignment;
use gpu::PassTiming;
use keyframe::Keyframe;
use kinematics::Stamp;
use std::path::Path;
use std::sync::Arc;

/// A model whose GPU failed. Every operation returns [`gpu::Error::DeviceLost`].
#[derive(Clone, Copy, Debug)]
pub struct FailedModel;

impl Method for FailedModel {
    fn push(&mut self, _: Arc<Keyframe>) -> Result<(), Error> {
        Err(device_lost())
    }

    fn remove(&mut self, _: &str, _: Stamp) -> Result<(), Error> {
        Err(device_lost())
    }

    fn step(&mut self, _: u64) -> Result<u64, Error> {
        Err(device_lost())
    }

    fn is_idle(&self) -> bool {
        // Further steps would change nothing. The model counts as idle, so that a loop that trains
        // until idle ends.
        true
    }

    fn n_total_steps(&mut self) -> Result<u64, Error> {
        Err(device_lost())
    }

    fn seed(&mut self) -> Result<(), Error> {
        Err(device_lost())
    }

    fn prepare(&mut self) -> Result<(), Error> {
        Err(device_lost())
    }

    fn render(&mut self, _: &RenderRequest) -> Result<Picture, Error> {
        Err(device_lost())
    }

    fn recalibrate(&mut self, _: &[CorrectedKeyframe], _: &Alignment) -> Result<(), Error> {
        Err(device_lost())
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        Err(device_lost())
    }

    fn progress(&self) -> Progress {
        Progress::default()
    }

    fn save(&mut self, _: &Path) -> Result<(), Error> {
        Err(device_lost())
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        Err(device_lost())
    }
}

fn device_lost() -> Error {
    gpu::Error::DeviceLost.into()
}
