//! `fieldrig eval`: how good a saved model is on the test images of some data.

use crate::data::{Data, DataArgs};
use crate::evaluate::{Evaluator, ImageScores, Scores};
use crate::exit::{self, Exit, LackOfEvidence};
use crate::{method, print};
use serde::Serialize;
use std::path::PathBuf;
use trainer::Split;

/// Flags of `eval`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder of a saved model
    model: PathBuf,
    /// The data it was trained on, or other data of the same scene in the same frame
    data: PathBuf,
    #[command(flatten)]
    images: DataArgs,
    /// Weights of LPIPS for `SqueezeNet` (safetensors) [default: what `FIELDRIG_LPIPS_WEIGHTS` names; none: no LPIPS]
    #[arg(long, value_name = "FILE")]
    lpips_weights: Option<PathBuf>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// What is printed with `--json`.
#[derive(Debug, Serialize)]
struct Judged {
    #[serde(flatten)]
    scores: Scores,
    per_image: Vec<Named>,
}

#[derive(Debug, Serialize)]
struct Named {
    name: String,
    #[serde(flatten)]
    scores: ImageScores,
}

/// Draws and scores every test image.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let evaluator = Evaluator::thorough(args.lpips_weights.as_deref())?;
    let data = Data::load(&args.data, &args.images, &[], args.json)?;
    let tests = data.of_split(Split::Test);
    if tests.is_empty() {
        return Err(LackOfEvidence(format!("{}: no test image", args.data.display())).into());
    }
    let mut model = method::load(super::open_gpu()?, &args.model)?;
    let images = evaluator.score_all(model.as_mut(), &tests)?;
    let scores = Scores::mean(&images);
    let is_test = |keyframe: &trainer::Keyframe| keyframe.split == Split::Test;
    let names = data.keyframes.iter().zip(data.names).filter(|(keyframe, _)| is_test(keyframe)).map(|(_, name)| name);
    let per_image: Vec<Named> = names.zip(images).map(|(name, scores)| Named { name, scores }).collect();
    if args.json {
        print::json(&Judged { scores, per_image })?;
    } else {
        for image in &per_image {
            print::line(format_args!("{:30} {}", image.name, Scores::mean(std::slice::from_ref(&image.scores))))?;
        }
        print::line(format_args!("{:30} {scores}", format!("mean of {}", per_image.len())))?;
    }
    Ok(exit::after(&data.losses))
}
