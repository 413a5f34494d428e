//! Makes the sessions of a run, with their decision logs, checkpoints and recovery. Each session
//! has one folder.

use crate::checkpoints::{CheckpointOptions, Checkpoints, RunFlags};
use crate::decisions::{DecisionLog, RunDescription, Settings};
use crate::kept_folder::KeptFolder;
use crate::next_commands::DataSource;
use crate::observer::{Observer, SessionEvent};
use crate::previous_run::PreviousRun;
use crate::recoveries::OpenGpu;
use crate::recovery::Recovery;
use crate::resume_command::ResumeCommand;
use crate::session::{Evaluators, Limits, Session, SessionOptions};
use crate::started_run::StartedRun;
use crate::training_clock::Clock;
use capture::Stop;
use gpu::Gpu;
use keyframe::Keyframe;
use model_files::InitialPoints;
use std::path::Path;
use std::sync::Arc;
use trainer::{ModelSpec, Resumed};

/// Makes the observer of one session of a run. The arguments are the limits of the run and the
/// number of its sessions.
pub type NewObserver<'a> = &'a dyn Fn(Limits, usize) -> Box<dyn Observer>;

/// Services that the program provides to the [`RunPlan`](crate::RunPlan) or
/// [`TrainPlan`](crate::TrainPlan) that it runs.
#[derive(Clone, Copy)]
pub struct Services<'a> {
    /// Opens the GPU, also after it was lost.
    pub open_gpu: OpenGpu,
    /// Ends the run when requested.
    pub stop: &'a Stop,
    /// Makes the observers, for example to print their events.
    pub observer: NewObserver<'a>,
}

/// What the sessions of a run have in common.
pub(crate) struct SessionSetup<'a> {
    pub(crate) services: Services<'a>,
    pub(crate) gpu: &'a Arc<Gpu>,
    pub(crate) evaluators: Evaluators,
    pub(crate) limits: Limits,
    /// Shared by several sessions, because they take turns on one GPU.
    pub(crate) clock: Clock,
    pub(crate) n_models: usize,
    /// The run to continue.
    pub(crate) previous: Option<&'a PreviousRun>,
    /// Keyframes that are known at the start.
    pub(crate) keyframes: &'a [Arc<Keyframe>],
    /// Dataset folder or recording; `None` if a live run is not recorded.
    pub(crate) data: Option<&'a Path>,
    /// Fraction of the width and height to which images are scaled.
    pub(crate) scale: f64,
    /// Points from which training starts if no keyframe has depth.
    pub(crate) initial_points: Option<Arc<InitialPoints>>,
    /// SHA-256 of the initial points.
    pub(crate) points_sha256: Option<String>,
    pub(crate) checkpoints: CheckpointOptions,
    /// Whether the GPU time of each pass is reported at the end.
    pub(crate) profiles: bool,
    /// Flags for the checkpoints.
    pub(crate) run_flags: RunFlags,
    /// Whether the run is live. The keyframes of a live run exist nowhere else, and viewers wait
    /// for its pictures.
    pub(crate) is_live: bool,
    /// Whether training continues on another device after a GPU failure.
    pub(crate) can_recover: bool,
}

impl SessionSetup<'_> {
    /// Makes the session of one model, which writes into `folder`. The session holds no keyframes
    /// yet.
    ///
    /// * `data`: for the report and the next commands.
    /// * `resume_command`: continues the run.
    pub(crate) fn session(
        &self,
        resumed: Resumed,
        folder: &Path,
        data: DataSource,
        resume_command: ResumeCommand,
    ) -> anyhow::Result<Session> {
        let Resumed {
            model_spec,
            mut method,
            untrained,
            edits,
        } = resumed;
        let from_step = self
            .previous
            .is_some()
            .then(|| method.n_total_steps())
            .transpose()?;
        let settings = self.settings(&model_spec, from_step);
        let known: Vec<Arc<Keyframe>> = self
            .keyframes
            .iter()
            .filter(|keyframe| !untrained.iter().any(|other| Arc::ptr_eq(other, keyframe)))
            .cloned()
            .collect();
        // A replay of the log repeats the run, so the log also lists the keyframes with which the
        // run begins.
        let mut decisions = DecisionLog::create(folder, settings.clone())?;
        for keyframe in &known {
            decisions.restored(from_step.unwrap_or_default(), keyframe);
        }
        let mut observer = (self.services.observer)(self.limits, self.n_models);
        observer.on_event(&SessionEvent::Started(
            &self.started(folder, &resume_command),
        ));
        let kind = model_spec.kind;
        let recovery = Recovery {
            model_spec,
            folder: folder.to_owned(),
            resumed: self.previous.map(|previous| previous.folder.clone()),
            // The session of a live run holds all keyframes.
            known: if self.is_live { Vec::new() } else { known },
            settings,
            resume_command,
        };
        Ok(Session::new(
            self.gpu.clone(),
            (kind, method),
            SessionOptions {
                stop: self.services.stop.clone(),
                clock: self.clock.clone(),
                // Limits count from the start of the first run.
                previous_secs: self.previous.map(|previous| previous.checkpoint.seconds),
                previous_psnr: self.previous.map_or(Vec::new(), |previous| {
                    previous.checkpoint.history.psnr().to_vec()
                }),
                initial_points: self.initial_points.clone(),
                edits,
                scores_stepwise: self.is_live,
                profiles: self.profiles,
                checkpoints: self.checkpoints_in(folder),
                decisions: Some(decisions),
                recovery: self.can_recover.then_some(recovery),
                folders: KeptFolder::of_run(folder, self.n_models > 1),
                data,
                ..SessionOptions::new(self.evaluators.clone(), self.limits, observer)
            },
        ))
    }

    /// The folders of the session that writes into `folder`.
    fn started(&self, folder: &Path, resume_command: &ResumeCommand) -> StartedRun {
        let run_folder = match self.n_models {
            // Each of several models has a subfolder.
            2.. => folder.parent().unwrap_or(folder),
            _ => folder,
        };
        StartedRun {
            run_folder: run_folder.to_owned(),
            model_folder: folder.to_owned(),
            resume_command: resume_command.line(folder),
        }
    }

    /// The settings for the decision log.
    fn settings(&self, model_spec: &ModelSpec, from_step: Option<u64>) -> Settings {
        Settings::new(RunDescription {
            method: model_spec.kind.name(),
            data: self.data,
            adapter: self.gpu.describe(),
            scale: self.scale,
            depth_from: self.run_flags.depth_from.clone(),
            points: self.points_sha256.clone(),
            from_step,
            options: model_spec.options.clone(),
        })
    }

    fn checkpoints_in(&self, folder: &Path) -> Option<Checkpoints> {
        let checkpoints =
            Checkpoints::new(folder, self.checkpoints)?.with_flags(self.run_flags.clone());
        Some(if self.is_live {
            checkpoints.with_keyframes(folder)
        } else {
            checkpoints
        })
    }
}
