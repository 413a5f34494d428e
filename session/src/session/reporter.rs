//! The reports of a session: events for its observer, `report.json`, and the report page.

use super::outcome::TrainingOutcome;
use super::profile::profile;
use crate::evaluate::{ImageScores, Scores};
use crate::next_commands::{self, DataSource, SavedModel};
use crate::observer::{
    DoneEvent, Evaluation, FinishedReport, Observer, ProfileEvent, SessionEvent, SessionProgress,
};
use crate::{report, run_folder};
use anyhow::Context;
use calibration::{Alignment, CameraCorrection, TrialReport};
use keyframe::Keyframe;
use serde::Serialize;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use trainer::{AlignedModel, Method, ModelKind, Progress};

/// The content of `report.json`.
#[derive(Debug, Serialize)]
struct Report<'a, T: Serialize> {
    done: &'a DoneEvent<'a>,
    adapter: String,
    #[serde(flatten)]
    details: &'a T,
    /// Camera corrections found by registration.
    alignment: Option<&'a Alignment>,
    /// Camera corrections optimized with the scene, without those of single images.
    cameras: BTreeMap<String, CameraCorrection>,
    /// Results of A/B trials.
    trials: Vec<TrialReport>,
    /// GPU time of each pass of a step in milliseconds, if profiling was requested.
    passes: Vec<(&'static str, f64)>,
    evaluations: &'a [Evaluation],
    per_image: Vec<NamedScores<'a>>,
}

/// Scores of one test image with its name.
#[derive(Debug, Serialize)]
struct NamedScores<'a> {
    name: String,
    #[serde(flatten)]
    scores: &'a ImageScores,
}

/// A saved and scored model, and the other contents of its report.
pub(super) struct ScoredModel<'a, T: Serialize> {
    /// Folder of the model.
    pub out: &'a Path,
    pub checkpoint_sha256: &'a str,
    pub outcome: &'a TrainingOutcome,
    /// Test images next to renders, and pictures of the scene. If this is an error, the page is not
    /// written.
    pub pictures: anyhow::Result<ReportPictures>,
    /// GPU time of each kernel in a step in milliseconds, if profiling was requested.
    pub passes: Option<Vec<(&'static str, f64)>>,
    pub alignment: Option<&'a Alignment>,
    /// Camera corrections optimized with the scene.
    pub cameras: BTreeMap<String, CameraCorrection>,
    /// Results of A/B trials.
    pub trials: Vec<TrialReport>,
    /// The GPU adapter and its driver.
    pub adapter: String,
    /// Command-specific entries of the report.
    pub details: &'a T,
}

/// The pictures of the report page.
pub(super) struct ReportPictures {
    comparisons: Vec<report::Comparison>,
    scene: report::ScenePictures,
    /// Stamp of the first keyframe, nanoseconds.
    first_nanos: i64,
}

/// Reports on one model.
pub(super) struct Reporter {
    kind: ModelKind,
    data: DataSource,
    observer: Box<dyn Observer>,
    /// Whether to report the GPU time of each kernel.
    profiles: bool,
    /// The evaluations reported so far.
    evaluations: Vec<Evaluation>,
}

impl Reporter {
    /// A reporter on a model of this kind that sends events to `observer`. If `profiles`, it also
    /// reports the GPU time of each kernel.
    pub(super) fn new(
        kind: ModelKind,
        observer: Box<dyn Observer>,
        data: DataSource,
        profiles: bool,
    ) -> Self {
        Self {
            kind,
            data,
            observer,
            profiles,
            evaluations: Vec::new(),
        }
    }

    /// The kind of model.
    pub(super) fn kind(&self) -> ModelKind {
        self.kind
    }

    /// Sets the data source for the report and the next commands.
    pub(super) fn set_data(&mut self, data: DataSource) {
        self.data = data;
    }

    /// The data source.
    pub(super) fn into_data(self) -> DataSource {
        self.data
    }

    /// Reports the state of training.
    pub(super) fn report_progress(&mut self, seconds: f64, progress: Progress, psnr: Option<f64>) {
        let primitive = self.kind.entry().primitive;
        self.observer
            .on_event(&SessionEvent::Progress(&SessionProgress {
                primitive,
                seconds,
                progress,
                psnr,
            }));
    }

    /// Reports a completed evaluation that was due at `seconds`.
    pub(super) fn report_evaluation(
        &mut self,
        seconds: f64,
        images: &[ImageScores],
        progress: Progress,
    ) {
        let eval = Evaluation {
            event: "eval",
            method: self.kind.name(),
            seconds,
            step: progress.step,
            scores: Scores::mean(images),
            n_images: images.len(),
            primitives: progress.primitives,
            bytes: progress.bytes,
            step_millis: (progress.step > 0).then_some(progress.step_millis),
            primitive: self.kind.entry().primitive,
        };
        self.observer.on_event(&SessionEvent::Evaluated(&eval));
        self.evaluations.push(eval);
    }

    /// The evaluations reported so far.
    pub(super) fn evaluations(&self) -> &[Evaluation] {
        &self.evaluations
    }

    /// Takes the evaluations reported so far.
    pub(super) fn take_evaluations(&mut self) -> Vec<Evaluation> {
        std::mem::take(&mut self.evaluations)
    }

    /// Reports how many test images have been scored at the end of training.
    pub(super) fn report_scoring(&mut self, n_scored: usize, n_all: usize) {
        self.observer
            .on_event(&SessionEvent::Scoring { n_scored, n_all });
    }

    /// Reports that work without a count has begun, or that it has ended.
    pub(super) fn report_working(&mut self, work: Option<&'static str>) {
        self.observer.on_event(&SessionEvent::Working(work));
    }

    /// Reports that training ended.
    pub(super) fn report_training_ended(&mut self) {
        self.observer.on_event(&SessionEvent::TrainingEnded);
    }

    /// Renders the pictures of the report.
    ///
    /// * `keyframes`: all keyframes in the store.
    /// * `tests`: the test keyframes.
    /// * `scores`: one entry per test keyframe, in the same order.
    /// * `meanwhile`: called between two renders.
    pub(super) fn draw_pictures<'a>(
        &self,
        method: &mut AlignedModel,
        keyframes: &[Arc<Keyframe>],
        tests: impl Iterator<Item = &'a Arc<Keyframe>>,
        scores: &[ImageScores],
        mut meanwhile: impl FnMut(&mut AlignedModel),
    ) -> anyhow::Result<ReportPictures> {
        let stamps = keyframes.iter().map(|keyframe| keyframe.stamp.0);
        let first_nanos = stamps.min().unwrap_or_default();
        let scored = tests.zip(scores).map(|(keyframe, scores)| report::Scored {
            keyframe,
            name: self.readable_name(&scores.camera, scores.stamp_nanos, first_nanos),
            psnr: scores.psnr,
            ssim: scores.ssim,
        });
        let comparisons = report::compare(method, &scored.collect::<Vec<_>>(), &mut meanwhile)?;
        let scene = report::ScenePictures::draw(method, keyframes)?;
        meanwhile(method);
        Ok(ReportPictures {
            comparisons,
            scene,
            first_nanos,
        })
    }

    /// GPU time of each kernel in a step in milliseconds, if profiling was requested.
    pub(super) fn profile(
        &self,
        method: &mut dyn Method,
    ) -> anyhow::Result<Option<Vec<(&'static str, f64)>>> {
        self.profiles.then(|| profile(method)).transpose()
    }

    /// Writes the report of a saved model and sends the final event.
    pub(super) fn report_end(
        &mut self,
        model: ScoredModel<'_, impl Serialize>,
    ) -> anyhow::Result<()> {
        let ScoredModel { out, outcome, .. } = model;
        let done = DoneEvent {
            event: "done",
            method: self.kind.name(),
            seconds: outcome.seconds,
            steps: outcome.steps,
            scores: outcome.scores.clone(),
            primitives: outcome.primitives,
            bytes: outcome.bytes,
            out,
            checkpoint_sha256: model.checkpoint_sha256,
        };
        let report = Report {
            done: &done,
            adapter: model.adapter,
            details: model.details,
            alignment: model.alignment,
            // Corrections of single images are left out. There are as many of them as images, and
            // they do not apply to other images.
            cameras: model
                .cameras
                .into_iter()
                .map(|(name, camera)| (name, camera.of_all_images()))
                .collect(),
            trials: model.trials,
            passes: model.passes.unwrap_or_default(),
            evaluations: &outcome.evaluations,
            per_image: self.named(&outcome.per_image),
        };
        // The page and the event follow even if the report was not written: the model is saved, and
        // its scores must not be lost. The error is returned at the end.
        let written = run_folder::write_json(&out.join(run_folder::REPORT), &report);
        // The page is an addition, so its error is only logged.
        let page = model
            .pictures
            .and_then(|pictures| self.write_page(out, &report, &pictures));
        if let Err(error) = &page {
            log::warn!("{} was not written: {error:#}", report::FILE);
        }
        let passes = &report.passes;
        let profile = self.profiles.then(|| ProfileEvent {
            event: "profile",
            method: self.kind.name(),
            passes,
        });
        let primitive = self.kind.entry().primitive;
        let finished = FinishedReport {
            done: &done,
            profile,
            primitive,
            has_page: page.is_ok(),
        };
        self.observer.on_event(&SessionEvent::Finished(&finished));
        written.with_context(|| {
            format!(
                "the model was saved in {}, but not its report",
                out.display()
            )
        })
    }

    /// Writes the HTML page of the report.
    fn write_page(
        &self,
        out: &Path,
        report: &Report<'_, impl Serialize>,
        pictures: &ReportPictures,
    ) -> anyhow::Result<()> {
        let n_tests = report.per_image.len();
        let model = SavedModel {
            kind: self.kind,
            folder: out,
            data: &self.data,
            n_tests,
        };
        let mut content = serde_json::to_value(report)?;
        self.name_images(&mut content["per_image"], pictures.first_nanos);
        let page = report::Page {
            folder: out,
            report: &content,
            primitive: self.kind.entry().primitive,
            comparisons: &pictures.comparisons,
            scene: &pictures.scene,
            next: &next_commands::for_models(&[model]),
            settings: report::settings_in(out),
            command: next_commands::this_command(),
            date: run_folder::utc_now(),
        };
        page.write()
    }

    /// Replaces the names of images without a file by readable ones.
    fn name_images(&self, per_image: &mut Value, first_nanos: i64) {
        for image in per_image.as_array_mut().into_iter().flatten() {
            let named = image["camera"].as_str().zip(image["stamp_nanos"].as_i64());
            if let Some((camera, stamp_nanos)) = named {
                image["name"] = self.readable_name(camera, stamp_nanos, first_nanos).into();
            }
        }
    }

    /// The file name of an image, or its camera and the time after the first keyframe.
    fn readable_name(&self, camera: &str, stamp_nanos: i64, first_nanos: i64) -> String {
        let known = (self.data.image_names).get(&(camera.to_owned(), stamp_nanos));
        known
            .cloned()
            .unwrap_or_else(|| report::image_name(camera, stamp_nanos, first_nanos))
    }

    fn named<'a>(&self, images: &'a [ImageScores]) -> Vec<NamedScores<'a>> {
        images
            .iter()
            .map(|scores| NamedScores {
                name: self.image_name(scores),
                scores,
            })
            .collect()
    }

    fn image_name(&self, scores: &ImageScores) -> String {
        self.data.image_name(&scores.camera, scores.stamp_nanos)
    }
}
