//! `fieldrig run`: opens devices, joins their samples, trains, and serves the page.

use crate::checkpoint_args::CheckpointArgs;
use crate::console::{Console, OutputMode, print_end, print_finished_run};
use crate::exit::{self, Exit};
use crate::number_args::number_in_range;
use crate::open_gpu::open_gpu;
use crate::page_args::{PageArgs, workspace_at};
use crate::permission_args::PermissionArgs;
use crate::training_args::{TRAINING_ARGS, TrainingArgs};
use crate::{print, signals};
use capture::Stop;
use session::{
    EndedRun, Limits, ModelViewer, PreviousLiveRun, RunInProgress, RunInput, RunPlan, Services,
};
use std::io::IsTerminal;
use std::path::PathBuf;
use viz::ServedPage;

/// Flags of `run`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Rig file: cameras, arm and training settings (TOML) [default: with --from, the rig in the
    /// recording]
    #[arg(required_unless_present = "from")]
    rig_file: Option<PathBuf>,
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
    /// Let operators steer the arm, or a base that moves, from the page. Confirms that nobody is
    /// within reach of a real robot, and that a hand is on the emergency stop. A real arm also
    /// needs the table arm.motion in the rig file, and a real base the table base.motion. Not
    /// restored by --resume
    #[arg(long, conflicts_with = "from")]
    enable_motion: bool,
    /// Continue a run that crashed or was stopped, from the checkpoint and keyframes in its folder
    /// and with its flags. New keyframes are added; --record and --listen are not restored. A run
    /// with --real-time also needs --from and --real-time; its recording is played from the start
    #[arg(long, value_name = "FOLDER", conflicts_with_all = TRAINING_ARGS)]
    resume: Option<PathBuf>,
    /// Stop S seconds after the first image. Time before --resume counts [default: run until
    /// Ctrl-C]
    #[arg(long, value_name = "S", allow_negative_numbers = true, value_parser = run_secs)]
    seconds: Option<f64>,
    /// Stop after N optimizer steps, or when the devices have ended and all data is fused. Steps
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
    /// Start the page with this workspace, which the page has saved: camera, layers, crop box,
    /// panels and model. Not restored by --resume
    #[arg(long, value_name = "FILE")]
    workspace: Option<PathBuf>,
    /// Folder for the results and the effective rig file. With several methods, each method gets a
    /// subfolder. A folder that contains a model is refused [default: a new folder in runs]
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

/// Parses the length of a run. With a length of zero, a run would end before its first image.
fn run_secs(text: &str) -> Result<f64, String> {
    let secs = number_in_range(0.0..=1e9)(text)?;
    if secs > 0.0 {
        return Ok(secs);
    }
    Err("must be more than 0; a run without --seconds ends with Ctrl-C".to_owned())
}

/// What to do when a run reaches its limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum WhenDone {
    /// Show the model on the page until Ctrl-C.
    Stay,
    /// Exit.
    Exit,
}

/// A run and its page.
pub(super) struct Running {
    pub(super) run: RunInProgress,
    pub(super) page: ServedPage,
    stop: Stop,
}

/// Runs until a limit, the end of the devices, or Ctrl-C; saves the model, its keyframes and the
/// effective rig file.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    // The start of a run can take many seconds.
    let read_first = [&args.resume, &args.rig_file, &args.from];
    if let Some(path) = read_first.into_iter().flatten().next() {
        log::info!("reading {}", path.display());
    }
    // The previous run is read before anything else, because its flags decide what this run does.
    let plan = args.plan();
    let previous = plan.previous()?;
    let finished = previous
        .as_ref()
        .and_then(|previous| plan.finished(previous));
    if let Some(finished) = finished {
        return print_finished_run(&finished, args.json);
    }
    let Running { run, page, stop } = start(args, previous)?;
    let hub = run.live.hub();
    let saved = run.run_to_end()?;
    if !args.json {
        print_end(
            &saved.models,
            saved.likely_cause().as_deref(),
            &saved.verdict(),
        );
    }
    let EndedRun {
        models,
        data_losses,
    } = saved.end()?;
    let exit = exit::from_losses(&data_losses);
    // The page is not kept after a signal, because the user then expects the program to end.
    if args.keeps_serving() && !models.is_empty() && !stop.signaled() {
        print::report(format_args!(
            "serving the page at {} until Ctrl-C",
            page.url()
        ));
        ModelViewer::new(models, hub).serve(&stop);
    }
    Ok(exit)
}

/// Opens the devices, the GPU and the page; continues the `previous` run if there is one.
pub(super) fn start(args: &Args, previous: Option<PreviousLiveRun>) -> anyhow::Result<Running> {
    args.page.check()?;
    let workspace = workspace_at(args.workspace.as_deref())?;
    // Signals are handled before the rig is read, so that Ctrl-C during a long start also ends the
    // run in an orderly way.
    let stop = signals::stop_on_signals()?;
    let services = Services {
        open_gpu,
        stop: &stop,
        observer: &|limits, n_sessions| {
            let output = OutputMode::of_command(args.json);
            Box::new(Console::new(output, limits, n_sessions))
        },
    };
    let prepared = args.plan().prepare(previous, services)?;
    if let Some(workspace) = workspace {
        prepared.hub().set_workspace(workspace);
    }
    // The page is served before kernels are compiled. If its address is in use, this is reported at
    // once, and viewers can connect while kernels are compiled.
    let page = args.page.serve(prepared.hub())?;
    let opened = prepared.open_devices()?;
    args.page
        .announce(&page, args.json, serde_json::json!({}))?;
    let run = opened.start()?;
    Ok(Running { run, page, stop })
}

impl Args {
    /// The flags as a plan.
    fn plan(&self) -> RunPlan {
        RunPlan {
            rig_file: self.rig_file.clone(),
            input: match &self.from {
                Some(path) => RunInput::Recording {
                    path: path.clone(),
                    is_real_time: self.real_time,
                    is_repeated: self.repeat,
                },
                None => RunInput::Devices {
                    is_simulated: self.sim,
                    is_lockstep: self.lockstep,
                },
            },
            record: self.record.clone(),
            is_steered: self.enable_motion,
            resume: self.resume.clone(),
            limits: Limits {
                seconds: self.seconds,
                steps: self.steps,
            },
            steps_per_keyframe: self.steps_per_keyframe,
            training: self.training.options(),
            out: self.out.clone(),
            checkpoints: self.checkpoints.options(),
        }
    }

    /// Whether to keep serving the page after the run.
    fn keeps_serving(&self) -> bool {
        let is_watched = !self.json && std::io::stdout().is_terminal();
        self.when_done
            .map_or(is_watched, |when_done| when_done == WhenDone::Stay)
    }
}
