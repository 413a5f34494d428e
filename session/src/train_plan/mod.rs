//! A training run on data from disk: checks its input, reads the data, opens the run folder, trains
//! all models, and saves them. `fieldrig train` is one call of [`TrainPlan::run`].

mod replay;
mod schedule;
mod train_run;

use crate::checkpoints::CheckpointOptions;
use crate::data::DataOptions;
use crate::depth_from::{self, DepthSource};
use crate::error::is_rejection;
use crate::models_verdict::{likely_cause_of, verdict_of};
use crate::previous_run::{FinishedRun, PreviousRun, limit_flags, out_folder};
use crate::read_progress::OnReadProgress;
use crate::resume_command::ResumeCommand;
use crate::run_folder::{self, CreatedFolders};
use crate::session::{FinishedModel, Limits};
use crate::session_setup::Services;
use crate::training_options::TrainingOptions;
use crate::verdict::ImageLoss;
use crate::{corrected_rig, training};
use capture::config::Rig;
use messages::Setting;
use replay::Replay;
use schedule::{Schedule, UntilLimit};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;
use train_run::TrainRun;
use viz::Verdict;

/// Training time if there is no limit, seconds.
const DEFAULT_SECONDS: f64 = 120.0;
/// Names of the flags in checkpoints.
const DEPTH_FROM: &str = "depth-from";
const LPIPS_WEIGHTS: &str = "lpips-weights";
const WRITE_RIG: &str = "write-rig";
const PROFILE: &str = "profile";

/// Options of a training run on data from disk.
#[derive(Clone, Debug, Default)]
pub struct TrainPlan {
    /// A dataset folder or a recording.
    pub data: PathBuf,
    /// Which images are used.
    pub images: DataOptions,
    /// Which models are trained.
    pub training: TrainingOptions,
    /// When training stops. Without any limit, training stops after 120 s. Time and steps of the
    /// resumed run count, too.
    pub limits: Limits,
    /// Steps over which the learning rate decays and the model grows. If `None`, this is the step
    /// limit, or a default if there is no step limit.
    pub n_planned_steps: Option<u64>,
    /// Folder of a run to continue, with its flags.
    pub resume: Option<PathBuf>,
    /// Decision log of an earlier run, whose timing-dependent decisions are repeated.
    pub replay_decisions: Option<PathBuf>,
    /// Model from which missing depth is rendered.
    pub depth_from: Option<PathBuf>,
    /// Weights for LPIPS.
    pub lpips_weights: Option<PathBuf>,
    /// Folder of the results. If `None`, the folder of `resume` if it contains no model, or else a
    /// new folder in `runs`.
    pub out: Option<PathBuf>,
    /// File for the recording's rig with the estimated calibration.
    pub write_rig: Option<PathBuf>,
    /// How often checkpoints are written.
    pub checkpoints: CheckpointOptions,
    /// Whether the GPU time of each kernel is measured at the end.
    pub is_profiled: bool,
}

/// Result of a training run.
pub enum TrainOutcome {
    /// The run to continue had reached its limits, and no other limits were given.
    NothingLeft(FinishedRun),
    /// The models were trained, saved and scored.
    Trained(Trained),
}

/// Models that were trained, saved and scored.
pub struct Trained {
    /// The models.
    pub models: Vec<FinishedModel>,
    /// Descriptions of data that could not be read.
    pub data_losses: Vec<String>,
    /// The rig with the estimated calibration, and its file.
    corrected_rig: Option<Box<(anyhow::Result<Rig>, PathBuf)>>,
}

impl Trained {
    /// How good the models are, in one sentence.
    pub fn verdict(&self) -> Verdict {
        verdict_of(&self.models, ImageLoss::default())
    }

    /// The likely cause of a poor result, and its remedy.
    pub fn likely_cause(&self) -> Option<String> {
        likely_cause_of(&self.models)
    }

    /// Writes the rig with the estimated calibration, if the plan names a file for it.
    pub fn write_rig(&mut self) -> anyhow::Result<()> {
        if let Some(corrected) = self.corrected_rig.take() {
            let (rig, file) = *corrected;
            corrected_rig::write(&rig?, &file)?;
            log::info!("rig file written to {}", file.display());
        }
        Ok(())
    }
}

impl TrainPlan {
    /// Reads the data, trains until a limit or a request to stop, scores on the evaluation
    /// schedule, and saves. Removes the folders of a run that is rejected.
    pub fn run(
        &self,
        services: Services<'_>,
        progress: OnReadProgress<'_>,
    ) -> anyhow::Result<TrainOutcome> {
        let mut created = CreatedFolders::default();
        let result = self.run_in(&mut created, services, progress);
        created.keep_unless(result.as_ref().is_err_and(is_rejection));
        result
    }

    fn run_in(
        &self,
        created: &mut CreatedFolders,
        services: Services<'_>,
        progress: OnReadProgress<'_>,
    ) -> anyhow::Result<TrainOutcome> {
        let started = Instant::now();
        // First come all checks that read little, so that the user learns of an error at once.
        let schedule = self.schedule()?;
        training::limits(self.limits.seconds, self.limits.steps, DEFAULT_SECONDS)?;
        run_folder::check_out(
            self.out.as_deref(),
            self.resume.as_deref(),
            Some(&self.data),
            &self.resume_command(),
        )?;
        // Then the checkpoint of the resumed run is read, because its flags complete the given
        // ones.
        let previous = self.resume.as_deref().map(PreviousRun::read).transpose()?;
        if let Some(previous) = &previous {
            if previous.is_finished() && !self.asks_for_more() {
                self.check_depth_of_finished(previous)?;
                return Ok(TrainOutcome::NothingLeft(previous.finished()));
            }
            previous.check_not_passed(self.limits)?;
        }
        let plan = match &previous {
            Some(previous) => self.with_flags_of(previous),
            None => self.clone(),
        };
        let run = TrainRun {
            plan: &plan,
            given_steps: self.limits.steps,
            schedule: &*schedule,
            previous: previous.as_ref(),
            services,
            progress,
            started,
        };
        run.train(created).map(TrainOutcome::Trained)
    }

    /// Decides when the models receive keyframes, and when training ends.
    fn schedule(&self) -> anyhow::Result<Box<dyn Schedule>> {
        match &self.replay_decisions {
            Some(log) => Ok(Box::new(Replay::load(log)?)),
            None => Ok(Box::new(UntilLimit)),
        }
    }

    /// Whether a finished run is to be continued.
    fn asks_for_more(&self) -> bool {
        self.limits.seconds.is_some()
            || self.limits.steps.is_some()
            || self.replay_decisions.is_some()
            || !self.images.flags().is_empty()
    }

    /// Checks that a finished run used the same model to render depth, if one is given.
    fn check_depth_of_finished(&self, previous: &PreviousRun) -> anyhow::Result<()> {
        let Some(model) = &self.depth_from else {
            return Ok(());
        };
        let sha256 = DepthSource::find(model)?.sha256;
        depth_from::check_same(
            &previous.subject(),
            previous.checkpoint.depth_from.as_deref(),
            Some(&sha256),
        )
    }

    /// The flags to store in checkpoints, besides those of the images, by name.
    fn flags(&self, limits: Limits) -> BTreeMap<String, String> {
        let depth_from = self.depth_from.as_deref().map(canonical);
        let lpips_weights = self.lpips_weights.as_deref().map(canonical);
        // The file does not exist yet, so it cannot be canonicalized.
        let write_rig = self.write_rig.as_deref().map(absolute);
        let given = [
            (DEPTH_FROM, depth_from),
            (LPIPS_WEIGHTS, lpips_weights),
            (WRITE_RIG, write_rig),
            (PROFILE, self.is_profiled.then(|| true.to_string())),
        ];
        let flags = limit_flags(limits)
            .into_iter()
            .chain(given)
            .filter_map(|(name, value)| Some((name.to_owned(), value?)));
        flags.chain(self.checkpoints.flag()).collect()
    }

    /// Returns this plan with missing options taken from the previous run. The path of an output is
    /// never taken from it, because the checkpoint may come from somebody else.
    fn with_flags_of(&self, previous: &PreviousRun) -> Self {
        let path = |name: &str| previous.flag(name).map(PathBuf::from);
        if let (None, Some(file)) = (&self.write_rig, previous.flag(WRITE_RIG)) {
            log::warn!(
                "no rig file is written: the previous run wrote {file:?}; to write it again, add {}",
                Setting::WriteRig
            );
        }
        Self {
            limits: previous.limits_or_previous(self.limits),
            depth_from: self.depth_from.clone().or_else(|| path(DEPTH_FROM)),
            lpips_weights: self.lpips_weights.clone().or_else(|| path(LPIPS_WEIGHTS)),
            is_profiled: self.is_profiled || previous.flag(PROFILE).is_some(),
            checkpoints: self.checkpoints.or_previous(&previous.checkpoint.flags),
            ..self.clone()
        }
    }

    /// The command that continues this run.
    fn resume_command(&self) -> ResumeCommand {
        ResumeCommand::of_data(&self.data)
    }

    /// The folder of the results, if it is not a new one in `runs`.
    fn out(&self) -> Option<&Path> {
        out_folder(self.out.as_deref(), self.resume.as_deref())
    }
}

/// The path of an existing file, for a later run that may be started in another folder.
fn canonical(file: &Path) -> String {
    file.canonicalize()
        .unwrap_or_else(|_| file.to_owned())
        .display()
        .to_string()
}

/// The absolute path of a file to write, for a later run that may be started in another folder.
fn absolute(file: &Path) -> String {
    std::path::absolute(file)
        .unwrap_or_else(|_| file.to_owned())
        .display()
        .to_string()
}
