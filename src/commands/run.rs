//! `fieldrig run`: opens devices, joins their samples, trains, and serves the page.

use super::number_in_range;
use crate::checkpoint_args::CheckpointArgs;
use crate::console::{Console, OutputMode, print_next_commands};
use crate::exit::{self, Exit};
use crate::open_gpu::open_gpu;
use crate::page_args::PageArgs;
use crate::permission_args::PermissionArgs;
use crate::served_page::ServedPage;
use crate::training_args::TrainingArgs;
use crate::{print, signals};
use anyhow::Context;
use capture::config::{ArmDriver, Override, Rig};
use capture::doctor;
use capture::open::{self, Devices, Opened};
use capture::{
    Counts, Feed, Input, InputResult, Join, Notes, Rejection, RobotMotion, SampleUse, StampClock,
    StationReport, Stations, Stop,
};
use drivers::Source;
use gpu::Gpu;
use keyframe::{Keyframe, Split};
use kinematics::Stamp;
use messages::{BadInput, InsufficientData, counted};
use model_files::Edits;
use model_files::checkpoint::Checkpoint;
use serde::Serialize;
use session::methods::{self, COUNT};
use session::next_commands::{DataSource, quoted};
use session::run_folder::{self, CreatedFolders};
use session::{
    AvailableData, Checkpoints, Clock, DecisionLog, EndingSession, Evaluator, Evaluators,
    FinishedModel, KeptFolder, Latency, Limits, LiveLoop, LiveOptions, ModelViewer, Pace, REALIGN,
    Recovery, RefineSettings, RunDescription, RunFlags, ServedModel, Session, SessionOptions,
    Settings, StoredKeyframes, Viewers, checkpoints, corrected_rig, methods_of, recovery,
    robot_meshes,
};
use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use trainer::splat::CountPolicy;
use trainer::{CommonOptions, ModelKind, ModelSpec, Resumed};
use viz::{Hub, RunResult};

/// Flags of `run`.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// Rig file: cameras, arm and training settings (TOML)
    rig_file: PathBuf,
    /// Simulate all devices of the rig file
    #[arg(long, conflicts_with = "from")]
    sim: bool,
    /// Make the simulation wait for the trainer, so that with --steps the result depends only on
    /// the seed [default: real time]
    #[arg(long, requires = "sim", conflicts_with = "from")]
    lockstep: bool,
    /// Replay a recording instead of live devices
    #[arg(long, value_name = "RECORDING")]
    from: Option<PathBuf>,
    /// Play the recording at the speed of its devices instead of waiting for the trainer. Keyframes
    /// are taken as they arrive, and images that come too fast are dropped
    #[arg(long, requires = "from", conflicts_with = "steps_per_keyframe")]
    real_time: bool,
    /// Play the recording again whenever it ends, until the limit of --seconds or --steps is
    /// reached
    #[arg(long, requires = "real_time", conflicts_with = "record")]
    repeat: bool,
    /// Also write everything that the devices send to an MCAP file. Images that devices drop then
    /// count as a loss (exit code 3)
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Continue a run that crashed or was stopped, from the checkpoint and keyframes in its folder
    /// and with its flags. New keyframes are added; --record and --listen are not restored
    #[arg(long, value_name = "FOLDER", conflicts_with_all = ["from", "method", "seed", "max_bytes", "max_splats", "refine", "count"])]
    resume: Option<PathBuf>,
    /// Stop S seconds after the first image; time before --resume counts [default: run until
    /// Ctrl-C]
    #[arg(long, value_name = "S", allow_negative_numbers = true, value_parser = number_in_range(0.0..=1e9))]
    seconds: Option<f64>,
    /// Stop after N optimizer steps, or when the devices have ended and all data is fused; steps
    /// before --resume count. With --lockstep, the result then depends only on the seed
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Optimizer steps between two keyframes; needs --lockstep or --from [default: 10]
    #[arg(long, value_name = "N")]
    steps_per_keyframe: Option<u64>,
    #[command(flatten)]
    training: TrainingArgs,
    #[command(flatten)]
    page: PageArgs,
    /// Folder for the results and the effective rig file; several methods get a subfolder each. A
    /// folder that contains a model is refused [default: a new folder in runs]
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) permissions: PermissionArgs,
    #[command(flatten)]
    checkpoints: CheckpointArgs,
    /// At a limit, keep serving the page until Ctrl-C, or exit [default: stay on a terminal without
    /// --json, else exit]
    #[arg(long, value_name = "WHAT")]
    when_done: Option<WhenDone>,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

/// What to do when a run reaches its limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum WhenDone {
    /// Show the model on the page until Ctrl-C.
    Stay,
    /// Exit.
    Exit,
}

/// Names of the flags in checkpoints.
const SECONDS: &str = "seconds";
const STEPS: &str = "steps";
const STEPS_PER_KEYFRAME: &str = "steps-per-keyframe";
const SIM: &str = "sim";
const LOCKSTEP: &str = "lockstep";
/// Name of the rig file with the corrections of a run.
const CORRECTED_RIG: &str = "corrected-rig.toml";
const RECORD: &str = "record";

/// Time for which the server stays up, so that connected clients receive the last status. They are
/// on this computer or a local network, where a message arrives within milliseconds.
const FINAL_STATUS_TIME: Duration = Duration::from_millis(400);
/// Steps between two keyframes if the flag is not given. With more, a model learns more from each
/// keyframe before the next one, and the run takes longer.
const DEFAULT_STEPS_PER_KEYFRAME: u64 = 10;
/// Maximum time of the scheduled evaluations, as a fraction of the training time. With more, the
/// scores are known more often, but the model is worse at the same time.
const MAX_EVALUATION_FRAC: f64 = 0.1;
/// Keyframes wait during an evaluation, so it must be short, especially on a software adapter.
const MAX_IMAGES_SCORED_LIVE: usize = 12;
const MAX_IMAGES_SCORED_LIVE_ON_CPU: usize = 4;

/// The entries of the report besides scores.
#[derive(Debug, Serialize)]
struct RunDetails {
    method: &'static str,
    seed: u64,
    keyframes: usize,
    evicted: u64,
    rejected: BTreeMap<&'static str, u64>,
    device_skipped: u64,
    /// Number of range scans, which are stored in addition to the keyframes, and number of their
    /// points.
    range_scans: usize,
    range_points: usize,
    data_losses: Vec<String>,
    /// Estimated base pose at each station after the first.
    stations: Vec<StationReport>,
    /// Durations from mid-exposure to the model and to viewers, by name; only for the first model.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    latencies: Vec<(String, Latency)>,
    /// Largest camera position error of a keyframe, meters; only in simulation.
    #[serde(skip_serializing_if = "Option::is_none")]
    max_position_error_m: Option<f64>,
}

/// Runs until a limit, the end of the devices, or Ctrl-C; saves the model, its keyframes and the
/// effective rig file.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let mut created = CreatedFolders::default();
    let mut has_keyframes = false;
    let result = drive(args, &mut created, &mut has_keyframes);
    // The folder of a run that failed before its first keyframe contains nothing of use.
    created.keep_unless(
        result
            .as_ref()
            .is_err_and(|error| !has_keyframes || exit::is_rejection(error)),
    );
    result
}

/// Runs until the end, and saves the results. Sets `has_keyframes` when the run is over.
fn drive(
    args: &Args,
    created: &mut CreatedFolders,
    has_keyframes: &mut bool,
) -> anyhow::Result<Exit> {
    // The previous run is read before anything else, because its flags decide what this run does.
    let previous = args.resume.as_deref().map(PreviousRun::read).transpose()?;
    if let Some(previous) = &previous
        && args.is_finished(previous)
    {
        return args.report_finished(previous);
    }
    if let Some(previous) = &previous {
        let subject = format!("the checkpoint in {}", previous.folder.display());
        checkpoints::check_limit_not_passed(args.seconds, &previous.checkpoint, &subject)?;
    }
    let args = &previous
        .as_ref()
        .map_or_else(|| args.clone(), |previous| args.with_flags_of(previous));
    // Everything that can fail because of the arguments has failed before this line, or in `start`
    // before the devices are opened.
    let mut running = start(args, previous.as_ref(), created)?;
    let result = loop {
        match running.run_time_slice() {
            Ok(true) => {}
            Ok(false) => match running.live.wait() {
                Ok(false) => break Ok(()),
                Ok(true) => {} // The model was restored and may have fewer steps.
                Err(error) => break Err(error),
            },
            Err(error) => break Err(error),
        }
    };
    let Running {
        live,
        rig,
        folders,
        damage,
        stop,
        page,
        ..
    } = running;
    // From here on, the results of the run are saved whatever happens. Then the folder must stay,
    // even after an error.
    *has_keyframes = !live.keyframes().is_empty();
    let hub = live.hub();
    if let Err(error) = result {
        // The devices are stopped before saving, which may take minutes.
        stop.request();
        // Without a GPU, the model cannot be read back. Its last checkpoint and the input remain.
        if session::is_gpu_error(&error) || session::is_gpu_unrecoverable(&error) {
            return Err(keep_input(live, &folders, error));
        }
        log::error!("training failed; saving the model so far: {error:#}");
        if let Err(error) = save(live, args, &rig, folders, &damage) {
            log::error!("{error:#}");
        }
        return Err(error);
    }
    if live.has_exhausted_input() {
        log::info!("the devices have ended and all their data is in the model");
    }
    stop.request();
    let (exit, models) = save(live, args, &rig, folders, &damage)?;
    // After a signal, the user expects the program to end.
    if args.keeps_serving() && !models.is_empty() && !stop.signaled() {
        print::report(format_args!(
            "serving the page at {} until Ctrl-C",
            page.url()
        ));
        let models = models.into_iter().map(served_model).collect();
        ModelViewer::new(models, hub).serve(&stop);
    }
    Ok(exit)
}

/// A finished model as the page shows it after the run.
fn served_model(model: FinishedModel) -> ServedModel {
    let FinishedModel {
        kind,
        method,
        edits,
        folder,
        ..
    } = model;
    ServedModel {
        kind,
        method,
        edits,
        path: folder,
    }
}

/// Publishes the result of a run to its page.
fn publish_end(hub: &Hub, models: &[FinishedModel]) {
    let name = |model: &FinishedModel| match models.len() {
        1 => model.scores.to_string(),
        _ => format!("{} {}", model.kind.name(), model.scores),
    };
    // Several models have a subfolder each.
    let folder = models.first().map(|model| match models.len() {
        1 => model.folder.as_path(),
        _ => model.folder.parent().unwrap_or(&model.folder),
    });
    hub.set_run_result(RunResult {
        folder: folder.map(|folder| folder.display().to_string()),
        scores: models.iter().map(name).collect::<Vec<_>>().join("; "),
        seconds: models.iter().map(|model| model.seconds).fold(0.0, f64::max),
    });
    if hub.n_clients() > 0 {
        std::thread::sleep(FINAL_STATUS_TIME); // Clients keep showing the result after the server has stopped.
    }
}

/// A run whose devices are open.
pub(super) struct Running {
    pub(super) live: LiveLoop,
    pub(super) gpu: Arc<Gpu>,
    pub(super) page: ServedPage,
    stop: Stop,
    rig: Rig,
    folders: Vec<PathBuf>,
    damage: Arc<OnceLock<String>>,
}

impl Running {
    /// Takes keyframes, trains for one slice, renders and publishes the status; returns `false`
    /// when the run is over or interrupted.
    pub(super) fn run_time_slice(&mut self) -> anyhow::Result<bool> {
        if self.stop.requested() || self.live.is_over() {
            return Ok(false);
        }
        self.live.advance()?;
        Ok(true)
    }

    /// Closes the devices without saving anything.
    pub(super) fn discard(self) -> anyhow::Result<DiscardedRun> {
        let is_interrupted = self.stop.signaled();
        self.stop.request();
        let keyframes = self.live.keyframes();
        let has_model = keyframes
            .iter()
            .any(|keyframe| keyframe.split == Split::Train);
        let n_keyframes = keyframes.len();
        let (mut sessions, input_result) = self.live.finish();
        // The caller may remove the folders, so checkpoints in progress must finish first.
        sessions
            .iter_mut()
            .for_each(|session| session.persistence().wait_for_checkpoint());
        let input_result = input_result?;
        let counts = input_result.join.counts();
        let mut data_losses = counts.data_losses(SampleUse::ProcessedOnly);
        data_losses.extend(self.damage.get().cloned());
        let no_model_reason = (!has_model).then(|| no_model_reason(n_keyframes, counts, &self.rig));
        Ok(DiscardedRun {
            input_result,
            data_losses,
            no_model_reason,
            is_interrupted,
        })
    }
}

/// What remains of a run that saves nothing.
pub(super) struct DiscardedRun {
    pub(super) input_result: InputResult,
    pub(super) data_losses: Vec<String>,
    /// Why there was nothing to train on.
    pub(super) no_model_reason: Option<String>,
    /// Whether a signal ended the run.
    pub(super) is_interrupted: bool,
}

/// Opens the devices, the GPU and the page; continues the `previous` run if there is one.
pub(super) fn start(
    args: &Args,
    previous: Option<&PreviousRun>,
    created: &mut CreatedFolders,
) -> anyhow::Result<Running> {
    // First all checks of the arguments, so that an error of the user does not start devices,
    // compile kernels or create folders.
    args.page.check()?;
    // The results of another run in this folder would be overwritten.
    if let Some(out) = &args.out {
        run_folder::check_no_model(out)?;
        if args.resume.as_ref() != Some(out) {
            run_folder::check_no_unfinished_run(out)?;
        }
    }
    // Signals are handled before the rig is read, so that Ctrl-C during a long start is an orderly
    // end, too.
    let stop = signals::stop_on_signals()?;
    let mut overrides = args.overrides();
    overrides.extend(previous.map(PreviousRun::overrides).into_iter().flatten());
    let rig = Rig::load(&args.rig_file, &overrides)?;
    let kinds = methods_of(&rig)?;
    args.training.options().check_for(&kinds)?;
    let depth = rig.cameras.iter().any(|camera| camera.depth.is_some());
    let available = AvailableData {
        joints: true,
        drifts: rig.has_moving_base(),
        depth,
        color_only: !depth && rig.scanners.is_empty(),
        many_images_per_camera: true,
    };
    let training = args.training.options();
    training.check_learned(&kinds, available)?;
    training.refining_live(available, true)?; // Invalid flags are rejected before the GPU is opened.
    let (common, mut settings) = methods::options(&rig.train, args.steps);
    settings.push((
        COUNT,
        serde_json::json!(training.count.unwrap_or(CountPolicy::ToCap)),
    ));
    let pace = args.pace(&rig)?;
    // The GPU is opened before the devices: their queues fill while the GPU starts, and images
    // would be lost.
    let gpu = open_gpu()?;
    let RefineSettings {
        align,
        with_scene: cameras,
    } = training.refining_live(available, gpu.is_software())?;
    // A resumed run continues with the parameters of the first one.
    if previous.is_none() {
        args.training.log_unestimated(available, &gpu);
    }
    let common = CommonOptions {
        cameras,
        align,
        align_timing: pace.align_timing(),
        detects_movements: !rig.has_moving_base(),
        ..common
    };
    let mut models: Vec<Resumed> = match previous {
        Some(previous) => vec![previous.resume(&gpu)?],
        None => methods::specs(&kinds, &common, &settings)?
            .into_iter()
            .map(|model_spec| {
                let method = model_spec.start(gpu.clone())?;
                Ok(Resumed {
                    model_spec,
                    method,
                    untrained: Vec::new(),
                    edits: Edits::default(),
                })
            })
            .collect::<anyhow::Result<_>>()?,
    };
    // The page is served before kernels are compiled, so that its address in use is reported at
    // once, and viewers can connect meanwhile.
    let hub = Hub::new();
    let page = args.page.serve(&hub)?;
    for finding in doctor::suspicious_values(&rig) {
        log::warn!("{finding}");
    }
    // Compile kernels before the first image, so that keyframes do not wait.
    models
        .iter_mut()
        .try_for_each(|model| model.method.model_mut().prepare())?;
    // Only now the devices, because their data is used from the first sample on.
    let device_notes = Notes::default();
    let Opened {
        rig,
        source,
        damage,
        stamp_clock,
    } = args.open(rig)?.with_tag_check(&device_notes)?;
    page.print(args.json, serde_json::json!({}))?;
    // Folders come after the devices, whose rig, with the calibration that cameras report, is
    // written there.
    let folders = created.make_each(args.out(), &kinds, Some(&rig))?;
    let held = previous.map_or(&[][..], |previous| &previous.keyframes);
    let (input, evicted) = args.input(&rig, (source, stamp_clock), held)?;
    if let Some(robot) = robot_meshes::description(&rig, &args.rig_file)? {
        hub.set_robot(robot);
    }
    let feed = Feed::start(input, Box::new(Viewers(hub.clone())), stop.clone())?;
    let notes = notes(&gpu);
    let evaluators = evaluators(&gpu)?;
    let limits = Limits {
        seconds: args.seconds,
        steps: args.steps,
    };
    let setup = SessionSetup {
        args,
        previous,
        gpu: &gpu,
        rig: &rig,
        evaluators,
        limits,
        clock: Clock::default(),
        n_models: kinds.len(),
        held,
        evicted: &evicted,
        stop: &stop,
    };
    let mut sessions = Vec::new();
    for (resumed, folder) in models.into_iter().zip(&folders) {
        sessions.push(setup.session(resumed, folder)?);
    }
    let start_keyframes = rig
        .join
        .start_keyframes_or_default(pace == Pace::RealTime, depth);
    let options = LiveOptions {
        pace,
        start_keyframes,
        notes,
        device_notes,
        open_gpu,
    };

    let held = sessions
        .first()
        .map_or(Vec::new(), |session| session.keyframes().to_vec());
    let live = LiveLoop::new(sessions, feed, hub, options).resume_from(held);
    Ok(Running {
        live,
        gpu,
        page,
        stop,
        rig,
        folders,
        damage,
    })
}

/// How the models of a live run are scored.
fn evaluators(gpu: &Gpu) -> anyhow::Result<Evaluators> {
    Ok(Evaluators {
        during_training: Evaluator::psnr_only(),
        max_images_during_training: if gpu.is_software() {
            MAX_IMAGES_SCORED_LIVE_ON_CPU
        } else {
            MAX_IMAGES_SCORED_LIVE
        },
        max_frac_during_training: Some(MAX_EVALUATION_FRAC),
        at_end: Evaluator::thorough(None)?,
    })
}

/// What the sessions of a run have in common.
struct SessionSetup<'a> {
    args: &'a Args,
    previous: Option<&'a PreviousRun>,
    gpu: &'a Arc<Gpu>,
    rig: &'a Rig,
    evaluators: Evaluators,
    limits: Limits,
    /// Shared by several sessions, because they take turns on one GPU.
    clock: Clock,
    n_models: usize,
    /// Keyframes of the previous run.
    held: &'a [Arc<Keyframe>],
    /// Those of them that exceed the memory limit.
    evicted: &'a [Evicted],
    stop: &'a Stop,
}

impl SessionSetup<'_> {
    /// The session of one model, with the keyframes of the previous run.
    fn session(&self, resumed: Resumed, folder: &Path) -> anyhow::Result<Session> {
        let Resumed {
            model_spec: ModelSpec { kind, options },
            mut method,
            untrained,
            edits,
        } = resumed;
        let args = self.args;
        let from_step = self
            .previous
            .is_some()
            .then(|| method.n_total_steps())
            .transpose()?;
        let description = RunDescription {
            method: kind.name(),
            data: args.record.as_deref().or(args.from.as_deref()),
            adapter: self.gpu.describe(),
            scale: self.rig.train.scale,
            depth_from: None,
            points: None,
            from_step,
            options: options.clone(),
        };
        let settings = Settings::new(description);
        // The log repeats the run, so it also lists the keyframes with which the run begins.
        let mut decisions = DecisionLog::create(folder, settings.clone())?;
        let is_new =
            |keyframe: &Arc<Keyframe>| untrained.iter().any(|other| Arc::ptr_eq(other, keyframe));
        for keyframe in self.held.iter().filter(|keyframe| !is_new(keyframe)) {
            decisions.restored(from_step.unwrap_or_default(), keyframe);
        }
        let recovery = Recovery {
            model_spec: ModelSpec { kind, options },
            folder: folder.to_owned(),
            resumed: self.previous.map(|previous| previous.folder.clone()),
            known: Vec::new(), // The session holds all keyframes.
            settings,
            resume_command: args.resume_command(folder),
        };
        let console = Console::new(
            OutputMode::of_command(args.json),
            self.limits,
            self.n_models,
        );
        let checkpoints = Checkpoints::new(folder, args.checkpoints.options());
        let run_flags = RunFlags {
            depth_from: None,
            flags: args.flags(self.limits),
        };
        let mut session = Session::new(
            self.gpu.clone(),
            (kind, method),
            SessionOptions {
                stop: self.stop.clone(),
                clock: self.clock.clone(),
                // Limits count from the start of the first run.
                previous_secs: self.previous.map(|previous| previous.checkpoint.seconds),
                edits,
                scores_stepwise: true,
                checkpoints: checkpoints.map(|to| to.with_flags(run_flags).with_keyframes(folder)),
                decisions: Some(decisions),
                recovery: Some(recovery),
                folders: KeptFolder::of_run(folder, self.n_models > 1),
                data: args.data_source(folder),
                ..SessionOptions::new(self.evaluators.clone(), self.limits, Box::new(console))
            },
        );
        // The model of the checkpoint was trained on its keyframes already; only others are pushed.
        for keyframe in self.held {
            if is_new(keyframe) {
                session.push(keyframe)?
            } else {
                session.hold(keyframe)
            }
        }
        // They exceed the memory limit of this run.
        for (camera, stamp) in self.evicted {
            session.remove(camera, *stamp)?;
        }
        Ok(session)
    }
}

/// Closes the recording and writes the keyframe lists after a GPU failure. Returns the error with a
/// note of what was saved.
fn keep_input(mut live: LiveLoop, folders: &[PathBuf], error: anyhow::Error) -> anyhow::Error {
    // Described while the sessions still exist.
    let recoverable = live.describe_recoverable();
    let (sessions, input_result) = live.finish();
    for (session, folder) in sessions.iter().zip(folders) {
        if let Err(error) =
            run_folder::write_keyframe_list(&folder.join("keyframes.txt"), session.keyframes())
        {
            log::error!("{error:#}");
        }
    }
    match input_result {
        Ok(input_result) => {
            log::info!("{}", input_result.join.counts());
            if let Some(error) = input_result.recording_error {
                log::error!("the recording is incomplete: {error:#}");
            }
        }
        Err(error) => log::error!("{error:#}"),
    }
    let is_already_reported = recoverable.is_empty() || session::is_gpu_unrecoverable(&error);
    if is_already_reported {
        error
    } else {
        error.context(format!("the run stopped early; {recoverable}"))
    }
}

/// Saves the models, then reports errors of the input.
fn save(
    mut live: LiveLoop,
    args: &Args,
    rig: &Rig,
    folders: Vec<PathBuf>,
    damage: &OnceLock<String>,
) -> anyhow::Result<(Exit, Vec<FinishedModel>)> {
    // Everything that describes the run is read first, because `finish` consumes it.
    let hub = live.hub();
    let n_keyframes = live.keyframes().len();
    let n_train = live
        .keyframes()
        .iter()
        .filter(|keyframe| keyframe.split == Split::Train)
        .count();
    let position_error_m = max_position_error_m(live.keyframes());
    let recoverable = live.describe_recoverable();
    let mut latencies = live.ledger().latencies();
    // Closes the recording and ends the input thread, whose counts are then final.
    let (mut sessions, input_result) = live.finish();
    sessions
        .iter_mut()
        .for_each(|session| session.persistence().check_folders());
    let input_result = match input_result {
        Ok(input_result) => input_result,
        Err(error) => {
            // Save the models even if the input has failed.
            let details = || serde_json::json!({ "data_losses": [error.to_string()] });
            let ending = |(session, out): (Session, PathBuf)| EndingSession {
                details: details(),
                session,
                out,
            };
            if n_train > 0 {
                session::finish(
                    sessions.into_iter().zip(folders).map(ending).collect(),
                    Some(&hub),
                )?;
            }
            return Err(error);
        }
    };
    // Errors are returned only at the end: the models may still be saved even if the disk is too
    // full for the lists.
    let list = |(session, folder): (&Session, &PathBuf)| {
        run_folder::write_keyframe_list(&folder.join("keyframes.txt"), session.keyframes())
    };
    let listed = sessions.iter().zip(&folders).try_for_each(list);
    let counts = input_result.join.counts();
    log::info!("{counts}");
    let mut data_losses = counts.data_losses(if args.record.is_some() && args.from.is_none() {
        SampleUse::Recorded
    } else {
        SampleUse::ProcessedOnly
    });
    // Commands that score the model later need a complete recording at this path.
    let is_moved = args.record.as_ref().is_some_and(|file| !file.exists());
    let is_recorded = input_result.recording_error.is_none() && !is_moved;
    data_losses.extend(
        input_result
            .recording_error
            .map(|error| format!("the recording is incomplete: {error:#}")),
    );
    data_losses.extend(damage.get().cloned());
    // Estimated before the models are saved, because saving consumes the sessions.
    let corrected = corrected_rigs(rig, &mut sessions, &folders);
    let stations = input_result
        .stations
        .as_ref()
        .map_or(Vec::new(), |stations| stations.reports().to_vec());
    let mut ending = |(session, out): (Session, PathBuf)| EndingSession {
        details: RunDetails {
            method: session.kind().name(),
            seed: rig.train.seed,
            keyframes: session.keyframes().len(),
            evicted: counts.evicted,
            rejected: counts
                .rejected
                .iter()
                .map(|(why, n)| (why.name(), *n))
                .collect(),
            device_skipped: counts.device_skipped,
            range_scans: input_result.join.range_scans().count(),
            range_points: input_result
                .join
                .range_scans()
                .map(|scan| scan.points_in_world_m.len())
                .sum(),
            data_losses: data_losses.clone(),
            stations: stations.clone(),
            latencies: std::mem::take(&mut latencies),
            max_position_error_m: position_error_m,
        },
        session: if is_recorded {
            session
        } else {
            session.with_data(DataSource::default())
        },
        out,
    };
    let mut models = Vec::new();
    if n_train > 0 {
        let finished = session::finish(
            sessions.into_iter().zip(folders).map(&mut ending).collect(),
            Some(&hub),
        );
        models = finished.map_err(|error| recovery::with_recoverable(error, &recoverable))?;
        if !args.json {
            print_next_commands(&models);
        }
    }
    // The page shows the result before errors are returned, because viewers have waited for it.
    publish_end(&hub, &models);
    listed?;
    for (rig, file) in corrected? {
        corrected_rig::write(&rig, &file)?;
        log::info!(
            "rig file with the estimated corrections written to {}",
            file.display()
        );
    }
    if let Some(error) = input_result.input_error {
        return Err(anyhow::Error::new(error).context("a device failed"));
    }
    if n_train == 0 {
        return Err(InsufficientData(no_model_reason(n_keyframes, counts, rig)).into());
    }
    Ok((exit::from_losses(&data_losses), models))
}

/// The corrected rig files, with their paths, of the models whose cameras were corrected.
fn corrected_rigs(
    rig: &Rig,
    sessions: &mut [Session],
    folders: &[PathBuf],
) -> anyhow::Result<Vec<(Rig, PathBuf)>> {
    let mut rigs = Vec::new();
    for (session, folder) in sessions.iter_mut().zip(folders) {
        let learned = session.camera_corrections()?;
        let corrected = corrected_rig::corrected(rig, session.alignment(), &learned)?;
        // An unchanged file would only look like a correction.
        if !corrected.has_same_calibration(rig) {
            rigs.push((corrected, folder.join(CORRECTED_RIG)));
        }
    }
    Ok(rigs)
}

/// Camera and stamp of a keyframe that was evicted for lack of memory.
type Evicted = (Arc<str>, Stamp);

/// A run to continue.
pub(super) struct PreviousRun {
    folder: PathBuf,
    checkpoint: Checkpoint,
    /// Its keyframes, ordered by stamp.
    keyframes: Vec<Arc<Keyframe>>,
}

impl PreviousRun {
    fn read(folder: &Path) -> anyhow::Result<Self> {
        let checkpoint = checkpoints::read(folder)?;
        let stored = StoredKeyframes::of_run(folder).read();
        let keyframes = stored.with_context(|| {
            format!(
                "the run in {} has no usable keyframes; to continue from a recording, use `fieldrig train`",
                folder.display()
            )
        })?;
        log::info!(
            "continuing the run in {} after {:.1} s, with {}",
            folder.display(),
            checkpoint.seconds,
            counted(keyframes.len() as u64, "keyframe")
        );
        Ok(Self {
            folder: folder.to_owned(),
            checkpoint,
            keyframes,
        })
    }

    /// Restores its model, without the keyframes that cannot be read.
    fn resume(&self, gpu: &Arc<Gpu>) -> anyhow::Result<Resumed> {
        let (resumed, missing) =
            trainer::resume_without_missing(gpu.clone(), &self.checkpoint, &self.keyframes)?;
        if let Some((camera, stamp)) = missing.first() {
            log::warn!(
                "{} of the earlier run {} missing, the first of camera {camera:?} at {} ns: training continues without them, \
                 but their effect on the model so far remains",
                counted(missing.len() as u64, "keyframe"),
                if missing.len() == 1 { "is" } else { "are" },
                stamp.0
            );
        }
        Ok(resumed)
    }

    /// Rig file settings that flags of that run have changed.
    fn overrides(&self) -> Vec<Override> {
        let realign = self
            .checkpoint
            .flags
            .get(REALIGN)
            .map(|is_on| Override::new(REALIGN, is_on == "true"));
        let method = ModelKind::from_name(&self.checkpoint.method)
            .map(|kind| Override::new("train.method", kind.name()));
        realign.into_iter().chain(method).collect()
    }
}

impl Args {
    fn overrides(&self) -> Vec<Override> {
        let mut overrides = self.training.options().overrides();
        if self.lockstep {
            overrides.push(Override::new("sim.lockstep", true));
        }
        overrides
    }

    /// Whether to keep serving the page after the run.
    fn keeps_serving(&self) -> bool {
        let is_watched = !self.json && std::io::stdout().is_terminal();
        self.when_done
            .map_or(is_watched, |when_done| when_done == WhenDone::Stay)
    }

    /// The flags to store in the checkpoint, by name.
    fn flags(&self, limits: Limits) -> BTreeMap<String, String> {
        let is_on = |flag: bool| flag.then(|| true.to_string());
        let given = [
            (SECONDS, limits.seconds.map(|seconds| seconds.to_string())),
            (STEPS, limits.steps.map(|steps| steps.to_string())),
            (
                STEPS_PER_KEYFRAME,
                self.steps_per_keyframe.map(|n| n.to_string()),
            ),
            (SIM, is_on(self.sim)),
            (LOCKSTEP, is_on(self.lockstep)),
            (
                RECORD,
                self.record.as_ref().map(|file| file.display().to_string()),
            ),
            (
                REALIGN,
                self.training
                    .options()
                    .realign()
                    .map(|is_on| is_on.to_string()),
            ),
        ];
        let flags = given
            .into_iter()
            .filter_map(|(name, value)| Some((name.to_owned(), value?)));
        flags.chain(self.checkpoints.options().flag()).collect()
    }

    /// Returns these flags; missing ones are taken from the previous run.
    fn with_flags_of(&self, previous: &PreviousRun) -> Self {
        let flag = |name: &str| previous.checkpoint.flags.get(name);
        // A given limit replaces both previous ones. Otherwise, `--steps` would not continue a run
        // that had reached its `--seconds`.
        let has_limit = self.seconds.is_some() || self.steps.is_some();
        let limit = |name: &str| flag(name).filter(|_| !has_limit);
        if let (Some(file), None) = (flag(RECORD), &self.record) {
            log::warn!(
                "the first part was recorded to {file}; this part is not recorded unless --record names another file"
            );
        }
        Self {
            seconds: self.seconds.or_else(|| limit(SECONDS)?.parse().ok()),
            steps: self.steps.or_else(|| limit(STEPS)?.parse().ok()),
            steps_per_keyframe: self
                .steps_per_keyframe
                .or_else(|| flag(STEPS_PER_KEYFRAME)?.parse().ok()),
            sim: self.sim || flag(SIM).is_some(),
            lockstep: self.lockstep || flag(LOCKSTEP).is_some(),
            checkpoints: self
                .checkpoints
                .options()
                .or_previous(&previous.checkpoint.flags)
                .into(),
            ..self.clone()
        }
    }

    /// Whether the previous run reached its limit and saved its model, and no flag raises the
    /// limit.
    fn is_finished(&self, previous: &PreviousRun) -> bool {
        let asks_for_more = self.seconds.is_some() || self.steps.is_some();
        let has_model = || run_folder::check_no_model(&previous.folder).is_err();
        previous.checkpoint.is_finished && !asks_for_more && has_model()
    }

    fn report_finished(&self, previous: &PreviousRun) -> anyhow::Result<Exit> {
        let folder = &previous.folder;
        let seconds = previous.checkpoint.seconds;
        if self.json {
            print::report_json(
                &serde_json::json!({ "event": "finished", "seconds": seconds, "out": folder }),
            )?;
        } else {
            print::report(format_args!(
                "nothing left to do: the run in {} is finished ({seconds:.1} s) and its model is saved there; \
                 to continue it, use a larger --steps or --seconds",
                folder.display()
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

    /// The command that resumes the run in a folder.
    fn resume_command(&self, folder: &Path) -> String {
        let [rig, folder] = [&*self.rig_file, folder].map(|path| quoted(&path.to_string_lossy()));
        format!("fieldrig run {rig} --resume {folder}")
    }

    /// The data and flags with which `eval` scores the model in `folder` on the images of this run.
    fn data_source(&self, folder: &Path) -> DataSource {
        // A recording that was started with --resume lacks the earlier images.
        let path = self
            .record
            .as_ref()
            .or(self.from.as_ref())
            .filter(|_| self.resume.is_none())
            .cloned();
        let rig = folder
            .join(drivers::recording::RIG_FILE)
            .display()
            .to_string();
        DataSource {
            path,
            flags: vec!["--rig".to_owned(), rig],
            ..DataSource::default()
        }
    }

    fn open(&self, rig: Rig) -> anyhow::Result<Opened> {
        match &self.from {
            Some(recording) => {
                let opened = open::recording(recording, Some(rig), &[])?;
                let opened = if self.repeat {
                    opened.repeated(recording)
                } else {
                    opened
                };
                Ok(if self.real_time {
                    opened.in_real_time()
                } else {
                    opened
                })
            }
            None => open::rig(
                rig,
                if self.sim {
                    Devices::Sim
                } else {
                    Devices::Real
                },
            ),
        }
    }

    /// Opens the input and restores the keyframes of the previous run. Also returns keyframes that
    /// exceed the memory limit.
    fn input(
        &self,
        rig: &Rig,
        (source, stamp_clock): (Box<dyn Source>, StampClock),
        previous: &[Arc<Keyframe>],
    ) -> anyhow::Result<(Input, Vec<Evicted>)> {
        let (join, evicted) = Join::new(rig)?.resume_from(previous);
        let input = Input {
            source,
            join,
            stations: Stations::new(rig).map(|stations| stations.resume_from(previous)),
            recorder: self
                .record
                .as_deref()
                .map(|file| open::recorder(file, rig))
                .transpose()?,
            robot_motion: RobotMotion::new(rig),
            stamp_clock,
            camera_intrinsics: rig
                .cameras
                .iter()
                .map(|camera| {
                    (
                        camera.name.clone(),
                        (camera.intrinsics.focal_px, camera.intrinsics.principal_px),
                    )
                })
                .collect(),
        };
        Ok((input, evicted))
    }

    /// Recordings and lockstep simulations wait for the trainer; everything else runs in real time.
    fn pace(&self, rig: &Rig) -> Result<Pace, BadInput> {
        let is_simulated = self.sim || rig.arm.driver == ArmDriver::Sim;
        // A recording waits for the trainer unless a flag says otherwise.
        let is_lockstep = match self.from {
            Some(_) => !self.real_time,
            None => is_simulated && rig.sim.lockstep,
        };
        if is_lockstep {
            let steps_per_keyframe = self
                .steps_per_keyframe
                .unwrap_or(DEFAULT_STEPS_PER_KEYFRAME);
            return Ok(Pace::Lockstep { steps_per_keyframe });
        }
        match self.steps_per_keyframe {
            Some(_) => Err(BadInput(
                "--steps-per-keyframe: this run uses keyframes in real time, as they arrive; the flag needs --lockstep or --from"
                    .into(),
            )),
            None => Ok(Pace::RealTime),
        }
    }
}

/// A sentence that explains why a run ended without a model.
fn no_model_reason(n_keyframes: usize, counts: &Counts, rig: &Rig) -> String {
    let expected = quoted_names(rig.cameras.iter().map(|camera| &*camera.name));
    let unknown = quoted_names(counts.unknown_cameras.iter().map(|name| &**name));
    let n_unknown = counts
        .rejected
        .get(&Rejection::UnknownCamera)
        .copied()
        .unwrap_or_default();
    match (n_keyframes, counts.accepted) {
        (1, _) => format!("nothing to train on: the only keyframe is a test image ({counts})"),
        (2.., _) => {
            format!("nothing to train on: all {n_keyframes} keyframes are test images ({counts})")
        }
        (0, 1..) => format!("the run ended before the trainer received a keyframe ({counts})"),
        (0, 0) if counts.images == 0 => {
            format!("no image was received; the rig file has the cameras {expected}")
        }
        (0, 0) if n_unknown == counts.images => {
            format!(
                "no image is from a camera in the rig file ({expected}): all {n_unknown} are from {unknown}"
            )
        }
        (0, 0) => format!("no image became a keyframe: {counts}"),
    }
}

fn quoted_names<'a>(names: impl Iterator<Item = &'a str>) -> String {
    names
        .map(|name| format!("{name:?}"))
        .collect::<Vec<_>>()
        .join(", ")
}

/// Largest position error of the keyframes; `None` if no true poses are known (only simulators
/// report them).
fn max_position_error_m(keyframes: &[Arc<Keyframe>]) -> Option<f64> {
    keyframes
        .iter()
        .filter_map(position_error_m)
        .reduce(f64::max)
}

fn position_error_m(keyframe: &Arc<Keyframe>) -> Option<f64> {
    let truth = keyframe
        .truth
        .as_ref()?
        .world_from_camera
        .translation
        .vector;
    Some((keyframe.world_from_camera.translation.vector - truth).norm())
}

/// Notes that the page shows to its viewers.
pub(super) fn notes(gpu: &Gpu) -> Vec<String> {
    if gpu.is_software() {
        vec!["no GPU: kernels run on the CPU, which is slow".to_owned()]
    } else {
        Vec::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn run_without_a_model_reports_the_reason() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/static-arm.toml");
        let rig = Rig::load(&path, &[]).expect("a rig");
        let counts = |images, accepted, rejected: &[(Rejection, u64)]| Counts {
            images,
            accepted,
            rejected: rejected.iter().copied().collect(),
            unknown_cameras: ["front".into()].into(),
            ..Counts::default()
        };
        for (n_keyframes, counts, expected) in [
            (
                1,
                counts(1, 1, &[]),
                "the only keyframe is a test image (1 keyframe of 1 image)",
            ),
            (
                0,
                counts(1, 1, &[]),
                "ended before the trainer received a keyframe",
            ),
            (0, counts(0, 0, &[]), "no image was received"),
            (
                0,
                counts(7, 0, &[(Rejection::UnknownCamera, 7)]),
                "(\"wrist\"): all 7 are from \"front\"",
            ),
            (
                0,
                counts(7, 0, &[(Rejection::NoPose, 7)]),
                "0 keyframes of 7 images; 7 no joint states or base pose",
            ),
        ] {
            let message = no_model_reason(n_keyframes, &counts, &rig);
            assert!(message.contains(expected), "{message}");
        }
    }
}
