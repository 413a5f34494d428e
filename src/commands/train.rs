//! `fieldrig train`: a model of a dataset folder or a recording.

use crate::data::{Data, DataArgs, Purpose};
use crate::evaluate::Evaluator;
use crate::exit::{self, Exit};
use crate::run_folder;
use crate::session::{Evaluators, Tell};
use crate::stop::Stop;
use crate::training::{self, Plan};
use crate::training_args::TrainingArgs;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::Instant;
use trainer::Split;

/// Length of a training where no flag says.
const USUAL_SECONDS: f64 = 120.0;

/// Flags of `train`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A nerfstudio or TUM RGB-D folder, or a recording (.mcap)
    data: PathBuf,
    #[command(flatten)]
    training: TrainingArgs,
    /// Stop after S seconds of training; loading and scoring do not count [default: 120, unless --steps is given]
    #[arg(long, value_name = "S")]
    seconds: Option<f64>,
    /// Stop after N optimiser steps; no decision reads the clock then
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    #[command(flatten)]
    images: DataArgs,
    /// Weights of LPIPS for `SqueezeNet` (safetensors) [default: what `FIELDRIG_LPIPS_WEIGHTS` names; none: no LPIPS]
    #[arg(long, value_name = "FILE")]
    lpips_weights: Option<PathBuf>,
    /// Where the results go; a folder that holds a model is refused [default: a new folder in runs]
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Print one JSON object a line
    #[arg(long)]
    json: bool,
}

/// What the report says beside scores.
#[derive(Debug, Serialize)]
struct Particulars<'a> {
    method: &'static str,
    data: &'a Path,
    seed: u64,
    startup_secs: f64,
    n_train: usize,
    n_selection: usize,
    n_test: usize,
    losses: &'a [String],
}

/// Loads, trains until a limit or Ctrl-C, scores at the marks, saves.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let started = Instant::now();
    let limits = training::limits(args.seconds, args.steps, USUAL_SECONDS)?;
    if let Some(out) = &args.out {
        run_folder::refuse_model(out)?;
    }
    let stop = Stop::on_ctrl_c()?;
    let evaluator = Evaluator::thorough(args.lpips_weights.as_deref())?;
    let evaluators = Evaluators { at_marks: evaluator.clone(), most_at_marks: usize::MAX, at_end: evaluator };
    let data = Data::load(&args.data, &args.images, Purpose::Training, &args.training.overrides(), args.json)?;
    let gpu = super::open_gpu()?;
    let (kind, options) = training::model(&args.training, &data, args.steps)?;
    let seed = options.seed;
    let out = run_folder::make(args.out.as_deref())?;
    run_folder::write_keyframe_list(&out.join("keyframes.txt"), &data.keyframes)?;
    if let Some(rig) = &data.rig {
        rig.write_settled(&out)?;
    }

    let plan = Plan { kind, options, evaluators, limits, tell: Tell::of_command(args.json) };
    let session = training::train(gpu, plan, &data.keyframes, &stop)?;

    let startup_secs = session.clock_started().map_or(0.0, |at| (at - started).as_secs_f64());
    session.finish(
        &out,
        &Particulars {
            method: kind.name(),
            data: &args.data,
            seed,
            startup_secs,
            n_train: data.of_split(Split::Train).len(),
            n_selection: data.of_split(Split::Selection).len(),
            n_test: data.of_split(Split::Test).len(),
            losses: &data.losses,
        },
    )?;
    Ok(exit::after(&data.losses))
}
