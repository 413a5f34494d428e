//! Scores a saved model on the test images of data on disk.

use crate::data::{self, Data, DataOptions, Purpose};
use crate::evaluate::{Evaluator, ImageScores, Scores, warn_if_hardly_covered};
use crate::methods;
use crate::read_progress::OnReadProgress;
use crate::recoveries::OpenGpu;
use crate::run_folder;
use capture::config::{Override, Rig};
use keyframe::{Keyframe, KeyframeList, Split};
use messages::Setting;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use trainer::AlignedModel;

/// A model to score, and the data.
#[derive(Clone, Debug, Default)]
pub struct EvalPlan {
    /// Folder of a saved model, or a file of splats.
    pub model: PathBuf,
    /// Dataset folder or recording.
    pub data: PathBuf,
    /// Which images are used.
    pub images: DataOptions,
    /// Weights for LPIPS.
    pub lpips_weights: Option<PathBuf>,
}

/// Scores of the test images. The JSON output of the command has these fields.
#[derive(Debug, Serialize)]
pub struct EvalOutcome {
    /// Mean scores.
    #[serde(flatten)]
    pub scores: Scores,
    /// Scores of each image.
    pub per_image: Vec<NamedScores>,
    /// Descriptions of data that could not be read.
    #[serde(skip)]
    pub data_losses: Vec<String>,
}

/// Scores of one test image.
#[derive(Debug, Serialize)]
pub struct NamedScores {
    /// Name of the image.
    pub name: String,
    /// Its scores.
    #[serde(flatten)]
    pub scores: ImageScores,
}

impl EvalOutcome {
    /// The scores of each image, then their means.
    #[must_use]
    pub fn lines(&self) -> Vec<String> {
        let per_image = self.per_image.iter().map(|image| {
            let scores = Scores::mean(std::slice::from_ref(&image.scores));
            format!("{:30} {scores}", image.name)
        });
        let mean = format!("mean of {}", self.per_image.len());
        let mean = format!("{mean:30} {}", self.scores);
        per_image.chain([mean]).collect()
    }
}

impl EvalPlan {
    /// Renders and scores every test image.
    ///
    /// * `on_scored`: called with the numbers of scored and of all test images.
    pub fn run(
        &self,
        open_gpu: OpenGpu,
        progress: OnReadProgress<'_>,
        on_scored: &mut dyn FnMut(usize, usize),
    ) -> anyhow::Result<EvalOutcome> {
        let evaluator = Evaluator::thorough(self.lpips_weights.as_deref())?;
        // Invalid flags are rejected before the data is read, which takes long.
        self.images.holdout()?;
        // A missing path is also rejected before the data is read.
        data::expect(&self.data)?;
        // The model is also loaded before the data, because it may be invalid.
        let loaded = methods::load(open_gpu()?, &self.model)?;
        let is_empty = methods::note_if_empty(&self.model, &loaded).is_some();
        let data = Data::load(
            &self.data,
            &self.images,
            Purpose::Scoring,
            &training_overrides(&self.model),
            progress,
        )?;
        let tests = data.of_split(Split::Test);
        self.warn_about_data(&data, &tests);
        let images = score(&evaluator, loaded.method, &tests, on_scored)?;
        // An empty model has its own note and covers no pixels, so no warning about coverage is
        // needed.
        if !is_empty {
            let covered_fracs: Vec<_> = images
                .iter()
                .filter_map(|image| image.covered_frac)
                .collect();
            warn_if_hardly_covered(&covered_fracs);
        }
        // Scores are in the order of the test images. The names of other images are left out before
        // names and scores are joined.
        let names = data
            .keyframes
            .iter()
            .zip(data.names)
            .filter(|(keyframe, _)| keyframe.split == Split::Test)
            .map(|(_, name)| name);
        let scores = Scores::mean(&images);
        Ok(EvalOutcome {
            scores,
            per_image: names
                .zip(images)
                .map(|(name, scores)| NamedScores { name, scores })
                .collect(),
            data_losses: data.data_losses,
        })
    }

    /// Logs why the scores may mislead.
    fn warn_about_data(&self, data: &Data, tests: &[Arc<Keyframe>]) {
        let n_trained_on = n_trained_on(self, tests, data.rig.is_some());
        if n_trained_on > 0 {
            log::warn!(
                "the model was trained on {n_trained_on} of the {} images that are scored",
                tests.len()
            );
        }
        if data
            .rig
            .as_ref()
            .is_some_and(|rig| differs_from_training_rig(rig, &self.model))
        {
            log::warn!(
                "the model was trained with another rig file, and its camera corrections apply to that file; see {}",
                Setting::Rig
            );
        }
    }
}

fn score(
    evaluator: &Evaluator,
    mut model: AlignedModel,
    tests: &[Arc<Keyframe>],
    on_scored: &mut dyn FnMut(usize, usize),
) -> anyhow::Result<Vec<ImageScores>> {
    on_scored(0, tests.len());
    evaluator.score_all(&mut model, tests.iter(), |_, n_scored| {
        on_scored(n_scored, tests.len());
    })
}

/// Takes `base.realign` from the rig file of the model, because the base poses must be treated as
/// in training.
fn training_overrides(model: &Path) -> Vec<Override> {
    // A splat file has no rig file, so no key is taken from it.
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
fn n_trained_on(plan: &EvalPlan, tests: &[Arc<Keyframe>], is_recording: bool) -> usize {
    let Ok(list) = KeyframeList::load(&plan.model.join("keyframes.txt")) else {
        return 0;
    };
    if !is_recording && trained_folder(&plan.model) != plan.data.canonicalize().ok() {
        return 0;
    }
    let is_trained = |keyframe: &&Arc<Keyframe>| {
        list.split_of(&keyframe.camera, keyframe.stamp) == Some(Split::Train)
    };
    tests.iter().filter(is_trained).count()
}

/// The data that a model was trained on, according to its report.
fn trained_folder(model: &Path) -> Option<PathBuf> {
    let report = run_folder::report(model);
    Path::new(report["data"].as_str()?).canonicalize().ok()
}
