//! Trains models on keyframes from disk, for `train` and `bench`.

use crate::data::{Data, DataOptions};
use crate::method_options;
use crate::methods::methods_of;
use crate::recoveries::{OpenGpu, Recoveries};
use crate::session::{Evaluators, Limits, Session, SessionOptions};
use crate::session_setup::Services;
use crate::training_options::{Refine, RefineSettings, TrainingOptions};
use crate::{run_folder, time_slices};
use capture::Stop;
use gpu::Gpu;
use keyframe::Keyframe;
use messages::{BadInput, InsufficientData, Setting, listed};
use model_files::InitialPoints;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::splat::CountPolicy;
use trainer::{self, CommonOptions, ModelKind, ModelSpec};

/// Training of a new model that is not saved, such as one run of a bench.
pub struct UnsavedTraining<'a> {
    /// Method and options of the model.
    pub model_spec: ModelSpec,
    /// The images.
    pub keyframes: &'a [Arc<Keyframe>],
    /// Time already spent on preparing the keyframes; it counts as training time.
    pub preparation_time: Duration,
    /// Points from which the model starts if no keyframe has depth.
    pub initial_points: Option<Arc<InitialPoints>>,
    /// How the model is scored.
    pub evaluators: Evaluators,
    /// When to stop.
    pub limits: Limits,
}

impl UnsavedTraining<'_> {
    /// Trains until a limit or until a stop is requested.
    ///
    /// The clock starts once all pipelines are compiled. Seeding counts as training time.
    pub fn run(self, gpu: Arc<Gpu>, services: Services<'_>) -> anyhow::Result<Session> {
        let Services {
            open_gpu,
            stop,
            observer,
        } = services;
        let kind = self.model_spec.kind;
        let mut method = self.model_spec.start(gpu.clone())?;
        // Compiling kernels takes seconds and is not training.
        method.model_mut().prepare()?;
        let observer = observer(self.limits, 1);
        let mut session = Session::new(
            gpu,
            (kind, method),
            SessionOptions {
                stop: stop.clone(),
                initial_points: self.initial_points,
                ..SessionOptions::new(self.evaluators, self.limits, observer)
            },
        );
        drive(
            std::slice::from_mut(&mut session),
            self.keyframes,
            self.preparation_time,
            stop,
            open_gpu,
        )?;
        Ok(session)
    }
}

/// Starts the clock, pushes the keyframes to all models, and trains each until a limit or until
/// `stop` is requested.
///
/// `preparation_time`: time already spent on preparing the keyframes; it counts as training time.
pub(crate) fn drive(
    sessions: &mut [Session],
    keyframes: &[Arc<Keyframe>],
    preparation_time: Duration,
    stop: &Stop,
    open_gpu: OpenGpu,
) -> anyhow::Result<()> {
    // The clock starts earlier by the time of the preparation, which is part of the method.
    let now = Instant::now();
    let began = now.checked_sub(preparation_time).unwrap_or(now);
    for session in &mut *sessions {
        session.time().start(began);
        for keyframe in keyframes {
            session.push(keyframe)?;
        }
        // A model that is idle at once, with all keyframes, can never train.
        if session.is_idle() && session.progress().step == 0 {
            let others: Vec<&str> = ModelKind::ALL
                .iter()
                .filter(|kind| !kind.entry().needs_depth)
                .map(|kind| kind.name())
                .collect();
            return Err(InsufficientData(format!(
                "the method {} needs depth, but no training image has depth: \
                 use `fieldrig train {}` to render depth from another model of the scene, or use the method {}",
                session.kind().name(),
                Setting::DepthFrom,
                listed(&others, "or")
            ))
            .into());
        }
    }
    let is_done = |session: &Session| session.is_over() || session.is_idle();
    let mut recoveries = Recoveries::new(open_gpu);
    // The outer loop repeats if the GPU fails during the last queued steps, which only the final
    // wait detects.
    loop {
        while !stop.requested() && !sessions.iter().all(is_done) {
            if let Err(error) = time_slices::train_next(sessions, |_, _| u64::MAX, || false) {
                recoveries.recover(sessions, error)?;
            }
            // No more keyframes arrive, so an idle model is complete. Its training time ends here,
            // while the other models are still trained.
            sessions
                .iter_mut()
                .filter(|session| session.is_idle())
                .for_each(|session| session.time_mut().mark_finished());
        }
        match sessions.iter().try_for_each(|session| session.gpu().wait()) {
            Ok(()) => return Ok(()),
            Err(error) => recoveries.recover(sessions, error.into())?,
        }
    }
}

/// The methods and their options. For a recording, they come from its rig file with flags applied;
/// for a folder, from flags only.
pub fn model_specs(
    options: &TrainingOptions,
    data: &Data,
    steps: Option<u64>,
    software: bool,
) -> anyhow::Result<Vec<ModelSpec>> {
    let rig_methods = data.rig.as_ref().map(methods_of).transpose()?;
    let kinds = rig_methods
        .or(options.methods.clone())
        .unwrap_or_else(|| vec![ModelKind::default()]);
    options.check_for(&kinds)?;
    let available = data.available();
    // On a CPU, there are no trials by default. A trial takes hundreds of additional steps, which
    // take minutes on a CPU.
    let RefineSettings {
        align,
        with_scene: cameras,
    } = options.refining(
        available,
        if software { Refine::None } else { Refine::Auto },
    )?;
    options.check_learned(&kinds, available)?;
    let default_count = if software {
        CountPolicy::ToCap
    } else {
        CountPolicy::Tested
    };
    let train = data.rig.as_ref().map(|rig| &rig.train);
    let common = CommonOptions {
        cameras,
        align,
        ..method_options::common(options, train, steps)
    };
    let settings = method_options::settings(options, train, default_count);
    method_options::specs(&kinds, &common, &settings)
}

/// Checks the flags that do not depend on the contents of the data, so that errors appear before
/// all data are read.
pub fn check_before_data(
    options: &TrainingOptions,
    path: &Path,
    images: &DataOptions,
) -> anyhow::Result<()> {
    let defaults = || Data::default_methods(path, images);
    let kinds = options.methods.clone().map_or_else(defaults, Ok)?;
    options.check_before_data(&kinds, run_folder::is_recording(path))
}

/// The limits given by `--seconds` and `--steps`, or `default_secs` if neither is given.
pub fn limits(
    seconds: Option<f64>,
    steps: Option<u64>,
    default_secs: f64,
) -> anyhow::Result<Limits> {
    if seconds.is_some_and(|seconds| seconds.is_nan() || seconds < 0.0) {
        let message = format!("{}: must be a number of at least 0", Setting::Seconds);
        return Err(BadInput(message).into());
    }
    Ok(Limits {
        seconds: seconds.or(steps.is_none().then_some(default_secs)),
        steps,
    })
}
