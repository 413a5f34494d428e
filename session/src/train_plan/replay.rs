//! Trains with the decisions in the log of an earlier run.

use super::TrainPlan;
use super::schedule::Schedule;
use crate::data::{Data, DataOptions};
use crate::decisions::{Decision, Decisions, Pushed};
use crate::depth_from;
use crate::method_options;
use crate::previous_run::PreviousRun;
use crate::read_progress::OnReadProgress;
use crate::session::{Limits, Session};
use crate::session_setup::Services;
use capture::Stop;
use capture::config::Override;
use keyframe::{Keyframe, KeyframeList};
use kinematics::Stamp;
use messages::{BadInput, InsufficientData, Setting};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};
use trainer::{ModelKind, ModelSpec};

/// A decision log to replay.
pub(super) struct Replay {
    path: PathBuf,
    decisions: Decisions,
    model_spec: ModelSpec,
    /// The keyframes whose poses were revised during the logged run, with the poses of the
    /// recording.
    revised: OnceLock<Vec<Arc<Keyframe>>>,
}

impl Replay {
    /// Reads a log.
    pub(super) fn load(path: &Path) -> anyhow::Result<Self> {
        let decisions = Decisions::load(path)?;
        let kind = ModelKind::from_name(&decisions.settings.method).ok_or_else(|| {
            BadInput(format!(
                "{}: unknown method {:?}",
                path.display(),
                decisions.settings.method
            ))
        })?;
        let model_spec = ModelSpec {
            kind,
            options: decisions.settings.options.clone(),
        };
        model_spec
            .check()
            .map_err(|error| BadInput(format!("{}: line 1: {error}", path.display())))?;
        let replay = Self {
            path: path.to_owned(),
            decisions,
            model_spec,
            revised: OnceLock::new(),
        };
        if replay.decisions.pushed().next().is_none() {
            return Err(InsufficientData(format!(
                "{} contains no keyframe to replay",
                replay.name()
            ))
            .into());
        }
        Ok(replay)
    }

    /// Returns an error if a keyframe of the log is missing from the data or differs.
    fn check_keyframes(&self, path: &Path, data: &Data) -> anyhow::Result<()> {
        let by_key = self.by_name(&data.keyframes);
        let name = self.name();
        let shown = path.display();
        for pushed in self.decisions.pushed() {
            let camera = &*pushed.camera;
            let stamp = pushed.stamp_nanos;
            let Some(keyframe) = by_key.get(&(camera, stamp)).map(|of| of.as_pushed(pushed)) else {
                return Err(InsufficientData(format!(
                    "{name} contains image {stamp} of camera {camera:?}, which is not in {shown}"
                ))
                .into());
            };
            if !pushed.matches(&keyframe) {
                return Err(InsufficientData(format!(
                    "image {stamp} of camera {camera:?} differs in pixels, depth, intrinsics or pose between {shown} \
                     and {name}"
                ))
                .into());
            }
        }
        Ok(())
    }

    /// Checks that training starts from the same points as the logged run, identified by their
    /// SHA-256.
    fn check_points(&self, sha256: Option<&str>) -> anyhow::Result<()> {
        let name = self.name();
        match (self.decisions.settings.points.as_deref(), sha256) {
            (log, here) if log == here => Ok(()),
            (None, _) => Err(InsufficientData(format!(
                "{name} starts without points: remove ply_file_path from transforms.json"
            ))
            .into()),
            (Some(log), here) => Err(InsufficientData(format!(
                "{name} starts from points with the SHA-256 {log}, but the data {}: restore the file of ply_file_path",
                here.map_or_else(
                    || "has no points".to_owned(),
                    |here| format!("has points with {here}")
                )
            ))
            .into()),
        }
    }

    /// Checks that training starts at the same step as the log. `from_step`: step of the checkpoint
    /// that training continues from.
    fn check_from_step(&self, from_step: Option<u64>) -> anyhow::Result<()> {
        let name = self.name();
        match (self.decisions.settings.from_step, from_step) {
            (log, here) if log == here => Ok(()),
            (None, _) => Err(BadInput(format!(
                "{name} starts at the first step: remove {}",
                Setting::Resume
            ))
            .into()),
            (Some(log), None) => Err(BadInput(format!(
                "{name} continues from step {log}: give the folder of that checkpoint with {}",
                Setting::Resume
            ))
            .into()),
            (Some(log), Some(here)) => Err(BadInput(format!(
                "{name} continues from step {log}, but the checkpoint is at step {here}"
            ))
            .into()),
        }
    }

    /// Logs a warning if the GPU adapter differs from the adapter in the log.
    fn check_adapter(&self, adapter: &str) {
        let logged_adapter = &self.decisions.settings.adapter;
        if logged_adapter != adapter {
            log::warn!(
                "{} was written on {logged_adapter:?}: this adapter rounds differently",
                self.name()
            );
        }
    }

    /// Replays the decisions, each at its step.
    fn replay(
        &self,
        session: &mut Session,
        keyframes: &[Arc<Keyframe>],
        stop: &Stop,
    ) -> anyhow::Result<()> {
        let by_key = self.by_name(keyframes);
        session.time().start(Instant::now());
        for entry in &self.decisions.entries {
            // Trains up to the step of the decision. Steps of rejected trials count, too, because
            // the log contains total numbers of steps.
            while !stop.requested() {
                let n_total_steps = session.n_total_steps()?;
                if n_total_steps >= entry.step {
                    break;
                }
                // A model that needs another keyframe would make no steps, and the loop would not
                // end.
                if step(session, entry.step - n_total_steps)? == 0 {
                    return Err(InsufficientData(format!(
                        "{} requires step {}, but there is nothing to train on",
                        self.name(),
                        entry.step
                    ))
                    .into());
                }
            }
            if stop.requested() {
                break;
            }
            match &entry.decision {
                Decision::Push(pushed) => {
                    if let Some(keyframe) = by_key.get(&pushed.key()) {
                        session.push(&keyframe.as_pushed(pushed))?;
                    }
                }
                Decision::Remove(removed) => {
                    session.remove(&removed.camera, Stamp(removed.stamp_nanos))?
                }
                Decision::Seed(_) => session.viewed().seed()?,
                // Waits for the result, because it was ready at this step in the logged run.
                Decision::Align(_) => drop(session.poll_alignment(true)?),
                Decision::PauseGrowth(is_paused) => session.pause_growth(*is_paused)?,
                // Starts training on the keyframes so far without a step.
                Decision::Begin(_) => drop(step(session, 0)?),
                // Checkpoints are written at the times of this run, not at those of the log. But a
                // checkpoint seeds the keyframes that wait.
                Decision::Checkpoint(_) => session.viewed().seed()?,
                // Restored keyframes need no push, because the model of the checkpoint has them
                // already.
                Decision::Restored(_) | Decision::End(_) => {}
            }
        }
        Ok(())
    }

    /// The logged settings as keys of a rig file, so that the resolved rig file lists the settings
    /// of the replay.
    fn overrides(&self) -> Vec<Override> {
        let ModelSpec { kind, options } = &self.model_spec;
        let mut overrides = vec![
            Override::new("train.method", kind.name()),
            Override::new("train.seed", options.common.seed.cast_signed()),
        ];
        overrides.extend(method_options::keys_of(options));
        overrides.extend(
            options
                .common
                .max_bytes
                .map(|bytes| Override::new("train.max_bytes", bytes.cast_signed())),
        );
        overrides
    }

    /// The keyframes of the data by camera and stamp.
    fn by_name<'a>(&'a self, keyframes: &'a [Arc<Keyframe>]) -> HashMap<(&'a str, i64), Found<'a>> {
        let revised = self.revised.get().map_or(&[][..], Vec::as_slice);
        let all = keyframes.iter().map(Found::AsPushed);
        let all = all.chain(revised.iter().map(Found::Revised));
        let key = |keyframe: &'a Arc<Keyframe>| (&*keyframe.camera, keyframe.stamp.0);
        all.map(|found| match found {
            Found::AsPushed(keyframe) | Found::Revised(keyframe) => (key(keyframe), found),
        })
        .collect()
    }

    fn name(&self) -> String {
        format!("the log {}", self.path.display())
    }
}

/// Trains for at most `max_steps` steps, and evaluates if an evaluation is due. Returns the number
/// of steps.
fn step(session: &mut Session, max_steps: u64) -> anyhow::Result<u64> {
    let n = session.train_steps(max_steps)?;
    session.evaluate_when_due()?;
    Ok(n)
}

impl Schedule for Replay {
    /// There are no limits, because a replay ends with the decisions of its log.
    fn limits(&self, _plan: &TrainPlan, _previous_secs: f64) -> anyhow::Result<Limits> {
        Ok(Limits::default())
    }

    /// Checks that depth was rendered from the same model as in the logged run.
    fn check_depth_from(&self, sha256: Option<&str>) -> anyhow::Result<()> {
        depth_from::check_same(
            &self.name(),
            self.decisions.settings.depth_from.as_deref(),
            sha256,
        )
    }

    fn images(
        &self,
        plan: &TrainPlan,
        _previous: Option<&PreviousRun>,
    ) -> anyhow::Result<DataOptions> {
        Ok(DataOptions {
            scale: Some(self.decisions.settings.scale),
            ..plan.images.clone()
        })
    }

    /// Loads exactly the keyframes that the log lists. [`Self::check_data`] checks that their
    /// contents are the same.
    fn load_data(
        &self,
        path: &Path,
        images: &DataOptions,
        _overrides: &[Override],
        progress: OnReadProgress<'_>,
    ) -> anyhow::Result<Data> {
        let pushed = || self.decisions.pushed();
        let list: KeyframeList = pushed()
            .filter_map(|pushed| {
                Some((
                    pushed.camera.clone(),
                    Stamp(pushed.stamp_nanos),
                    pushed.split()?,
                ))
            })
            .collect();
        let mut data = Data::of_list(
            path,
            list,
            images.rig.clone(),
            self.decisions.settings.scale,
            &self.overrides(),
            progress,
        )?;
        let mut n_pushed: HashMap<(&str, i64), usize> = HashMap::new();
        for pushed in pushed() {
            *n_pushed.entry(pushed.key()).or_default() += 1;
        }
        let revised = data.keyframes.iter().filter(|keyframe| {
            let key = (&*keyframe.camera, keyframe.stamp.0);
            n_pushed.get(&key).is_some_and(|n| *n > 1)
        });
        let _ = self.revised.set(revised.cloned().collect());
        // The last pose of a keyframe is the one with which the run ended.
        let as_pushed: HashMap<(&str, i64), &Pushed> =
            pushed().map(|pushed| (pushed.key(), pushed)).collect();
        // The data have base poses as reported. The logged run has corrected them at stations, and
        // these corrections depend on timing, so they come from the log.
        for keyframe in &mut data.keyframes {
            if let Some(pushed) = as_pushed.get(&(&*keyframe.camera, keyframe.stamp.0)) {
                *keyframe = pushed.corrected(keyframe);
            }
        }
        if !self.decisions.is_complete() {
            let last = self.decisions.entries.last().map_or(0, |entry| entry.step);
            let name = self.name();
            data.data_losses.push(format!(
                "{name} is truncated: replaying up to its last step, {last}"
            ));
        }
        Ok(data)
    }

    fn check_data(
        &self,
        path: &Path,
        data: &Data,
        points_sha256: Option<&str>,
    ) -> anyhow::Result<()> {
        self.check_keyframes(path, data)?;
        self.check_points(points_sha256)
    }

    fn model_specs(
        &self,
        _plan: &TrainPlan,
        _data: &Data,
        _is_software: bool,
    ) -> anyhow::Result<Vec<ModelSpec>> {
        Ok(vec![self.model_spec.clone()])
    }

    fn check_start(&self, from_step: Option<u64>, adapter: &str) -> anyhow::Result<()> {
        self.check_from_step(from_step)?;
        self.check_adapter(adapter);
        Ok(())
    }

    /// A replay is not restarted after a GPU failure, because its log refers to step numbers.
    fn can_recover(&self) -> bool {
        false
    }

    fn drive(
        &self,
        sessions: &mut [Session],
        keyframes: &[Arc<Keyframe>],
        _preparation_time: Duration,
        services: Services<'_>,
    ) -> anyhow::Result<()> {
        // A log describes a single model.
        self.replay(&mut sessions[0], keyframes, services.stop)
    }
}

/// A keyframe of the data.
enum Found<'a> {
    /// Its pose was never revised, so it is as it was pushed.
    AsPushed(&'a Arc<Keyframe>),
    /// Its pose was revised; here it has the pose of the recording.
    Revised(&'a Arc<Keyframe>),
}

impl Found<'_> {
    /// The keyframe as it was pushed this time.
    fn as_pushed(&self, pushed: &Pushed) -> Arc<Keyframe> {
        match self {
            Self::AsPushed(keyframe) => Arc::clone(keyframe),
            Self::Revised(keyframe) => pushed.corrected(keyframe),
        }
    }
}
