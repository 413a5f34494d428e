//! `fieldrig eval`: scores a saved model on test images.

use crate::console::{CountedWork, ReadBar};
use crate::data_args::DataArgs;
use crate::exit::{self, Exit};
use crate::open_gpu::open_gpu;
use crate::print;
use session::EvalPlan;
use std::path::PathBuf;

/// Flags of `eval`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder of a saved model, or a splat file (.ply, .spz, .splat)
    model: PathBuf,
    /// The data on which the model was trained, or other data of the same scene in the same world
    /// frame
    data: PathBuf,
    #[command(flatten)]
    images: DataArgs,
    /// `SqueezeNet` weights for LPIPS (safetensors) [default: `FIELDRIG_LPIPS_WEIGHTS`, else no
    /// LPIPS]
    #[arg(long, value_name = "FILE")]
    lpips_weights: Option<PathBuf>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Scores the model, and prints the scores.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let plan = EvalPlan {
        model: args.model.clone(),
        data: args.data.clone(),
        images: args.images.options(),
        lpips_weights: args.lpips_weights.clone(),
    };
    let reading = ReadBar::new(args.json);
    let mut scored = CountedWork::new("{bar:30} {elapsed} scored {pos} of {len} images", args.json);
    let outcome = plan.run(
        open_gpu,
        &|read| reading.show(read),
        &mut |n_scored, n_all| {
            if scored.show(n_scored, n_all) {
                log::info!("scored {n_scored} of {n_all} images");
            }
        },
    )?;
    drop(scored);
    print::json_or_lines(args.json, &outcome, outcome.lines())?;
    // Scores of incomplete data are printed, but the exit code reports the loss.
    Ok(exit::from_losses(&outcome.data_losses))
}
