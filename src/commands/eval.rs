//! `fieldrig eval`: scores a saved model on test images.

use crate::console::{ProgressLines, ReadBar};
use crate::data_args::DataArgs;
use crate::exit::{self, Exit};
use crate::open_gpu::open_gpu;
use crate::print;
use capture::config::{Override, Rig};
use keyframe::{Keyframe, KeyframeList, Split};
use serde::Serialize;
use session::evaluate::{ImageScores, Scores, warn_if_hardly_covered};
use session::{Data, Evaluator, Purpose, methods};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// Flags of `eval`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder of a saved model, or a splat file (.ply, .spz, .splat)
    model: PathBuf,
    /// The data it was trained on, or other data of the same scene in the same world frame
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

/// JSON output of the command.
#[derive(Debug, Serialize)]
struct EvalResult {
    #[serde(flatten)]
    scores: Scores,
    per_image: Vec<NamedScores>,
}

#[derive(Debug, Serialize)]
struct NamedScores {
    name: String,
    #[serde(flatten)]
    scores: ImageScores,
}

/// Renders and scores every test image.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let evaluator = Evaluator::thorough(args.lpips_weights.as_deref())?;
    // Invalid flags are rejected before the data is read, which takes long.
    args.images.options().holdout()?;
    // So is a missing path.
    session::expect(&args.data)?;
    // The model comes before the data, too, because it may be invalid.
    let loaded = methods::load(open_gpu()?, &args.model)?;
    let is_empty = methods::note_if_empty(&args.model, &loaded).is_some();
    let mut model = loaded.method;
    let overrides = training_overrides(&args.model);
    let bar = ReadBar::new(args.json);
    let data = Data::load(
        &args.data,
        &args.images.options(),
        Purpose::Scoring,
        &overrides,
        &|read| bar.show(read),
    )?;
    let tests = data.of_split(Split::Test);
    let n_trained_on = n_trained_on(args, &tests, data.rig.is_some());
    if n_trained_on > 0 {
        log::warn!(
            "the model was trained on {n_trained_on} of the {} images that are scored",
            tests.len()
        );
    }
    if data
        .rig
        .as_ref()
        .is_some_and(|rig| differs_from_training_rig(rig, &args.model))
    {
        log::warn!(
            "the model was trained with another rig file, and its camera corrections apply to that file; see --rig"
        );
    }
    let scored = print::bar(
        Some(tests.len() as u64),
        "{bar:30} {elapsed} scored {pos} of {len} images",
        args.json,
    );
    let mut lines = ProgressLines::new(scored.is_hidden() && !args.json, Instant::now());
    let images = evaluator.score_all(&mut model, tests.iter(), |_, n_scored| {
        scored.set_position(n_scored as u64);
        if lines.is_due(n_scored, tests.len(), Instant::now()) {
            log::info!("scored {n_scored} of {} images", tests.len());
        }
    })?;
    scored.finish_and_clear();
    // An empty model has its own note, and covers nothing anyway.
    if !is_empty {
        warn_if_hardly_covered(
            &images
                .iter()
                .filter_map(|image| image.covered_frac)
                .collect::<Vec<_>>(),
        );
    }
    let scores = Scores::mean(&images);
    // Scores are in the order of the test images, so names of the others are left out before both
    // are joined.
    let is_test = |keyframe: &Keyframe| keyframe.split == Split::Test;
    let names = data
        .keyframes
        .iter()
        .zip(data.names)
        .filter(|(keyframe, _)| is_test(keyframe))
        .map(|(_, name)| name);
    let per_image: Vec<NamedScores> = names
        .zip(images)
        .map(|(name, scores)| NamedScores { name, scores })
        .collect();
    if args.json {
        print::json(&EvalResult { scores, per_image })?;
    } else {
        for image in &per_image {
            print::line(format_args!(
                "{:30} {}",
                image.name,
                Scores::mean(std::slice::from_ref(&image.scores))
            ))?;
        }
        print::line(format_args!(
            "{:30} {scores}",
            format!("mean of {}", per_image.len())
        ))?;
    }
    // Scores of incomplete data are printed, but the exit code says so.
    Ok(exit::from_losses(&data.data_losses))
}

/// Takes `base.realign` from the rig file of the model, because the base poses must be treated as
/// in training.
fn training_overrides(model: &Path) -> Vec<Override> {
    // Without a rig file, as for a splat file, there is nothing to take over.
    let training_rig = Rig::load(&model.join(drivers::recording::RIG_FILE), &[]);
    training_rig
        .iter()
        .map(|rig| Override::new("base.realign", rig.base.realign))
        .collect()
}

/// Whether the calibration of a rig differs from the one in the model's folder.
fn differs_from_training_rig(rig: &Rig, model: &Path) -> bool {
    let training_rig = Rig::load(&model.join(drivers::recording::RIG_FILE), &[]);
    training_rig.is_ok_and(|training_rig| !rig.has_same_calibration(&training_rig))
}

/// Number of test images that the model was trained on, according to the list in its folder; 0
/// without a list.
///
/// Image names are not unique across dataset folders, so the list is used only if the model was
/// trained on the same folder.
fn n_trained_on(args: &Args, tests: &[Arc<Keyframe>], is_recording: bool) -> usize {
    let Ok(list) = KeyframeList::load(&args.model.join("keyframes.txt")) else {
        return 0;
    };
    if !is_recording && trained_folder(&args.model) != args.data.canonicalize().ok() {
        return 0;
    }
    let is_trained = |keyframe: &&Arc<Keyframe>| {
        list.split_of(&keyframe.camera, keyframe.stamp) == Some(Split::Train)
    };
    tests.iter().filter(is_trained).count()
}

/// The data that a model was trained on, according to its report.
fn trained_folder(model: &Path) -> Option<PathBuf> {
    let report = files::read_text(&model.join("report.json")).ok()?;
    let report: serde_json::Value = serde_json::from_str(&report).ok()?;
    Path::new(report["data"].as_str()?).canonicalize().ok()
}
