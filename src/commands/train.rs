//! `fieldrig train`: trains models on a dataset folder or a recording.

use crate::checkpoint_args::CheckpointArgs;
use crate::console::{Console, OutputMode, ReadBar, print_end, print_finished_run};
use crate::data_args::DataArgs;
use crate::exit::{self, Exit};
use crate::open_gpu::open_gpu;
use crate::permission_args::PermissionArgs;
use crate::signals;
use crate::training_args::{TRAINING_ARGS, TrainingArgs};
use session::{Limits, Services, TrainOutcome, TrainPlan};
use std::path::PathBuf;

/// Flags of `train`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A nerfstudio or TUM RGB-D folder, or a recording (.mcap)
    data: PathBuf,
    #[command(flatten)]
    training: TrainingArgs,
    /// Continue from the checkpoint in this folder, on the same data and with the flags of the
    /// first command. No other flag is needed. A larger --steps or --seconds continues a finished
    /// run. Model settings cannot be changed
    #[arg(long, value_name = "FOLDER", conflicts_with_all = TRAINING_ARGS, conflicts_with = "plan_steps")]
    resume: Option<PathBuf>,
    /// Repeat the timing-dependent decisions in this decisions.jsonl of an earlier run. With the
    /// same data, this gives the same model
    #[arg(long, value_name = "FILE", conflicts_with_all = TRAINING_ARGS, conflicts_with_all = ["plan_steps", "seconds", "steps", "holdout", "keyframes", "scale"])]
    replay_decisions: Option<PathBuf>,
    /// Stop after S seconds of training. Loading and scoring do not count, but time before --resume
    /// does [default: 120, unless --steps is given]
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    seconds: Option<f64>,
    /// Stop after N optimizer steps. Steps before --resume count. Without --seconds, no decision
    /// depends on timing, and the result depends only on the seed
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Steps over which the learning rate decays and the model grows [default: --steps, else 7000]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    plan_steps: Option<u64>,
    #[command(flatten)]
    images: DataArgs,
    /// Render depth from this model (a folder or a splat file) for images that have depth on less
    /// than half of their pixels. All methods treat rendered depth as measured depth. The model
    /// must be of the same scene, in the same world frame. --refine then estimates parameters
    /// jointly with the scene
    #[arg(long, value_name = "MODEL")]
    depth_from: Option<PathBuf>,
    /// `SqueezeNet` weights for LPIPS (safetensors) [default: `FIELDRIG_LPIPS_WEIGHTS`, else no
    /// LPIPS]
    #[arg(long, value_name = "FILE")]
    lpips_weights: Option<PathBuf>,
    /// Folder for the results. With several methods, each method gets a subfolder. A folder that
    /// contains a model is refused [default: the folder of --resume if it contains no model, else a
    /// new folder in runs]
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Write the recording's rig file with the estimated calibration to this path, and the robot
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

/// Carries out the plan, and prints the result.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let stop = signals::stop_on_signals()?;
    let bar = ReadBar::new(args.json);
    let services = Services {
        open_gpu,
        stop: &stop,
        observer: &|limits, n_sessions| {
            let output = OutputMode::of_command(args.json);
            Box::new(Console::new(output, limits, n_sessions))
        },
    };
    let mut trained = match args.plan().run(services, &|read| bar.show(read))? {
        TrainOutcome::NothingLeft(run) => return print_finished_run(&run, args.json),
        TrainOutcome::Trained(trained) => trained,
    };
    if !args.json {
        print_end(
            &trained.models,
            trained.likely_cause().as_deref(),
            &trained.verdict(),
        );
    }
    trained.write_rig()?;
    Ok(exit::from_losses(&trained.data_losses))
}

impl Args {
    /// The flags as a plan.
    fn plan(&self) -> TrainPlan {
        TrainPlan {
            data: self.data.clone(),
            images: self.images.options(),
            training: self.training.options(),
            limits: Limits {
                seconds: self.seconds,
                steps: self.steps,
            },
            n_planned_steps: self.plan_steps,
            resume: self.resume.clone(),
            replay_decisions: self.replay_decisions.clone(),
            depth_from: self.depth_from.clone(),
            lpips_weights: self.lpips_weights.clone(),
            out: self.out.clone(),
            write_rig: self.write_rig.clone(),
            checkpoints: self.checkpoints.options(),
            is_profiled: self.profile,
        }
    }
}
