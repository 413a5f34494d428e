//! What decides when models receive keyframes and when training ends: the clock and the limits, or
//! the log of an earlier run.

use super::{DEFAULT_SECONDS, TrainPlan};
use crate::data::{Data, DataOptions, Purpose};
use crate::previous_run::PreviousRun;
use crate::read_progress::OnReadProgress;
use crate::session::{Limits, Session};
use crate::session_setup::Services;
use crate::training;
use capture::config::Override;
use keyframe::Keyframe;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use trainer::ModelSpec;

/// Decides what a training run trains on, and when. By default, all keyframes are pushed at once,
/// and training ends at a limit.
pub(super) trait Schedule {
    /// The limits of the run. `previous_secs`: training time of the run that it continues.
    fn limits(&self, plan: &TrainPlan, previous_secs: f64) -> anyhow::Result<Limits> {
        let Limits { seconds, steps } = plan.limits;
        training::limits(seconds, steps, previous_secs + DEFAULT_SECONDS)
    }

    /// Checks the SHA-256 of the model from which depth is rendered.
    fn check_depth_from(&self, _sha256: Option<&str>) -> anyhow::Result<()> {
        Ok(())
    }

    /// The images to read.
    fn images(
        &self,
        plan: &TrainPlan,
        previous: Option<&PreviousRun>,
    ) -> anyhow::Result<DataOptions> {
        if let Some(previous) = previous {
            return plan
                .images
                .completed_with(&previous.subject(), &previous.checkpoint.flags);
        }
        training::check_before_data(&plan.training, &plan.data, &plan.images)?;
        Ok(plan.images.clone())
    }

    /// Reads the images.
    fn load_data(
        &self,
        path: &Path,
        images: &DataOptions,
        overrides: &[Override],
        progress: OnReadProgress<'_>,
    ) -> anyhow::Result<Data> {
        Data::load(path, images, Purpose::Training, overrides, progress)
    }

    /// Checks the keyframes, and the SHA-256 of the points from which training starts.
    fn check_data(
        &self,
        _path: &Path,
        _data: &Data,
        _points_sha256: Option<&str>,
    ) -> anyhow::Result<()> {
        Ok(())
    }

    /// The methods and options of a run that continues no other one.
    fn model_specs(
        &self,
        plan: &TrainPlan,
        data: &Data,
        is_software: bool,
    ) -> anyhow::Result<Vec<ModelSpec>> {
        let n_steps = plan.n_planned_steps.or(plan.limits.steps);
        plan.training.log_unestimated(data.available(), is_software);
        training::model_specs(&plan.training, data, n_steps, is_software)
    }

    /// Checks the step of the checkpoint that training continues from, and the GPU.
    fn check_start(&self, _from_step: Option<u64>, _adapter: &str) -> anyhow::Result<()> {
        Ok(())
    }

    /// Whether training can continue on another device after a GPU failure.
    fn can_recover(&self) -> bool {
        true
    }

    /// Pushes the keyframes to the models, and trains the models to the end.
    ///
    /// * `preparation_time`: time already spent on the keyframes, which counts as training time.
    fn drive(
        &self,
        sessions: &mut [Session],
        keyframes: &[Arc<Keyframe>],
        preparation_time: Duration,
        services: Services<'_>,
    ) -> anyhow::Result<()> {
        let Services { stop, open_gpu, .. } = services;
        training::drive(sessions, keyframes, preparation_time, stop, open_gpu)
    }
}

/// Trains until a limit.
pub(super) struct UntilLimit;

impl Schedule for UntilLimit {}
