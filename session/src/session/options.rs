//! The options of a session.

use super::{Evaluators, Limits};
use crate::checkpoints::Checkpoints;
use crate::decisions::DecisionLog;
use crate::kept_folder::KeptFolder;
use crate::next_commands::DataSource;
use crate::observer::Observer;
use crate::recovery::Recovery;
use crate::training_clock::Clock;
use capture::Stop;
use model_files::{Edits, InitialPoints};
use std::sync::Arc;

/// Options of a [`Session`](super::Session).
pub struct SessionOptions {
    /// How the model is scored.
    pub evaluators: Evaluators,
    /// When training ends.
    pub limits: Limits,
    /// Receives the events.
    pub observer: Box<dyn Observer>,
    /// Aborts an evaluation, without reporting it, when a stop is requested.
    pub stop: Stop,
    /// The clock of training time, which several sessions may share.
    pub clock: Clock,
    /// Training time of earlier runs, seconds. If present, the session continues from it with its
    /// own clock, and does not repeat their evaluations.
    pub previous_secs: Option<f64>,
    /// Scores of earlier runs, with which the PSNR curve begins: training seconds and dB.
    pub previous_psnr: Vec<(f64, f64)>,
    /// Points from which the model starts if no keyframe has depth.
    pub initial_points: Option<Arc<InitialPoints>>,
    /// Erased space, such as that of an earlier run.
    pub edits: Edits,
    /// Leaves scoring to [`Session::score_next`](super::Session::score_next), so that the caller
    /// can draw pictures in between. The caller must neither train nor push keyframes during an
    /// evaluation, so that all of its images are scored on the same model state.
    pub scores_stepwise: bool,
    /// Reports the GPU time of each pass at the end.
    pub profiles: bool,
    /// Writes checkpoints.
    pub checkpoints: Option<Checkpoints>,
    /// Logs timing-dependent decisions.
    pub decisions: Option<DecisionLog>,
    /// Enables recovery on another device if the GPU fails.
    pub recovery: Option<Recovery>,
    /// Folders of the run that are created again if they are removed or renamed.
    pub folders: Vec<KeptFolder>,
    /// The data source for the report and the next commands.
    pub data: DataSource,
}

impl SessionOptions {
    /// Options of a session that writes nothing before its end.
    pub fn new(evaluators: Evaluators, limits: Limits, observer: Box<dyn Observer>) -> Self {
        Self {
            evaluators,
            limits,
            observer,
            stop: Stop::default(),
            clock: Clock::default(),
            previous_secs: None,
            previous_psnr: Vec::new(),
            initial_points: None,
            edits: Edits::default(),
            scores_stepwise: false,
            profiles: false,
            checkpoints: None,
            decisions: None,
            recovery: None,
            folders: Vec::new(),
            data: DataSource::default(),
        }
    }
}
