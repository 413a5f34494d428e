//! Trains the models of a plan, from reading the data to the report.

use super::schedule::Schedule;
use super::{TrainPlan, Trained};
use crate::checkpoints::RunFlags;
use crate::data::{Data, DataOptions, points_sha256};
use crate::depth_from::{self, DepthSource, RenderedDepth};
use crate::evaluate::Evaluator;
use crate::next_commands::DataSource;
use crate::previous_run::PreviousRun;
use crate::read_progress::OnReadProgress;
use crate::run_folder::{self, CreatedFolders};
use crate::session::{self, EndingSession, Evaluators, Limits, Session};
use crate::session_setup::{Services, SessionSetup};
use crate::training_clock::Clock;
use crate::training_options::REALIGN;
use crate::{corrected_rig, recoveries, recovery};
use capture::config::{Override, Rig};
use capture::{DriftReport, StationReport};
use gpu::Gpu;
use keyframe::Split;
use messages::{BadInput, Setting, counted};
use model_files::{Edits, InitialPoints};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::{ModelKind, Resumed};

/// Maximum time of the scheduled evaluations, as a fraction of the training time. With a larger
/// fraction, there are more scores, but training takes longer.
const MAX_EVALUATION_FRAC: f64 = 0.1;

/// A plan that is carried out.
pub(super) struct TrainRun<'a> {
    /// The plan, with the options of the previous run.
    pub(super) plan: &'a TrainPlan,
    /// The step limit before the options of the previous run were added.
    pub(super) given_steps: Option<u64>,
    pub(super) schedule: &'a dyn Schedule,
    pub(super) previous: Option<&'a PreviousRun>,
    pub(super) services: Services<'a>,
    pub(super) progress: OnReadProgress<'a>,
    /// Start of the program, for the report.
    pub(super) started: Instant,
}

/// Which images are read, and how.
struct Selection {
    images: DataOptions,
    /// Whether the poses of the base are estimated; `None` if no flag says so.
    realign: Option<bool>,
    /// Changes of the rig file.
    overrides: Vec<Override>,
    /// Model from which missing depth is rendered.
    depth_source: Option<DepthSource>,
}

/// The data, and the GPU that trains on them.
struct Input {
    data: Data,
    gpu: Arc<Gpu>,
    initial_points: Option<Arc<InitialPoints>>,
    points_sha256: Option<String>,
}

/// The entries of the report besides scores.
#[derive(Debug, Serialize)]
struct TrainDetails<'a> {
    method: &'static str,
    data: &'a Path,
    seed: u64,
    startup_secs: f64,
    n_train: usize,
    n_validation: usize,
    n_test: usize,
    data_losses: &'a [String],
    /// The command line that continues the run, if it has checkpoints.
    #[serde(skip_serializing_if = "Option::is_none")]
    resume_command: Option<String>,
    /// Estimated base pose at each station after the first.
    stations: &'a [StationReport],
    /// What range scans showed about the drift of the base.
    #[serde(skip_serializing_if = "Option::is_none")]
    drift: Option<&'a DriftReport>,
    /// Amount of depth that was rendered from a model.
    #[serde(skip_serializing_if = "Option::is_none")]
    rendered_depth: Option<&'a RenderedDepth>,
}

impl TrainRun<'_> {
    /// Carries out the plan.
    pub(super) fn train(&self, created: &mut CreatedFolders) -> anyhow::Result<Trained> {
        let previous_secs = self
            .previous
            .map_or(0.0, |previous| previous.checkpoint.seconds);
        let limits = self.schedule.limits(self.plan, previous_secs)?;
        let selection = self.selection()?;
        let evaluators = self.evaluators()?;
        // Then the data are read, which may take minutes.
        let input = self.input(&selection)?;
        let models = self.models(&input)?;
        let kinds: Vec<ModelKind> = models.iter().map(|model| model.model_spec.kind).collect();
        let seeds: Vec<u64> = models
            .iter()
            .map(|model| model.model_spec.options.common.seed)
            .collect();
        // A resumed run has one model; several new models start with the same images.
        let untrained = models[0].untrained.clone();
        // Folders are created only when nothing else can be refused.
        let folders = created.make_each(self.plan.out(), &kinds, input.data.rig.as_ref())?;
        let mut sessions = self.sessions(
            &self.setup(limits, evaluators, &selection, &input, kinds.len()),
            models,
            &folders,
            &selection,
            &input,
        )?;
        // Time for aligning base stations and rendering depth counts only in the first run.
        let preparation_time = if self.previous.is_some() {
            Duration::ZERO
        } else {
            input.data.preparation_time
        };
        self.schedule
            .drive(&mut sessions, &untrained, preparation_time, self.services)?;
        self.finish(sessions, folders, &seeds, &selection, input.data)
    }

    /// Completes and checks the selection of images.
    fn selection(&self) -> anyhow::Result<Selection> {
        let plan = self.plan;
        // Rendered depth changes the data. A checkpoint or log therefore names the model that
        // rendered it, and another model is refused.
        let depth_source = plan
            .depth_from
            .as_deref()
            .map(DepthSource::find)
            .transpose()?;
        let sha256 = depth_source.as_ref().map(|source| source.sha256.as_str());
        self.schedule.check_depth_from(sha256)?;
        let mut overrides = plan.training.overrides();
        let mut realign = plan.training.realign();
        if let Some(previous) = self.previous {
            let depth_before = previous.checkpoint.depth_from.as_deref();
            depth_from::check_same(&previous.subject(), depth_before, sha256)?;
            realign = previous.flag(REALIGN).map(|is_on| is_on == "true");
            overrides.extend(realign.map(|is_on| Override::new(REALIGN, is_on)));
        }
        Ok(Selection {
            images: self.schedule.images(plan, self.previous)?,
            realign,
            overrides,
            depth_source,
        })
    }

    /// How the models are scored.
    fn evaluators(&self) -> anyhow::Result<Evaluators> {
        // LPIPS takes far longer than PSNR and SSIM, so only the final model is scored with it.
        let evaluator = Evaluator::thorough(self.plan.lpips_weights.as_deref())?;
        Ok(Evaluators {
            during_training: evaluator.without_lpips(),
            max_images_during_training: usize::MAX,
            max_frac_during_training: Some(MAX_EVALUATION_FRAC),
            at_end: evaluator,
        })
    }

    /// Reads the data, opens the GPU, and renders missing depth.
    fn input(&self, selection: &Selection) -> anyhow::Result<Input> {
        let path = &self.plan.data;
        let mut data = self.schedule.load_data(
            path,
            &selection.images,
            &selection.overrides,
            self.progress,
        )?;
        self.check_rig_target(&data)?;
        // The GPU is opened after the data, so that it is not occupied while data is read.
        let gpu = (self.services.open_gpu)()?;
        if let Some(source) = &selection.depth_source {
            data.render_depth(gpu.clone(), source, self.progress)?;
        }
        // The data must be the same as in the run that is continued or repeated: other images or
        // points would give another model.
        let initial_points = data.initial_points();
        let points_sha256 = initial_points.as_deref().map(points_sha256);
        self.schedule
            .check_data(path, &data, points_sha256.as_deref())?;
        Ok(Input {
            data,
            gpu,
            initial_points,
            points_sha256,
        })
    }

    /// Checks, before training, that the corrected rig can be written.
    fn check_rig_target(&self, data: &Data) -> anyhow::Result<()> {
        let Some(file) = &self.plan.write_rig else {
            return Ok(());
        };
        let Some(rig) = &data.rig else {
            return Err(BadInput(format!(
                "{}: {} contains no rig file; use a recording",
                Setting::WriteRig,
                self.plan.data.display()
            ))
            .into());
        };
        corrected_rig::check_target_file(rig, file)
    }

    /// The models to train, new or restored from a checkpoint.
    fn models(&self, input: &Input) -> anyhow::Result<Vec<Resumed>> {
        let gpu = &input.gpu;
        let mut models: Vec<Resumed> = match self.previous {
            Some(previous) => vec![self.resumed(previous, input)?],
            None => self
                .schedule
                .model_specs(self.plan, &input.data, gpu.is_software())?
                .into_iter()
                .map(|model_spec| {
                    let method = model_spec.start(gpu.clone())?;
                    Ok(Resumed {
                        model_spec,
                        method,
                        untrained: input.data.keyframes.clone(),
                        edits: Edits::default(),
                    })
                })
                .collect::<anyhow::Result<_>>()?,
        };
        let from_step = self
            .previous
            .is_some()
            .then(|| models[0].method.n_total_steps())
            .transpose()?;
        self.check_given_steps(&models[0])?;
        self.schedule.check_start(from_step, &gpu.describe())?;
        // Kernels are compiled now, so that the training time does not include it.
        models
            .iter_mut()
            .try_for_each(|model| model.method.model_mut().prepare())?;
        Ok(models)
    }

    /// Restores the model of a checkpoint. Logs in which ways the run differs from an uninterrupted
    /// one.
    fn resumed(&self, previous: &PreviousRun, input: &Input) -> anyhow::Result<Resumed> {
        let resumed = trainer::resume(
            input.gpu.clone(),
            &previous.checkpoint,
            &input.data.keyframes,
        )?;
        let planned = resumed.model_spec.options.common.n_planned_steps;
        let step = resumed.method.model().progress().step;
        log::info!("continuing from step {step} of {planned} planned steps");
        if self.plan.limits.steps.is_some_and(|steps| steps > planned) {
            log::warn!(
                "the learning rate was planned to decay over {planned} steps: later steps change little"
            );
        }
        let n_new = resumed
            .untrained
            .iter()
            .filter(|keyframe| keyframe.split != Split::Test)
            .count();
        if n_new > 0 {
            log::warn!(
                "{} that are not in the checkpoint",
                counted(n_new as u64, "new image")
            );
        }
        Ok(resumed)
    }

    /// Rejects a step limit that earlier training has already passed.
    fn check_given_steps(&self, model: &Resumed) -> anyhow::Result<()> {
        // Like the limit, `step` excludes steps of rejected trials and steps before a restart.
        let step = model.method.model().progress().step;
        if let (Some(steps), Some(previous)) = (self.given_steps, self.previous)
            && steps < step
        {
            return Err(BadInput(format!(
                "{} {steps}: {} is at step {step}; use at least that many",
                Setting::Steps,
                previous.subject()
            ))
            .into());
        }
        Ok(())
    }

    /// What the sessions have in common.
    fn setup<'a>(
        &'a self,
        limits: Limits,
        evaluators: Evaluators,
        selection: &Selection,
        input: &'a Input,
        n_models: usize,
    ) -> SessionSetup<'a> {
        let plan = self.plan;
        let Selection {
            images, realign, ..
        } = selection;
        let mut flags = images.flags();
        flags.extend(realign.map(|is_on| (REALIGN.to_owned(), is_on.to_string())));
        flags.extend(plan.flags(limits));
        let depth_source = selection.depth_source.as_ref();
        let rig_scale = input.data.rig.as_ref().map(|rig| rig.train.scale);
        SessionSetup {
            services: self.services,
            gpu: &input.gpu,
            evaluators,
            limits,
            clock: Clock::default(),
            n_models,
            previous: self.previous,
            keyframes: &input.data.keyframes,
            data: Some(&plan.data),
            scale: rig_scale.or(images.scale).unwrap_or(1.0),
            initial_points: input.initial_points.clone(),
            points_sha256: input.points_sha256.clone(),
            checkpoints: plan.checkpoints,
            profiles: plan.is_profiled,
            run_flags: RunFlags {
                depth_from: depth_source.map(|source| source.sha256.clone()),
                flags,
            },
            is_live: false,
            can_recover: self.schedule.can_recover(),
        }
    }

    /// The sessions of the models, each in its folder.
    fn sessions(
        &self,
        setup: &SessionSetup<'_>,
        models: Vec<Resumed>,
        folders: &[PathBuf],
        selection: &Selection,
        input: &Input,
    ) -> anyhow::Result<Vec<Session>> {
        let source = DataSource {
            path: Some(self.plan.data.clone()),
            flags: selection.images.flags_of_images(),
            image_names: input.data.image_names(),
        };
        let mut sessions = Vec::new();
        for (model, folder) in models.into_iter().zip(folders) {
            let list = folder.join("keyframes.txt");
            run_folder::write_keyframe_list(&list, &input.data.keyframes)?;
            let resume_command = self.plan.resume_command();
            sessions.push(setup.session(model, folder, source.clone(), resume_command)?);
        }
        Ok(sessions)
    }

    /// Saves and scores the models.
    fn finish(
        &self,
        mut sessions: Vec<Session>,
        folders: Vec<PathBuf>,
        seeds: &[u64],
        selection: &Selection,
        data: Data,
    ) -> anyhow::Result<Trained> {
        // The corrections are read before the sessions are consumed. Errors are returned only after
        // the models are saved.
        let corrected_rig = self.plan.write_rig.as_ref().map(|file| {
            let rig = self.corrected_rig(&selection.images, &mut sessions);
            Box::new((rig, file.clone()))
        });
        let startup_secs = sessions[0]
            .time()
            .started()
            .map_or(0.0, |at| (at - self.started).as_secs_f64());
        let recoverable = recoveries::describe_recoverable(&mut sessions);
        let mut endings = Vec::new();
        for ((session, out), seed) in sessions.into_iter().zip(folders).zip(seeds) {
            endings.push(EndingSession {
                details: TrainDetails {
                    method: session.kind().name(),
                    data: &self.plan.data,
                    seed: *seed,
                    startup_secs,
                    n_train: data.of_split(Split::Train).len(),
                    n_validation: data.of_split(Split::Validation).len(),
                    n_test: data.of_split(Split::Test).len(),
                    data_losses: &data.data_losses,
                    resume_command: self
                        .plan
                        .checkpoints
                        .are_written()
                        .then(|| self.plan.resume_command().line(&out)),
                    stations: &data.stations,
                    drift: data.drift.as_ref(),
                    rendered_depth: data.rendered_depth.as_ref(),
                },
                session,
                out,
            });
        }
        let finished = session::finish(endings, None);
        let models = finished.map_err(|error| recovery::with_recoverable(error, &recoverable))?;
        Ok(Trained {
            models,
            data_losses: data.data_losses,
            corrected_rig,
        })
    }

    /// The rig of the data, with the corrections of the first session that has any. Logs the reason
    /// if nothing changes.
    fn corrected_rig(&self, images: &DataOptions, sessions: &mut [Session]) -> anyhow::Result<Rig> {
        let rig = Data::rig_as_given(&self.plan.data, images)?;
        for session in &mut *sessions {
            let learned = session.camera_corrections()?;
            let corrected = corrected_rig::corrected(&rig, session.alignment(), &learned)?;
            if !corrected.has_same_calibration(&rig) {
                return Ok(corrected);
            }
        }
        match sessions.iter().find_map(Session::alignment) {
            None => log::warn!("no calibration was estimated: the rig file is written unchanged"),
            Some(alignment) if !alignment.has_enough_validation_images() => {
                log::warn!("too few validation images: the rig file is written unchanged");
            }
            Some(_) => log::info!("the rig file needs no correction"),
        }
        Ok(rig)
    }
}
