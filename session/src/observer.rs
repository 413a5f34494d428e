//! Events that a session sends to the program that runs it.

use crate::evaluate::Scores;
use crate::started_run::StartedRun;
use serde::Serialize;
use std::path::Path;
use trainer::Progress;

/// Receives the events of a session, for example to print them.
pub trait Observer {
    /// Handles an event.
    fn on_event(&mut self, event: &SessionEvent<'_>);
}

/// Ignores all events.
impl Observer for () {
    fn on_event(&mut self, _event: &SessionEvent<'_>) {}
}

/// An event of a session.
#[derive(Clone, Copy, Debug)]
pub enum SessionEvent<'a> {
    /// The run has a folder, and training begins.
    Started(&'a StartedRun),
    /// The state of training, several times per second.
    Progress(&'a SessionProgress),
    /// A scheduled evaluation.
    Evaluated(&'a Evaluation),
    /// Training ended; saving and scoring follow.
    TrainingEnded,
    /// Work that may take long and has no count has begun, such as saving; `None` after its end.
    Working(Option<&'static str>),
    /// The saved model is being scored.
    Scoring {
        /// Number of test images scored so far.
        n_scored: usize,
        /// Number of test images.
        n_all: usize,
    },
    /// The model was saved and scored.
    Finished(&'a FinishedReport<'a>),
}

/// The state of training.
#[derive(Clone, Debug)]
pub struct SessionProgress {
    /// Singular name of the model's primitive, such as `splat`.
    pub primitive: &'static str,
    /// Training time, seconds.
    pub seconds: f64,
    /// Steps, primitives and memory.
    pub progress: Progress,
    /// Mean of the latest PSNR of all test images, dB.
    pub psnr: Option<f64>,
}

/// Result of a scheduled evaluation, serialized as the event `eval`.
#[derive(Clone, Debug, Serialize)]
pub struct Evaluation {
    pub(crate) event: &'static str,
    pub(crate) method: &'static str,
    /// Training time, seconds.
    pub seconds: f64,
    /// Number of optimizer steps.
    pub step: u64,
    /// Mean scores of the test images.
    #[serde(flatten)]
    pub scores: Scores,
    /// Number of test images in the mean scores.
    pub(crate) n_images: usize,
    /// Number of primitives of the model, such as splats.
    pub primitives: u64,
    /// Size of the model, bytes.
    pub bytes: u64,
    /// Duration of a step, milliseconds; `None` before the first step.
    pub step_millis: Option<f64>,
    /// Singular name of the model's primitive, such as `splat`.
    #[serde(skip)]
    pub primitive: &'static str,
}

/// Result of training, serialized as the event `done`.
#[derive(Clone, Debug, Serialize)]
pub struct DoneEvent<'a> {
    pub(crate) event: &'static str,
    /// Name of the method.
    pub method: &'static str,
    /// Training time, seconds.
    pub seconds: f64,
    /// Number of optimizer steps.
    pub steps: u64,
    /// Mean scores of the test images.
    #[serde(flatten)]
    pub scores: Scores,
    /// Number of primitives of the model, such as splats.
    pub primitives: u64,
    /// Size of the model, bytes.
    pub bytes: u64,
    /// Folder of the model.
    pub out: &'a Path,
    /// SHA-256 of the saved model.
    pub checkpoint_sha256: &'a str,
}

/// GPU time of each kernel in a step, serialized as the event `profile`.
#[derive(Clone, Debug, Serialize)]
pub struct ProfileEvent<'a> {
    pub(crate) event: &'static str,
    /// Name of the method.
    pub method: &'static str,
    /// Names of the kernels and their GPU time, milliseconds.
    pub passes: &'a [(&'static str, f64)],
}

/// Final report on a model that was saved and scored.
#[derive(Clone, Debug)]
pub struct FinishedReport<'a> {
    /// The result.
    pub done: &'a DoneEvent<'a>,
    /// GPU time of each kernel, if profiling was requested.
    pub profile: Option<ProfileEvent<'a>>,
    /// Singular name of the model's primitive, such as `splat`.
    pub primitive: &'static str,
    /// Whether the page `report.html` was written.
    pub has_page: bool,
}
