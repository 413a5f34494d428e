//! The runs of a bench. Each run is trained once and saved to a file, so that a bench restarted in
//! the same folder does not repeat it.

use anyhow::{Context, Result, ensure};
use capture::Stop;
use gpu::Gpu;
use keyframe::{Keyframe, Split};
use messages::{BadInput, InsufficientData, Setting};
use model_files::InitialPoints;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use session::run_folder::{self, CreatedFolders};
use session::{
    Data, DataOptions, Evaluation, Evaluator, Evaluators, Limits, Observer, OpenGpu, Purpose,
    ReadProgress, Services, TrainingOptions, TrainingOutcome, UnsavedTraining, ignore_progress,
};
use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use trainer::splat::SplatOptions;
use trainer::{MethodOptions, ModelKind, ModelOptions, ModelSpec};

/// Folder of the runs inside the folder of the bench.
const RUNS: &str = "bench-runs";

/// Options shared by all benches that train.
#[derive(Clone, Debug, Default)]
pub struct RunsOptions {
    /// Which models to train, and their limits.
    pub training: TrainingOptions,
    /// Which images are used.
    pub images: DataOptions,
    /// Folder for runs, charts and the page. `None` selects a new folder in `runs`.
    pub out: Option<PathBuf>,
}

/// Services of the program that runs a bench.
#[derive(Clone)]
pub struct Host<'a> {
    /// Opens the GPU, also after it was lost.
    pub open_gpu: OpenGpu,
    /// Stops the bench when requested.
    pub stop: Stop,
    /// Receives the reports.
    pub observer: &'a dyn BenchObserver,
}

/// Receives the reports of a bench that trains, for example to print them.
pub trait BenchObserver {
    /// Returns a callback for the progress of reading one data set. The callback is dropped after
    /// the last image.
    fn reading(&self) -> Box<dyn Fn(ReadProgress) + Sync>;
    /// Returns the observer of the training session of one run with these limits.
    fn training(&self, limits: Limits) -> Box<dyn Observer>;
    /// Receives the report of a finished run.
    fn on_run(&self, report: &RunReport<'_>);
}

/// Ignores all reports.
impl BenchObserver for () {
    fn reading(&self) -> Box<dyn Fn(ReadProgress) + Sync> {
        Box::new(ignore_progress)
    }

    fn training(&self, _limits: Limits) -> Box<dyn Observer> {
        Box::new(())
    }

    fn on_run(&self, _report: &RunReport<'_>) {}
}

/// Report of a finished run, serialized as the event `run`.
#[derive(Clone, Debug, Serialize)]
pub struct RunReport<'a> {
    event: &'static str,
    /// Whether the run was read from a file instead of trained.
    #[serde(rename = "cached")]
    pub is_cached: bool,
    /// The run.
    #[serde(flatten)]
    pub run: &'a Run,
    /// Number of finished runs of this bench, including this one.
    #[serde(skip)]
    pub n_done: u64,
    /// Total number of runs of this bench.
    #[serde(skip)]
    pub n_all: u64,
}

impl RunReport<'_> {
    /// The result of the run in one line.
    #[must_use]
    pub fn summary(&self) -> String {
        let end = &self.run.end;
        let cached = if self.is_cached { ", done earlier" } else { "" };
        format!(
            "run {} of {}  {:40} {:7.1} s  step {:6}  {:8} primitives  {:7.2} MB  {:.2} dB{cached}",
            self.n_done,
            self.n_all,
            self.run.name,
            end.seconds,
            end.step,
            end.primitives,
            end.bytes as f64 / 1e6,
            self.run.psnr()
        )
    }
}

/// Settings that identify a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunSettings {
    /// Folder or recording.
    pub data: PathBuf,
    /// Name of the scene model.
    pub method: String,
    /// Random seed.
    pub seed: u64,
    /// Maximum number of splats. `None` if the method has no such limit.
    pub max_splats: Option<u64>,
    /// Maximum GPU memory of the model, bytes. `None` if there is no limit.
    pub max_bytes: Option<u64>,
    /// All options of the model, including those above.
    #[serde(default)]
    pub options: ModelOptions,
    /// Limit of the training time, seconds.
    pub seconds: Option<f64>,
    /// Limit of the optimizer steps.
    pub steps: Option<u64>,
    /// Fraction to which images are scaled.
    pub scale: Option<f64>,
    /// Selection of test images.
    pub holdout: Option<String>,
    /// List of the keyframes to use.
    pub keyframes: Option<PathBuf>,
    /// Number of training images before any disturbance.
    pub n_train: usize,
    /// Number of test images.
    pub n_test: usize,
    /// Disturbance of the keyframes, if any.
    pub disturbed: Option<Disturbed>,
    /// Name of the variant of the trainer.
    pub variant: Option<String>,
    /// Description of the GPU.
    pub adapter: String,
    /// Version of this program.
    pub version: String,
}

/// Disturbance of the keyframes of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Disturbed {
    /// Name of the disturbance.
    pub disturbance: String,
    /// Size of the disturbance, in `unit`.
    pub level: f64,
    /// Unit of the size.
    pub unit: String,
    /// Images per second, if stamps only count images.
    pub rate_hz: Option<f64>,
}

/// Scores and size at one time. Unknown values are `None`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunScores {
    /// Training time, seconds.
    pub seconds: f64,
    /// Number of optimizer steps.
    pub step: u64,
    /// Mean PSNR of the test images, dB. It is also `None` if it is infinite.
    pub psnr: Option<f64>,
    /// Mean SSIM of the test images.
    pub ssim: Option<f64>,
    /// Mean LPIPS of the test images.
    pub lpips: Option<f64>,
    /// Root mean square error of the depth, meters.
    pub depth_rmse_m: Option<f64>,
    /// Number of splats, voxel blocks or table entries, depending on the method.
    pub primitives: u64,
    /// Size of the model, bytes.
    pub bytes: u64,
}

/// A finished training run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// Name of the run within its bench.
    pub name: String,
    /// Settings that identify the run.
    pub settings: RunSettings,
    /// Scores at the scheduled evaluations.
    pub evaluations: Vec<RunScores>,
    /// Scores at the end.
    pub end: RunScores,
}

impl Run {
    /// Final test PSNR, dB. If renders and images are identical, it would be infinite, and 99 is
    /// returned.
    #[must_use]
    pub fn psnr(&self) -> f64 {
        const WITHOUT_ERROR_DB: f64 = 99.0;
        self.end.psnr.unwrap_or(WITHOUT_ERROR_DB)
    }

    /// Points `(seconds, dB)` at the evaluations and at the end.
    #[must_use]
    pub fn curve(&self) -> Vec<(f64, f64)> {
        /// Minimum ratio of the final time to the time of the last evaluation for the end to be a
        /// separate point. At smaller ratios, both evaluations score almost the same model, and
        /// noise would look like a step.
        const MIN_SECONDS_RATIO: f64 = 1.02;
        let is_new = self
            .evaluations
            .last()
            .is_none_or(|last| self.end.seconds > MIN_SECONDS_RATIO * last.seconds);
        let points = self.evaluations.iter().chain(is_new.then_some(&self.end));
        points
            .filter_map(|point| Some((point.seconds, point.psnr?)))
            .collect()
    }
}

/// A data set and its name in charts.
pub(crate) struct NamedData {
    pub(crate) name: String,
    pub(crate) path: PathBuf,
    pub(crate) data: Data,
    /// Points at which the training of models without depth starts.
    initial_points: Option<Arc<InitialPoints>>,
    /// The scene models requested by the flags and the recording.
    pub(crate) model_specs: Vec<ModelSpec>,
}

/// A training run to do.
pub(crate) struct Job<'a> {
    pub(crate) name: String,
    pub(crate) data: &'a NamedData,
    pub(crate) model_spec: ModelSpec,
    pub(crate) limits: Limits,
    pub(crate) disturbed: Option<Disturbed>,
    pub(crate) variant: Option<String>,
    /// Returns the keyframes. Called only if the run is not saved yet.
    pub(crate) keyframes: &'a dyn Fn() -> Vec<Arc<Keyframe>>,
    /// Whether scheduled evaluations compute all scores instead of only the PSNR. The final
    /// evaluation always computes all scores.
    pub(crate) is_thorough: bool,
}

/// Trains and saves runs.
pub(crate) struct Runs<'a> {
    options: &'a RunsOptions,
    host: &'a Host<'a>,
    out: PathBuf,
    created: CreatedFolders,
    gpu: Arc<Gpu>,
    n_all: u64,
    n_done: u64,
}

impl NamedData {
    /// The scene model, for a bench of a single method.
    ///
    /// # Errors
    ///
    /// Fails if there are several methods.
    pub(crate) fn single_model_spec(&self) -> Result<&ModelSpec> {
        match &self.model_specs[..] {
            [one] => Ok(one),
            _ => Err(BadInput(format!(
                "{}: this bench needs a single method, but the methods are {}",
                self.name,
                self.methods()
            ))
            .into()),
        }
    }

    /// The training options of splats, for a bench that measures only splats.
    ///
    /// # Errors
    ///
    /// Fails if another method, or if several methods are selected.
    pub(crate) fn splats(&self) -> Result<ModelOptions<SplatOptions>> {
        let options = match &self.model_specs[..] {
            [one] => one.options_of()?,
            _ => None,
        };
        options.ok_or_else(|| {
            BadInput(format!(
                "{}: this bench needs the method {}, but the method is {}",
                self.name,
                SplatOptions::METHOD,
                self.methods()
            ))
            .into()
        })
    }

    fn methods(&self) -> String {
        let kinds: Vec<ModelKind> = self
            .model_specs
            .iter()
            .map(|model_spec| model_spec.kind)
            .collect();
        session::methods::describe(&kinds)
    }
}

/// Removes the created folders if the bench ends before its first run.
impl Drop for Runs<'_> {
    fn drop(&mut self) {
        if std::fs::read_dir(self.out.join(RUNS)).is_ok_and(|mut runs| runs.next().is_none()) {
            std::mem::take(&mut self.created).remove_created();
        }
    }
}

impl<'a> Runs<'a> {
    /// Opens the GPU and creates the folder.
    pub(crate) fn open(options: &'a RunsOptions, host: &'a Host<'a>) -> Result<Self> {
        let gpu = (host.open_gpu)()?;
        let mut created = CreatedFolders::default();
        let out = created.make(options.out.as_deref())?;
        let runs = out.join(RUNS);
        std::fs::create_dir_all(&runs)
            .with_context(|| format!("cannot create the folder {}", runs.display()))?;
        log::info!("{}", gpu.describe());
        Ok(Self {
            options,
            host,
            out,
            created,
            gpu,
            n_all: 0,
            n_done: 0,
        })
    }

    /// The folder of the bench.
    pub(crate) fn out(&self) -> &Path {
        &self.out
    }

    /// Description of the GPU.
    pub(crate) fn adapter(&self) -> String {
        self.gpu.describe()
    }

    /// Sets the number of remaining runs.
    pub(crate) fn expect(&mut self, n_more: u64) {
        self.n_all = self.n_done + n_more;
    }

    /// Loads data and chooses a name that is not in `used_names`.
    pub(crate) fn load(&self, path: &Path, used_names: &mut HashSet<String>) -> Result<NamedData> {
        let RunsOptions {
            training, images, ..
        } = self.options;
        session::check_before_data(training, path, images)?;
        let on_progress = self.host.observer.reading();
        let data = Data::load(
            path,
            images,
            Purpose::Training,
            &training.overrides(),
            &on_progress,
        )?;
        // Ends the progress bar before the next message.
        drop(on_progress);
        if data.of_split(Split::Test).is_empty() {
            return Err(InsufficientData(format!(
                "{}: there are no test images, so nothing can be scored; see {}",
                path.display(),
                Setting::Holdout
            ))
            .into());
        }
        let model_specs = session::model_specs(training, &data, None, self.gpu.is_software())?;
        let initial_points = data.initial_points();
        Ok(NamedData {
            name: unique_name(path, used_names),
            path: path.to_owned(),
            data,
            initial_points,
            model_specs,
        })
    }

    /// Returns the run of a job from its file. If there is none, trains the run and saves it.
    pub(crate) fn run(&mut self, job: Job<'_>) -> Result<Run> {
        self.n_done += 1;
        let settings = self.settings(&job);
        if let Some(cached) = saved_run(&self.out, &job.name, &settings)? {
            self.report(&cached, true);
            return Ok(cached);
        }
        log::info!("run {} of {}: {}", self.n_done, self.n_all, job.name);
        let outcome = self
            .train(&job)
            .with_context(|| format!("run {}", job.name))?;
        let run = Run {
            name: job.name,
            settings,
            evaluations: outcome.evaluations.iter().map(from_evaluation).collect(),
            end: RunScores {
                seconds: outcome.seconds,
                step: outcome.steps,
                psnr: outcome.scores.psnr,
                ssim: outcome.scores.ssim,
                lpips: outcome.scores.lpips,
                depth_rmse_m: outcome.scores.depth_rmse_m,
                primitives: outcome.primitives,
                bytes: outcome.bytes,
            },
        };
        run_folder::write_json(&path_of(&self.out, &run.name), &run)?;
        self.report(&run, false);
        Ok(run)
    }

    fn train(&self, job: &Job<'_>) -> Result<TrainingOutcome> {
        let thorough = Evaluator::thorough(None)?;
        let during_training = if job.is_thorough {
            thorough.clone()
        } else {
            Evaluator::psnr_only()
        };
        // The schedule of a model, such as the end of its growth, depends on the planned steps.
        let mut model_spec = job.model_spec.clone();
        if let Some(steps) = job.limits.steps {
            model_spec.options.common.n_planned_steps = steps;
        }
        let keyframes = (job.keyframes)();
        let training = UnsavedTraining {
            model_spec,
            keyframes: &keyframes,
            preparation_time: job.data.data.preparation_time,
            // The points are left out for disturbed data, because they are not disturbed and would
            // reveal the true scene.
            initial_points: job
                .data
                .initial_points
                .clone()
                .filter(|_| job.disturbed.is_none()),
            evaluators: Evaluators {
                during_training,
                max_images_during_training: usize::MAX,
                max_frac_during_training: None,
                at_end: thorough,
            },
            limits: job.limits,
        };
        let services = Services {
            open_gpu: self.host.open_gpu,
            stop: &self.host.stop,
            observer: &|limits, _n_sessions| self.host.observer.training(limits),
        };
        let session = training.run(self.gpu.clone(), services)?;
        // An interrupted run is not saved, because it would count as a complete run.
        ensure!(
            session.is_over() || !self.host.stop.requested(),
            "stopped early; to continue the bench, run the same command with {} {}",
            Setting::Out,
            self.out.display()
        );
        session.score_without_saving()
    }

    fn settings(&self, job: &Job<'_>) -> RunSettings {
        let data = &job.data.data;
        let images = self.options.images.clone();
        let n_test = data.of_split(Split::Test).len();
        RunSettings {
            data: job.data.path.clone(),
            method: job.model_spec.kind.name().to_owned(),
            seed: job.model_spec.options.common.seed,
            max_splats: job
                .model_spec
                .options
                .specific
                .get("max_splats")
                .and_then(Value::as_u64),
            max_bytes: job.model_spec.options.common.max_bytes,
            options: job.model_spec.options.clone(),
            seconds: job.limits.seconds,
            steps: job.limits.steps,
            scale: images.scale,
            holdout: images.holdout,
            keyframes: images.keyframes,
            n_train: data.keyframes.len() - n_test,
            n_test,
            disturbed: job.disturbed.clone(),
            variant: job.variant.clone(),
            adapter: self.gpu.describe(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        }
    }

    fn report(&self, run: &Run, is_cached: bool) {
        let report = RunReport {
            event: "run",
            is_cached,
            run,
            n_done: self.n_done,
            n_all: self.n_all,
        };
        self.host.observer.on_run(&report);
    }
}

fn from_evaluation(evaluation: &Evaluation) -> RunScores {
    RunScores {
        seconds: evaluation.seconds,
        step: evaluation.step,
        psnr: evaluation.scores.psnr,
        ssim: evaluation.scores.ssim,
        lpips: evaluation.scores.lpips,
        depth_rmse_m: evaluation.scores.depth_rmse_m,
        primitives: evaluation.primitives,
        bytes: evaluation.bytes,
    }
}

/// The file of a run in the folder of a bench.
fn path_of(out: &Path, name: &str) -> PathBuf {
    out.join(RUNS).join(format!("{}.json", file_name(name)))
}

/// The run with this name that is saved in the folder of a bench. `None` if there is no such run.
///
/// # Errors
///
/// Fails if the settings of the saved run differ. Such a run must not appear among the results of
/// the other runs.
fn saved_run(out: &Path, name: &str, settings: &RunSettings) -> Result<Option<Run>> {
    let path = path_of(out, name);
    if !path.exists() {
        return Ok(None);
    }
    let saved = read(&path)?;
    if let Some(difference) = difference(&saved.settings, settings)? {
        return Err(BadInput(format!(
            "{} {}: the saved run {name} differs in {difference}; choose another folder",
            Setting::Out,
            out.display(),
        ))
        .into());
    }
    Ok(Some(saved))
}

fn read(path: &Path) -> Result<Run> {
    let message = || {
        format!(
            "{} is not a finished run; remove it to repeat the run",
            path.display()
        )
    };
    let text = files::read_text(path).with_context(message)?;
    serde_json::from_str(&text).with_context(message)
}

/// Description of the first setting that differs.
fn difference(cached: &RunSettings, requested: &RunSettings) -> Result<Option<String>> {
    // The settings are compared as JSON, which contains their names for the message.
    let fields =
        |settings: &RunSettings| serde_json::to_value(settings).context("settings are plain data");
    Ok(first_difference(&fields(cached)?, &fields(requested)?))
}

/// Description of the first value of an object that differs. If this value is an object, the
/// description names the first value inside the object that differs.
fn first_difference(cached: &Value, requested: &Value) -> Option<String> {
    let (key, value) = requested
        .as_object()?
        .iter()
        .find(|(key, value)| cached[key.as_str()] != **value)?;
    let saved = &cached[key.as_str()];
    first_difference(saved, value).or_else(|| Some(format!("{key} ({saved} saved, {value} now)")))
}

/// Derives a name for data from its path, with a number if the name is already used.
fn unique_name(path: &Path, used_names: &mut HashSet<String>) -> String {
    let canonical = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let stem = if canonical.is_dir() {
        canonical.file_name()
    } else {
        canonical.file_stem()
    };
    let stem = stem.map_or_else(
        || "data".to_owned(),
        |stem| stem.to_string_lossy().into_owned(),
    );
    let mut name = stem.clone();
    let mut n = 2;
    while !used_names.insert(name.clone()) {
        name = format!("{stem}-{n}");
        n += 1;
    }
    name
}

/// Turns a name into a file name of letters, digits, dots and dashes.
fn file_name(name: &str) -> String {
    name.chars()
        .map(|letter| {
            if letter.is_alphanumeric() || letter == '.' {
                letter
            } else {
                '-'
            }
        })
        .collect()
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use trainer::splat::CountPolicy;

    /// A run with the given curve and size.
    pub(crate) fn run(name: &str, curve: &[(f64, f64)], n_splats: u64) -> Run {
        let scores_at = |&(seconds, psnr): &(f64, f64)| RunScores {
            seconds,
            step: 10,
            psnr: Some(psnr),
            ssim: None,
            lpips: None,
            depth_rmse_m: None,
            primitives: n_splats,
            bytes: 0,
        };
        let settings = RunSettings {
            data: "fox".into(),
            method: "splat".into(),
            seed: 1,
            max_splats: Some(1000),
            max_bytes: None,
            options: ModelOptions::default(),
            seconds: Some(4.0),
            steps: None,
            scale: None,
            holdout: None,
            keyframes: None,
            n_train: 7,
            n_test: 1,
            disturbed: None,
            variant: None,
            adapter: "none".into(),
            version: "0".into(),
        };
        let evaluations = curve.iter().map(scores_at).collect();
        Run {
            name: name.into(),
            settings,
            evaluations,
            end: scores_at(curve.last().expect("a point")),
        }
    }

    #[test]
    fn run_round_trips_through_its_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("run.json");
        let written = run("fox seed 1", &[(0.25, 12.3), (4.0, 21.456_789)], 900);
        run_folder::write_json(&path, &written).expect("written");
        assert_eq!(read(&path).expect("read"), written);
        std::fs::write(&path, "{").expect("written");
        assert!(
            read(&path)
                .expect_err("truncated")
                .to_string()
                .contains("run.json")
        );
    }

    #[test]
    fn settings_difference_names_the_setting() {
        let cached = run("a", &[(1.0, 20.0)], 1).settings;
        assert_eq!(difference(&cached, &cached).expect("plain"), None);
        let requested = RunSettings {
            max_splats: Some(2000),
            ..cached.clone()
        };
        let message = difference(&cached, &requested)
            .expect("plain")
            .expect("one differs");
        assert_eq!(message, "max_splats (1000 saved, 2000 now)");
    }

    #[test]
    fn saved_runs_with_other_options_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let out = folder.path();
        std::fs::create_dir(out.join(RUNS)).expect("a folder");
        let options = |count: CountPolicy| {
            ModelOptions::<SplatOptions>::from(SplatOptions {
                count,
                ..SplatOptions::default()
            })
            .to_json()
        };
        let mut saved = run("a", &[(1.0, 20.0)], 1);
        assert_eq!(saved_run(out, "a", &saved.settings).expect("no run"), None);
        saved.settings.options = options(CountPolicy::ToCap);
        run_folder::write_json(&path_of(out, "a"), &saved).expect("written");
        let same = saved_run(out, "a", &saved.settings).expect("the same settings");
        assert_eq!(same, Some(saved.clone()));
        let requested = RunSettings {
            options: options(CountPolicy::Tested),
            ..saved.settings
        };
        let message = saved_run(out, "a", &requested)
            .expect_err("another rule")
            .to_string();
        assert!(
            message.contains(r#"differs in count ("ToCap" saved, "Tested" now)"#),
            "{message}"
        );
    }

    #[test]
    fn names_are_unique_and_valid_file_names() {
        let mut used_names = HashSet::new();
        assert_eq!(
            unique_name(Path::new("absent/fox.mcap"), &mut used_names),
            "fox"
        );
        assert_eq!(
            unique_name(Path::new("other/fox.mcap"), &mut used_names),
            "fox-2"
        );
        assert_eq!(file_name("a b/c 0.5 mm"), "a-b-c-0.5-mm");
    }

    #[test]
    fn final_evaluation_is_not_counted_twice() {
        let mut run = run("a", &[(1.0, 20.0), (4.0, 24.0)], 1);
        assert_eq!(run.curve(), [(1.0, 20.0), (4.0, 24.0)]);
        run.end = RunScores {
            seconds: 6.0,
            psnr: Some(25.0),
            ..run.end
        };
        assert_eq!(run.curve(), [(1.0, 20.0), (4.0, 24.0), (6.0, 25.0)]);
    }
}
