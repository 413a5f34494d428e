//! `fieldrig train`: trains models on a dataset folder or a recording.

use crate::checkpoint_args::CheckpointArgs;
use crate::console::{Console, OutputMode, ReadBar, print_next_commands};
use crate::data_args::DataArgs;
use crate::exit::{self, Exit};
use crate::open_gpu::open_gpu;
use crate::permission_args::PermissionArgs;
use crate::training_args::TrainingArgs;
use crate::{print, signals};
use capture::StationReport;
use capture::config::{Override, Rig};
use gpu::Gpu;
use keyframe::{Keyframe, Split};
use messages::{BadInput, counted};
use model_files::Edits;
use model_files::checkpoint::Checkpoint;
use serde::Serialize;
use session::depth_from::{self, DepthSource, RenderedDepth};
use session::next_commands::{DataSource, quoted};
use session::run_folder::{self, CreatedFolders};
use session::{
    Checkpoints, Clock, Data, DecisionLog, EndingSession, Evaluator, Evaluators, KeptFolder,
    Limits, Purpose, REALIGN, Recovery, Replay, RunDescription, RunFlags, Session, SessionOptions,
    Settings, checkpoints, corrected_rig, points_sha256, recoveries, recovery,
};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::{ModelKind, ModelSpec, Resumed};

/// Maximum time of the scheduled evaluations, as a fraction of the training time. With more, the
/// scores are known more often, but training takes longer.
const MAX_EVALUATION_FRAC: f64 = 0.1;
/// Training time if no flag limits it.
const DEFAULT_SECONDS: f64 = 120.0;
/// Names of the flags in checkpoints.
const SECONDS: &str = "seconds";
const STEPS: &str = "steps";
const DEPTH_FROM: &str = "depth-from";
const LPIPS_WEIGHTS: &str = "lpips-weights";
const WRITE_RIG: &str = "write-rig";
const PROFILE: &str = "profile";

/// Flags of `train`.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// A nerfstudio or TUM RGB-D folder, or a recording (.mcap)
    data: PathBuf,
    #[command(flatten)]
    training: TrainingArgs,
    /// Continue from the checkpoint in this folder, on the same data and with its flags; no other
    /// flag is needed. A larger --steps or --seconds continues a finished run; model settings
    /// cannot be changed
    #[arg(long, value_name = "FOLDER", conflicts_with_all = ["method", "seed", "max_bytes", "max_splats", "refine", "count", "plan_steps"])]
    resume: Option<PathBuf>,
    /// Repeat the timing-dependent decisions in this decisions.jsonl of an earlier run. With the
    /// same data, this gives the same model
    #[arg(long, value_name = "FILE", conflicts_with_all = ["method", "seed", "max_bytes", "max_splats", "refine", "count", "plan_steps", "seconds", "steps", "holdout", "keyframes", "scale"])]
    replay_decisions: Option<PathBuf>,
    /// Stop after S seconds of training; loading and scoring do not count, time before --resume
    /// does [default: 120, unless --steps is given]
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    seconds: Option<f64>,
    /// Stop after N optimizer steps; steps before --resume count. Without --seconds, no decision
    /// depends on timing, and the result depends only on the seed
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Steps over which the learning rate decays and the model grows [default: --steps, else 7000]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    plan_steps: Option<u64>,
    #[command(flatten)]
    images: DataArgs,
    /// Render depth from this model (a folder or a splat file) for images that have depth on less
    /// than half of their pixels. All methods treat rendered depth as measured. The model must be
    /// of the same scene, in the same world frame. --refine then estimates parameters jointly with
    /// the scene
    #[arg(long, value_name = "MODEL")]
    depth_from: Option<PathBuf>,
    /// `SqueezeNet` weights for LPIPS (safetensors) [default: `FIELDRIG_LPIPS_WEIGHTS`, else no
    /// LPIPS]
    #[arg(long, value_name = "FILE")]
    lpips_weights: Option<PathBuf>,
    /// Folder for the results; several methods get a subfolder each. A folder that contains a model
    /// is refused [default: the folder of --resume if it contains no model, else a new folder in
    /// runs]
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Write the recording's rig file here with the estimated calibration, and the robot
    /// description (robot.urdf) next to it
    #[arg(long, value_name = "FILE")]
    write_rig: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) permissions: PermissionArgs,
    #[command(flatten)]
    checkpoints: CheckpointArgs,
    /// Print the GPU time of each kernel at the end
    #[arg(long)]
    profile: bool,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
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
    /// Estimated base pose at each station after the first.
    stations: &'a [StationReport],
    /// Amount of depth that was rendered from a model.
    #[serde(skip_serializing_if = "Option::is_none")]
    rendered_depth: Option<&'a RenderedDepth>,
}

/// Loads the data, trains until a limit or Ctrl-C, scores on the evaluation schedule, and saves.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let mut created = CreatedFolders::default();
    let result = train(args, &mut created);
    created.keep_unless(result.as_ref().is_err_and(exit::is_rejection));
    result
}

fn train(args: &Args, created: &mut CreatedFolders) -> anyhow::Result<Exit> {
    let started = Instant::now();
    // First all checks that read little, so that an error of the user costs no time.
    let replay = args
        .replay_decisions
        .as_deref()
        .map(Replay::load)
        .transpose()?;
    session::limits(args.seconds, args.steps, DEFAULT_SECONDS)?; // Checked before anything is read.
    if let Some(out) = &args.out {
        run_folder::check_no_model(out)?;
        run_folder::check_not_data_folder(out, &args.data)?;
        if args.resume.as_ref() != Some(out) {
            run_folder::check_no_unfinished_run(out)?;
        }
    }
    let stop = signals::stop_on_signals()?;
    // Then the checkpoint of a run that is continued, whose flags complete the given ones.
    let checkpoint = args.resume.as_deref().map(checkpoints::read).transpose()?;
    let subject = args
        .resume
        .as_deref()
        .map(|folder| format!("the checkpoint in {}", folder.display()));
    if let (Some(checkpoint), Some(subject)) = (&checkpoint, &subject) {
        if args.is_finished(checkpoint) {
            if let Some(model) = &args.depth_from {
                let sha256 = DepthSource::find(model)?.sha256;
                depth_from::check_same(subject, checkpoint.depth_from.as_deref(), Some(&sha256))?;
            }
            return args.report_finished(checkpoint);
        }
        checkpoints::check_limit_not_passed(args.seconds, checkpoint, subject)?;
    }
    let given_steps = args.steps;
    let args = &checkpoint
        .as_ref()
        .map_or_else(|| args.clone(), |checkpoint| args.with_flags_of(checkpoint));
    // A replay ends with the decisions of its log, so it has no limits of its own.
    let limits = match (&replay, &checkpoint) {
        (Some(_), _) => Limits::default(),
        (None, checkpoint) => {
            let previous_secs = checkpoint
                .as_ref()
                .map_or(0.0, |checkpoint| checkpoint.seconds);
            session::limits(args.seconds, args.steps, previous_secs + DEFAULT_SECONDS)?
        }
    };
    // Rendered depth changes the data. A checkpoint or log therefore names the model that rendered
    // it, and another model is refused.
    let depth_from = args
        .depth_from
        .as_deref()
        .map(DepthSource::find)
        .transpose()?;
    let depth_model_sha256 = depth_from.as_ref().map(|source| source.sha256.as_str());
    if let Some(replay) = &replay {
        replay.check_depth_from(depth_model_sha256)?;
    }
    let mut images = args.images.options();
    let mut overrides = args.training.options().overrides();
    let mut realign = args.training.options().realign();
    if let Some(replay) = &replay {
        images.scale = Some(replay.decisions.settings.scale);
    }
    if let (Some(checkpoint), Some(subject)) = (&checkpoint, &subject) {
        depth_from::check_same(
            subject,
            checkpoint.depth_from.as_deref(),
            depth_model_sha256,
        )?;
        if replay.is_none() {
            images = images.completed_with(subject, &checkpoint.flags)?;
        }
        realign = checkpoint.flags.get(REALIGN).map(|is_on| is_on == "true");
        overrides.extend(realign.map(|is_on| Override::new(REALIGN, is_on)));
    } else if replay.is_none() {
        session::check_before_data(&args.training.options(), &args.data, &images)?;
    }
    // LPIPS takes far longer than PSNR and SSIM, so only the final model is scored with it.
    let evaluator = Evaluator::thorough(args.lpips_weights.as_deref())?;
    let evaluators = Evaluators {
        during_training: evaluator.without_lpips(),
        max_images_during_training: usize::MAX,
        max_frac_during_training: Some(MAX_EVALUATION_FRAC),
        at_end: evaluator,
    };
    // Then the data, which may take minutes.
    let bar = ReadBar::new(args.json);
    let mut data = match &replay {
        Some(replay) => replay.load_data(&args.data, args.images.options().rig, &|read| {
            bar.show(read)
        })?,
        None => Data::load(
            &args.data,
            &images,
            Purpose::Training,
            &overrides,
            &|read| bar.show(read),
        )?,
    };
    if let Some(file) = &args.write_rig {
        let Some(rig) = &data.rig else {
            let data = args.data.display();
            return Err(BadInput(format!(
                "--write-rig: {data} contains no rig file; use a recording"
            ))
            .into());
        };
        corrected_rig::check_target_file(rig, file)?; // Checked before training.
    }
    // The GPU is opened after the data, so that it is not occupied while data is read.
    let gpu = open_gpu()?;
    if let Some(source) = &depth_from {
        data.render_depth(gpu.clone(), source, &|read| bar.show(read))?;
    }
    // The data must be the same as in the run that is continued or repeated: other images or points
    // would give another model.
    let initial_points = data.initial_points();
    let initial_points_sha256 = initial_points.as_deref().map(points_sha256);
    if let Some(replay) = &replay {
        replay.check_data(&args.data, &data)?;
        replay.check_points(initial_points_sha256.as_deref())?;
    }
    let mut models = args.models(&gpu, &data, replay.as_ref(), checkpoint.as_ref())?;
    let from_step = checkpoint
        .is_some()
        .then(|| models[0].method.n_total_steps())
        .transpose()?;
    // Like the limit, `step` excludes steps of rejected trials and steps before a restart.
    let step = models[0].method.model().progress().step;
    if let (Some(steps), Some(subject)) = (given_steps, &subject)
        && steps < step
    {
        return Err(BadInput(format!(
            "--steps {steps}: {subject} is at step {step}; use at least that many"
        ))
        .into());
    }
    if let Some(replay) = &replay {
        replay.check_start(from_step)?;
        replay.check_adapter(&gpu.describe());
    }
    // Kernels are compiled now, so that the training time does not include it.
    models
        .iter_mut()
        .try_for_each(|model| model.method.model_mut().prepare())?;
    let kinds: Vec<ModelKind> = models.iter().map(|model| model.model_spec.kind).collect();
    // Folders are created only when nothing else can be refused.
    let folders = created.make_each(args.out(), &kinds, data.rig.as_ref())?;
    let mut flags = images.flags();
    flags.extend(realign.map(|is_on| (REALIGN.to_owned(), is_on.to_string())));
    flags.extend(args.flags(limits));
    let source = DataSource {
        path: Some(args.data.clone()),
        flags: images.flags_of_images(),
        image_names: data.image_names(),
    };
    let run_flags = RunFlags {
        depth_from: depth_model_sha256.map(str::to_owned),
        flags,
    };

    let untrained = models[0].untrained.clone(); // A resumed run has one model; several new models start with the same images.
    let is_untrained =
        |keyframe: &Arc<Keyframe>| untrained.iter().any(|other| Arc::ptr_eq(other, keyframe));
    // Several models share the time, because they take turns on one GPU.
    let clock = Clock::default();
    let mut sessions = Vec::new();
    let mut seeds = Vec::new();
    for (
        Resumed {
            model_spec: ModelSpec { kind, options },
            method,
            edits,
            ..
        },
        folder,
    ) in models.into_iter().zip(&folders)
    {
        run_folder::write_keyframe_list(&folder.join("keyframes.txt"), &data.keyframes)?;
        seeds.push(options.common.seed);
        let description = RunDescription {
            method: kind.name(),
            data: Some(&args.data),
            adapter: gpu.describe(),
            scale: data
                .rig
                .as_ref()
                .map(|rig| rig.train.scale)
                .or(images.scale)
                .unwrap_or(1.0),
            depth_from: run_flags.depth_from.clone(),
            points: initial_points_sha256.clone(),
            from_step,
            options,
        };
        let recovery = Recovery {
            model_spec: ModelSpec {
                kind,
                options: description.options.clone(),
            },
            folder: folder.clone(),
            resumed: args.resume.clone(),
            known: data
                .keyframes
                .iter()
                .filter(|keyframe| !is_untrained(keyframe))
                .cloned()
                .collect(),
            settings: Settings::new(description),
            resume_command: args.resume_command(folder),
        };
        let mut decisions = DecisionLog::create(folder, recovery.settings.clone())?;
        for keyframe in data
            .keyframes
            .iter()
            .filter(|keyframe| !is_untrained(keyframe))
        {
            decisions.restored(from_step.unwrap_or_default(), keyframe);
        }
        let console = Console::new(OutputMode::of_command(args.json), limits, kinds.len());
        let checkpoints = Checkpoints::new(folder, args.checkpoints.options());
        sessions.push(Session::new(
            gpu.clone(),
            (kind, method),
            SessionOptions {
                stop: stop.clone(),
                clock: clock.clone(),
                previous_secs: match (&kinds[..], &checkpoint) {
                    ([_], Some(checkpoint)) => Some(checkpoint.seconds),
                    _ => None,
                },
                initial_points: initial_points.clone(),
                edits,
                profiles: args.profile,
                checkpoints: checkpoints.map(|to| to.with_flags(run_flags.clone())),
                decisions: Some(decisions),
                // A replay is not restarted after a GPU failure, because its log refers to step
                // numbers.
                recovery: replay.is_none().then_some(recovery),
                folders: KeptFolder::of_run(folder, kinds.len() > 1),
                data: source.clone(),
                ..SessionOptions::new(evaluators.clone(), limits, Box::new(console))
            },
        ));
    }
    // Time for aligning base stations and rendering depth counts only in the first run.
    let preparation_time = if checkpoint.is_some() {
        Duration::ZERO
    } else {
        data.preparation_time
    };
    match &replay {
        Some(replay) => replay.drive(&mut sessions[0], &untrained, &stop)?,
        None => session::drive(&mut sessions, &untrained, preparation_time, &stop, open_gpu)?,
    }

    // Read before the sessions are consumed. Errors are returned only after the models are saved.
    let corrected = args
        .write_rig
        .as_ref()
        .map(|_| with_corrections(&Data::rig_as_given(&args.data, &images)?, &mut sessions));
    let startup_secs = sessions[0]
        .time()
        .started()
        .map_or(0.0, |at| (at - started).as_secs_f64());
    let ending = |((session, out), seed): ((Session, PathBuf), u64)| EndingSession {
        details: TrainDetails {
            method: session.kind().name(),
            data: &args.data,
            seed,
            startup_secs,
            n_train: data.of_split(Split::Train).len(),
            n_validation: data.of_split(Split::Validation).len(),
            n_test: data.of_split(Split::Test).len(),
            data_losses: &data.data_losses,
            stations: &data.stations,
            rendered_depth: data.rendered_depth.as_ref(),
        },
        session,
        out,
    };
    let recoverable = recoveries::describe_recoverable(&mut sessions);
    let finished = session::finish(
        sessions
            .into_iter()
            .zip(folders)
            .zip(seeds)
            .map(ending)
            .collect(),
        None,
    );
    let finished = finished.map_err(|error| recovery::with_recoverable(error, &recoverable))?;
    if !args.json {
        print_next_commands(&finished);
    }
    if let (Some(file), Some(rig)) = (&args.write_rig, corrected) {
        corrected_rig::write(&rig?, file)?;
        log::info!("rig file written to {}", file.display());
    }
    Ok(exit::from_losses(&data.data_losses))
}

/// The rig with the corrections of the first session that has any. Logs the reason if nothing
/// changes.
fn with_corrections(rig: &Rig, sessions: &mut [Session]) -> anyhow::Result<Rig> {
    for session in &mut *sessions {
        let learned = session.camera_corrections()?;
        let corrected = corrected_rig::corrected(rig, session.alignment(), &learned)?;
        if !corrected.has_same_calibration(rig) {
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
    Ok(rig.clone())
}

/// The path of an existing file, for a later run that may be started in another folder.
fn canonical(file: &Path) -> String {
    file.canonicalize()
        .unwrap_or_else(|_| file.to_owned())
        .display()
        .to_string()
}

/// The path of a file to write, for the same purpose.
fn absolute(file: &Path) -> String {
    std::path::absolute(file)
        .unwrap_or_else(|_| file.to_owned())
        .display()
        .to_string()
}

impl Args {
    /// The models to train, new or restored from a checkpoint.
    fn models(
        &self,
        gpu: &Arc<Gpu>,
        data: &Data,
        replay: Option<&Replay>,
        checkpoint: Option<&Checkpoint>,
    ) -> anyhow::Result<Vec<Resumed>> {
        if let Some(checkpoint) = checkpoint {
            return Ok(vec![self.resumed(trainer::resume(
                gpu.clone(),
                checkpoint,
                &data.keyframes,
            )?)]);
        }
        let model_specs = match replay {
            Some(replay) => vec![replay.model_spec()],
            None => {
                self.training.log_unestimated(data.available(), gpu);
                session::model_specs(
                    &self.training.options(),
                    data,
                    self.plan_steps.or(self.steps),
                    gpu.is_software(),
                )?
            }
        };
        model_specs
            .into_iter()
            .map(|model_spec| {
                let method = model_spec.start(gpu.clone())?;
                Ok(Resumed {
                    model_spec,
                    method,
                    untrained: data.keyframes.clone(),
                    edits: Edits::default(),
                })
            })
            .collect()
    }

    /// The flags to store in the checkpoint, besides those of the images, by name.
    fn flags(&self, limits: Limits) -> BTreeMap<String, String> {
        let depth_from = self.depth_from.as_deref().map(canonical);
        let lpips_weights = self.lpips_weights.as_deref().map(canonical);
        // The file does not exist yet, so it cannot be canonicalized.
        let write_rig = self.write_rig.as_deref().map(absolute);
        let given = [
            (SECONDS, limits.seconds.map(|seconds| seconds.to_string())),
            (STEPS, limits.steps.map(|steps| steps.to_string())),
            (DEPTH_FROM, depth_from),
            (LPIPS_WEIGHTS, lpips_weights),
            (WRITE_RIG, write_rig),
            (PROFILE, self.profile.then(|| true.to_string())),
        ];
        let flags = given
            .into_iter()
            .filter_map(|(name, value)| Some((name.to_owned(), value?)));
        flags.chain(self.checkpoints.options().flag()).collect()
    }

    /// Returns these flags; missing ones are taken from the previous run. The path of an output is
    /// not, because the checkpoint may come from somebody else.
    fn with_flags_of(&self, checkpoint: &Checkpoint) -> Self {
        let flag = |name: &str| checkpoint.flags.get(name);
        let path = |name: &str| flag(name).map(PathBuf::from);
        if let (None, Some(file)) = (&self.write_rig, flag(WRITE_RIG)) {
            log::warn!(
                "no rig file is written: the previous run wrote {file:?}; to write it again, add --write-rig"
            );
        }
        // A given limit replaces both previous ones. Otherwise, `--steps` would not continue a run
        // that had reached its `--seconds`.
        let has_limit = self.seconds.is_some() || self.steps.is_some();
        let limit = |name: &str| flag(name).filter(|_| !has_limit);
        Self {
            seconds: self.seconds.or_else(|| limit(SECONDS)?.parse().ok()),
            steps: self.steps.or_else(|| limit(STEPS)?.parse().ok()),
            depth_from: self.depth_from.clone().or_else(|| path(DEPTH_FROM)),
            lpips_weights: self.lpips_weights.clone().or_else(|| path(LPIPS_WEIGHTS)),
            profile: self.profile || flag(PROFILE).is_some(),
            checkpoints: self
                .checkpoints
                .options()
                .or_previous(&checkpoint.flags)
                .into(),
            ..self.clone()
        }
    }

    /// The command that resumes training in a folder.
    fn resume_command(&self, folder: &Path) -> String {
        let [data, folder] = [&*self.data, folder].map(|path| quoted(&path.to_string_lossy()));
        format!("fieldrig train {data} --resume {folder}")
    }

    /// Whether the previous run reached its limit and saved its model, and no flag raises the
    /// limit.
    fn is_finished(&self, checkpoint: &Checkpoint) -> bool {
        let asks_for_more = self.seconds.is_some()
            || self.steps.is_some()
            || self.replay_decisions.is_some()
            || !self.images.options().flags().is_empty();
        checkpoint.is_finished && !asks_for_more && self.has_saved_model()
    }

    /// Whether the folder of `--resume` contains a model.
    fn has_saved_model(&self) -> bool {
        self.resume
            .as_deref()
            .is_some_and(|folder| run_folder::check_no_model(folder).is_err())
    }

    fn report_finished(&self, checkpoint: &Checkpoint) -> anyhow::Result<Exit> {
        let folder = self.resume.as_deref().unwrap_or(Path::new(""));
        let limits = [STEPS, SECONDS]
            .into_iter()
            .filter_map(|name| {
                let value = checkpoint.flags.get(name)?;
                Some(format!("--{name} {value}"))
            })
            .collect::<Vec<_>>()
            .join(" ");
        if self.json {
            let seconds = checkpoint.seconds;
            print::report_json(
                &serde_json::json!({ "event": "finished", "seconds": seconds, "out": folder }),
            )?;
        } else {
            print::report(format_args!(
                "nothing left to do: the run in {} is finished ({limits}, {:.1} s) and its model is saved there; \
                 to continue it, use a larger --steps or --seconds",
                folder.display(),
                checkpoint.seconds
            ));
        }
        Ok(Exit::Done)
    }

    /// The given folder; an unfinished run continues in its previous folder.
    fn out(&self) -> Option<&Path> {
        self.out.as_deref().or_else(|| self.unfinished_folder())
    }

    /// The folder of the previous run, if it contains no model yet.
    fn unfinished_folder(&self) -> Option<&Path> {
        self.resume
            .as_deref()
            .filter(|folder| run_folder::check_no_model(folder).is_ok())
    }

    /// Logs in which ways the resumed run differs from an uninterrupted one.
    fn resumed(&self, resumed: Resumed) -> Resumed {
        let planned = resumed.model_spec.options.common.n_planned_steps;
        let step = resumed.method.model().progress().step;
        log::info!("continuing from step {step} of {planned} planned steps");
        if self.steps.is_some_and(|steps| steps > planned) {
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
        resumed
    }
}
