//! The log of timing-dependent decisions. For example, it contains the step at which each keyframe
//! was added or removed, at which the result of an alignment was applied, and at which training
//! ended.
//!
//! The log has one JSON object per line, see `docs/reference/files.md`. The log contains steps but
//! no times, so that replaying it with the same data gives the same model.

use anyhow::{Context, anyhow};
use keyframe::{BaseState, Keyframe, Split, split_from_name, split_name};
use kinematics::transform::{from_xyz_xyzw, to_xyz_xyzw};
use kinematics::{Stamp, Transform};
use messages::BadInput;
use serde::{Deserialize, Serialize};
use std::io::Write;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;
use trainer::ModelOptions;

/// Version of the format. Logs of other versions are rejected, because a decision that this program
/// does not know would be missing in the replay.
const VERSION: u64 = 5;
/// Name of the log in the run folder.
pub(crate) const FILE: &str = "decisions.jsonl";
/// Maximum number of decisions that wait to be written. Training waits while this queue is full, so
/// that no decision is lost. A live run makes a few decisions per keyframe, so the queue is long
/// enough for a disk that does not respond for minutes. Each waiting keyframe keeps its image in
/// memory.
const MAX_WAITING: usize = 4096;

/// The first line: the settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    version: u64,
    /// Name of the method.
    pub method: String,
    /// Name of the dataset folder or recording; `None` if a live run was not recorded.
    pub data: Option<String>,
    /// The GPU adapter. Other adapters round differently.
    pub adapter: String,
    /// Fraction of the width and height to which images were scaled.
    pub scale: f64,
    /// SHA-256 of the model from which missing depth was rendered; `None` if depth was not
    /// rendered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth_from: Option<String>,
    /// SHA-256 of the points of the dataset from which training starts, see
    /// [`points_sha256`](crate::points_sha256); `None` if there are no points, or if they are not
    /// used because the images have depth.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub points: Option<String>,
    /// Step of the checkpoint that training continued from; `None` for a new run.
    pub from_step: Option<u64>,
    /// Options of the model.
    pub options: ModelOptions,
}

/// All inputs of a training run besides its data.
pub struct RunDescription<'a> {
    /// Name of the method.
    pub method: &'a str,
    /// Dataset folder or recording; `None` if a live run was not recorded.
    pub data: Option<&'a Path>,
    /// Description of the GPU.
    pub adapter: String,
    /// Fraction of the width and height to which images are scaled.
    pub scale: f64,
    /// SHA-256 of the model from which depth was rendered.
    pub depth_from: Option<String>,
    /// SHA-256 of the points from which training starts.
    pub points: Option<String>,
    /// Step of the checkpoint that training continues from; `None` for a new run.
    pub from_step: Option<u64>,
    /// Options of the model.
    pub options: ModelOptions,
}

impl Settings {
    /// The settings of a run.
    pub fn new(description: RunDescription<'_>) -> Self {
        let name = |path: &Path| {
            path.file_name()
                .map(|name| name.to_string_lossy().into_owned())
        };
        Self {
            version: VERSION,
            method: description.method.to_owned(),
            data: description.data.and_then(name),
            adapter: description.adapter,
            scale: description.scale,
            depth_from: description.depth_from,
            points: description.points,
            from_step: description.from_step,
            options: description.options,
        }
    }
}

impl Settings {
    /// The same settings for a run that continues from the checkpoint of step `from_step`. `None`
    /// stands for a restart without a checkpoint.
    pub fn continued_from(&self, from_step: Option<u64>) -> Self {
        Self {
            from_step,
            ..self.clone()
        }
    }
}

/// A decision and the step at which it was made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Entry {
    /// Number of updates before the decision, including those of rejected trials.
    pub step: u64,
    #[serde(flatten)]
    pub decision: Decision,
}

/// The kind of decision.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Decision {
    /// A keyframe that the model in the checkpoint was trained on.
    Restored(Pushed),
    /// A keyframe was added.
    Push(Pushed),
    /// A keyframe was removed.
    Remove(Removed),
    /// A picture was drawn before the next keyframe was added. This created splats from the
    /// keyframes so far.
    Seed(True),
    /// Training on the keyframes so far was started, but no update was made before the next
    /// keyframe was added.
    Begin(True),
    /// The result of an alignment in the background was applied.
    Align(True),
    /// Growth of the model was paused because its steps took too long (`true`), or continued
    /// (`false`).
    PauseGrowth(bool),
    /// A checkpoint was taken at this step.
    Checkpoint(True),
    /// Training ended.
    End(True),
}

/// A keyframe that was added.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Pushed {
    pub camera: String,
    pub stamp_nanos: i64,
    split: String,
    fingerprint: String,
    /// Correction of the base pose (`map_from_odom`), if the keyframe's station was re-registered:
    /// a translation in meters, then a quaternion with its real part last. The keyframe's poses
    /// were multiplied by it from the left.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    map_from_odom: Option<[f64; 7]>,
}

/// A keyframe that was removed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Removed {
    pub camera: String,
    pub stamp_nanos: i64,
}

/// The JSON value `true`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "bool", try_from = "bool")]
pub(crate) struct True;

impl From<True> for bool {
    fn from(_: True) -> Self {
        true
    }
}

impl TryFrom<bool> for True {
    type Error = &'static str;
    fn try_from(value: bool) -> Result<Self, Self::Error> {
        if value { Ok(Self) } else { Err("must be true") }
    }
}

impl Pushed {
    fn of(keyframe: &Keyframe) -> Self {
        // The identity is left out, because most runs have a fixed base and no corrections.
        let map_from_odom = keyframe.base.as_ref().map(|base| base.map_from_odom);
        Self {
            camera: keyframe.camera.to_string(),
            stamp_nanos: keyframe.stamp.0,
            split: split_name(keyframe.split).to_owned(),
            fingerprint: fingerprint_of(keyframe),
            map_from_odom: map_from_odom
                .filter(is_motion)
                .map(|motion| to_xyz_xyzw(&motion)),
        }
    }

    /// The keyframe as it was added: `read` with the logged correction of its base pose applied.
    /// Range scans have already corrected it while the recording was read.
    pub(crate) fn corrected(&self, read: &Arc<Keyframe>) -> Arc<Keyframe> {
        let is_corrected = |base: &BaseState| is_motion(&base.map_from_odom);
        match self.map_from_odom {
            Some(numbers) if !read.base.as_ref().is_some_and(is_corrected) => {
                Arc::new(read.with_base_correction(&from_xyz_xyzw(numbers)))
            }
            _ => read.clone(),
        }
    }

    /// Camera and stamp of the keyframe, nanoseconds.
    pub(crate) fn key(&self) -> (&str, i64) {
        (&self.camera, self.stamp_nanos)
    }

    /// The split of the keyframe. It is always `Some` in a log that was read, because the parser
    /// checks it.
    pub(crate) fn split(&self) -> Option<Split> {
        split_from_name(&self.split)
    }

    /// Whether a keyframe has the same pixels, depth, intrinsics, pose and velocity.
    pub(crate) fn matches(&self, keyframe: &Keyframe) -> bool {
        self.fingerprint == fingerprint_of(keyframe)
    }
}

fn is_motion(transform: &Transform) -> bool {
    *transform != Transform::identity()
}

fn fingerprint_of(keyframe: &Keyframe) -> String {
    format!("{:016x}", keyframe::fingerprint(keyframe))
}

/// Activity since the last logged decision, if it affects the result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Activity {
    Nothing,
    Seeded,
    Training,
}

/// Writes the log on a separate thread, so that a slow disk or a large image does not delay
/// training.
pub struct DecisionLog {
    sender: SyncSender<Line>,
    thread: JoinHandle<std::io::Result<()>>,
    /// The log file. It is watched, because somebody may remove it while it is written; `None` if
    /// it cannot be watched.
    kept: Option<files::Kept>,
    last_step: Option<u64>,
    activity: Activity,
}

enum Line {
    Settings(Box<Settings>),
    /// The writer thread computes the fingerprint, which takes time.
    Push(u64, Arc<Keyframe>),
    Restored(u64, Arc<Keyframe>),
    Entry(Entry),
}

impl DecisionLog {
    /// Creates the log in a run folder. A run that continues from a checkpoint writes a separate
    /// file and keeps the earlier log.
    pub fn create(folder: &Path, settings: Settings) -> anyhow::Result<Self> {
        // The earlier log reproduces the model of the checkpoint. The new log continues from the
        // checkpoint.
        let name = match settings.from_step {
            None => FILE.to_owned(),
            Some(step) => FILE.replace('.', &format!("-from-{step}.")),
        };
        let path = folder.join(name);
        let mut file =
            files::begin(&path).with_context(|| format!("cannot write {}", path.display()))?;
        let (sender, lines) = sync_channel(MAX_WAITING);
        let thread = std::thread::Builder::new()
            .name("decisions".into())
            .spawn(move || {
                // Written line by line, so that all decisions so far are on disk if the process is
                // killed.
                lines
                    .into_iter()
                    .try_for_each(|line: Line| file.write_all(line.text()?.as_bytes()))
            });
        let thread = thread.context("cannot start a thread")?;
        let kept = files::Kept::open(&path).ok();
        let mut log = Self {
            sender,
            thread,
            kept,
            last_step: None,
            activity: Activity::Nothing,
        };
        log.write(Line::Settings(Box::new(settings)));
        Ok(log)
    }

    /// Logs a keyframe that the model in a checkpoint was trained on.
    pub fn restored(&mut self, step: u64, keyframe: &Arc<Keyframe>) {
        self.write(Line::Restored(step, keyframe.clone()));
    }

    /// Logs that a keyframe was pushed after this many steps.
    pub fn pushed(&mut self, step: u64, keyframe: &Arc<Keyframe>) {
        self.log_activity(step);
        self.write(Line::Push(step, keyframe.clone()));
    }

    /// Logs that a keyframe was removed after this many steps.
    pub fn removed(&mut self, step: u64, camera: &str, stamp: Stamp) {
        self.log_activity(step);
        let removed_keyframe = Removed {
            camera: camera.to_owned(),
            stamp_nanos: stamp.0,
        };
        self.write(Line::Entry(Entry {
            step,
            decision: Decision::Remove(removed_keyframe),
        }));
    }

    /// Logs that the result of an alignment was applied after this many steps.
    pub fn aligned(&mut self, step: u64) {
        self.log_activity(step);
        self.write(Line::Entry(Entry {
            step,
            decision: Decision::Align(True),
        }));
    }

    /// Logs that growth was paused or continued after this many steps.
    pub fn growth_paused(&mut self, step: u64, is_paused: bool) {
        self.log_activity(step);
        self.write(Line::Entry(Entry {
            step,
            decision: Decision::PauseGrowth(is_paused),
        }));
    }

    /// Records that a picture was drawn.
    pub fn seeded(&mut self) {
        // Training has already created the splats that a picture would create.
        if self.activity == Activity::Nothing {
            self.activity = Activity::Seeded;
        }
    }

    /// Records that training steps were requested.
    pub fn step_requested(&mut self) {
        self.activity = Activity::Training;
    }

    /// Logs that a checkpoint was taken after this many steps. A checkpoint is not a decision, so
    /// it does not affect which activity is logged. A replay takes other checkpoints, but its log
    /// must have the same decisions.
    pub fn checkpoint(&mut self, step: u64) {
        self.write(Line::Entry(Entry {
            step,
            decision: Decision::Checkpoint(True),
        }));
    }

    /// Ends the log.
    ///
    /// # Errors
    ///
    /// If the log could not be written completely.
    pub fn end(mut self, step: u64) -> anyhow::Result<()> {
        self.log_activity(step);
        self.write(Line::Entry(Entry {
            step,
            decision: Decision::End(True),
        }));
        // The thread ends when it has written all waiting lines and no sender is left.
        drop(self.sender);
        let written = self
            .thread
            .join()
            .map_err(|_| anyhow!("the log thread panicked: this is a bug"))?;
        written.context("the decision log is incomplete")?;
        // If somebody has removed or renamed the log during the run, it is written again from the
        // file that is still open.
        match self.kept.filter(|kept| kept.place() != files::Place::Here) {
            Some(kept) => kept
                .restore()
                .with_context(|| format!("cannot write {} again", kept.path().display())),
            None => Ok(()),
        }
    }

    /// Closes the log without an end, as if the run had been killed. All decisions so far are
    /// written when this returns.
    pub fn close_unfinished(self) {
        drop(self.sender);
        let _ = self.thread.join(); // After a write error, the log is valid up to an earlier step.
    }

    /// Logs the activity since the last decision, unless a larger step number already implies it.
    fn log_activity(&mut self, step: u64) {
        let pending = match std::mem::replace(&mut self.activity, Activity::Nothing) {
            Activity::Seeded => Some(Decision::Seed(True)),
            Activity::Training => Some(Decision::Begin(True)),
            Activity::Nothing => None,
        };
        // A replay reaches a larger step only by training, which has the same effect as the
        // activity. If the step is the same, the replay needs this entry to repeat the activity.
        if let Some(decision) = pending
            && self.last_step == Some(step)
        {
            self.write(Line::Entry(Entry { step, decision }));
        }
        self.last_step = Some(step);
    }

    fn write(&mut self, line: Line) {
        // Sending fails only if the thread has ended, and joining the thread returns its error.
        let _ = self.sender.send(line);
    }
}

impl Line {
    fn text(self) -> std::io::Result<String> {
        let mut text = match self {
            Self::Settings(settings) => serde_json::to_string(&settings),
            Self::Push(step, keyframe) => serde_json::to_string(&Entry {
                step,
                decision: Decision::Push(Pushed::of(&keyframe)),
            }),
            Self::Restored(step, keyframe) => serde_json::to_string(&Entry {
                step,
                decision: Decision::Restored(Pushed::of(&keyframe)),
            }),
            Self::Entry(entry) => serde_json::to_string(&entry),
        }?;
        text.push('\n');
        Ok(text)
    }
}

/// A log that was read.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Decisions {
    pub settings: Settings,
    pub entries: Vec<Entry>,
}

impl Decisions {
    pub(crate) fn load(path: &Path) -> anyhow::Result<Self> {
        let text = files::read_text(path)
            .with_context(|| format!("cannot read the decision log {path:?}"))?;
        Self::parse(&text).with_context(|| format!("the decision log {path:?}"))
    }

    /// Whether the log contains the end of training. The log of a killed run does not.
    pub(crate) fn is_complete(&self) -> bool {
        self.entries
            .last()
            .is_some_and(|entry| entry.decision == Decision::End(True))
    }

    /// The keyframes in the log, in order.
    pub(crate) fn pushed(&self) -> impl Iterator<Item = &Pushed> {
        self.entries
            .iter()
            .filter_map(|entry| match &entry.decision {
                Decision::Restored(pushed) | Decision::Push(pushed) => Some(pushed),
                _ => None,
            })
    }

    fn parse(text: &str) -> Result<Self, BadInput> {
        let invalid = BadInput;
        let mut lines = text.split_inclusive('\n').zip(1..);
        let first = lines.next().map_or("", |(line, _)| line);
        // The version is checked first, because another version may have other settings. The error
        // then names the version and not a missing setting.
        let description: serde_json::Value =
            serde_json::from_str(first).map_err(|e| invalid(format!("line 1: {e}")))?;
        match description["version"].as_u64() {
            Some(VERSION) => {}
            Some(other) => {
                return Err(invalid(format!(
                    "unsupported version {other}, expected {VERSION}"
                )));
            }
            None => return Err(invalid("line 1 has no version".to_owned())),
        }
        let settings =
            serde_json::from_value(description).map_err(|e| invalid(format!("line 1: {e}")))?;
        let mut entries: Vec<Entry> = Vec::new();
        for (line, number) in lines {
            if !line.ends_with('\n') {
                break; // The run was killed while it wrote this line.
            }
            let entry: Entry =
                serde_json::from_str(line).map_err(|e| invalid(format!("line {number}: {e}")))?;
            let before = entries.last();
            if before.is_some_and(|before| before.decision == Decision::End(True)) {
                return Err(invalid(format!("line {number} comes after the end")));
            }
            // A replay cannot go back to an earlier step.
            if before.is_some_and(|before| before.step > entry.step) {
                return Err(invalid(format!(
                    "line {number}: step {} comes after a later step",
                    entry.step
                )));
            }
            if let Decision::Restored(pushed) | Decision::Push(pushed) = &entry.decision
                && pushed.split().is_none()
            {
                return Err(invalid(format!(
                    "line {number}: {:?} is not train, validation or test",
                    pushed.split
                )));
            }
            entries.push(entry);
        }
        Ok(Self { settings, entries })
    }
}

/// Whether a file name is that of a decision log, also of a resumed run.
pub(crate) fn is_log(name: &str) -> bool {
    let (stem, extension) = FILE.split_once('.').expect("the name has an extension");
    let middle = name
        .strip_prefix(stem)
        .and_then(|rest| rest.strip_suffix(extension)?.strip_suffix('.'));
    match middle.and_then(|middle| middle.strip_prefix("-from-")) {
        Some(step) => !step.is_empty() && step.bytes().all(|byte| byte.is_ascii_digit()),
        None => middle == Some(""),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Transform;
    use trainer::splat::SplatOptions;

    fn settings(from_step: Option<u64>) -> Settings {
        Settings::new(RunDescription {
            method: "splat",
            data: Some(Path::new("somewhere/scan.mcap")),
            adapter: "llvmpipe".to_owned(),
            scale: 0.5,
            depth_from: from_step.map(|_| "5ad1".to_owned()),
            points: from_step.map(|_| "c0de".to_owned()),
            from_step,
            options: ModelOptions::<SplatOptions>::default()
                .with(|options| {
                    options.common.seed = 7;
                    options.common.max_bytes = Some(5_000_000);
                })
                .to_json(),
        })
    }

    fn keyframe(stamp: i64, split: Split) -> Arc<Keyframe> {
        Arc::new(Keyframe {
            camera: "wrist".into(),
            stamp: Stamp(stamp),
            size_px: [1, 1],
            focal_px: [1.0; 2],
            principal_px: [0.5; 2],
            rgba_srgb: vec![1, 2, 3, 255].into(),
            depth: None,
            world_from_camera: Transform::identity(),
            twist: None,
            joint_twists: [].into(),
            base: None,
            readout_secs: 0.0,
            split,
            truth: None,
            robot: None,
        })
    }

    /// A log with two keyframes, a picture request between them, a removal, and the end.
    fn written(folder: &Path) -> String {
        let mut log = DecisionLog::create(folder, settings(None)).expect("a log");
        log.seeded(); // Not logged, because there is no keyframe yet.
        log.pushed(0, &keyframe(17, Split::Test));
        log.seeded();
        log.pushed(0, &keyframe(18, Split::Train));
        log.step_requested();
        log.pushed(0, &keyframe(19, Split::Validation));
        log.step_requested();
        log.seeded();
        log.removed(40, "wrist", Stamp(17));
        log.checkpoint(40);
        log.step_requested();
        log.end(60).expect("disk space");
        std::fs::read_to_string(folder.join(FILE)).expect("the log")
    }

    #[test]
    fn log_round_trips_without_times_or_paths() {
        let folder = tempfile::tempdir().expect("a folder");
        let text = written(folder.path());
        let read = Decisions::load(&folder.path().join(FILE)).expect("a log");
        assert_eq!(read.settings, settings(None));
        let expected_error: Vec<(u64, String)> = text
            .lines()
            .skip(1)
            .zip(&read.entries)
            .map(|(line, entry)| {
                assert_eq!(serde_json::to_string(entry).expect("JSON"), line);
                let value: serde_json::Value = serde_json::from_str(line).expect("JSON");
                let mut keys = value
                    .as_object()
                    .expect("an object")
                    .keys()
                    .filter(|key| *key != "step");
                (entry.step, keys.next().expect("a decision").clone())
            })
            .collect();
        let expected = [
            (0, "push"),
            (0, "seed"),
            (0, "push"),
            (0, "begin"),
            (0, "push"),
            (40, "remove"),
            (40, "checkpoint"),
            (60, "end"),
        ];
        assert_eq!(
            expected_error,
            expected.map(|(step, what)| (step, what.to_owned()))
        );
        assert!(read.is_complete());
        let pushed: Vec<_> = read
            .pushed()
            .map(|pushed| (pushed.stamp_nanos, pushed.split()))
            .collect();
        assert_eq!(
            pushed,
            [
                (17, Some(Split::Test)),
                (18, Some(Split::Train)),
                (19, Some(Split::Validation))
            ]
        );
        let first = read.pushed().next().expect("one");
        assert!(
            first.matches(&keyframe(17, Split::Train)),
            "the split is not part of the image"
        );
        let mut other = keyframe(17, Split::Test).as_ref().clone();
        other.rgba_srgb = vec![1, 2, 4, 255].into();
        assert!(!first.matches(&other));
        assert!(
            text.contains("\"data\":\"scan.mcap\"")
                && !text.contains("somewhere")
                && !text.contains("secs\":")
        );
    }

    #[test]
    fn checkpoints_do_not_affect_the_other_entries() {
        let decisions = |has_checkpoint: bool| -> Vec<String> {
            let folder = tempfile::tempdir().expect("a folder");
            let mut log = DecisionLog::create(folder.path(), settings(None)).expect("a log");
            log.pushed(0, &keyframe(17, Split::Train));
            log.step_requested();
            if has_checkpoint {
                log.checkpoint(50);
            }
            log.seeded();
            log.pushed(50, &keyframe(18, Split::Train));
            log.end(60).expect("disk space");
            let text = std::fs::read_to_string(folder.path().join(FILE)).expect("the log");
            text.lines()
                .filter(|line| !line.contains("\"checkpoint\""))
                .map(str::to_owned)
                .collect()
        };
        assert_eq!(decisions(true), decisions(false));
    }

    #[test]
    fn log_from_a_checkpoint_leaves_the_earlier_log_intact() {
        let folder = tempfile::tempdir().expect("a folder");
        let before = written(folder.path());
        let mut log = DecisionLog::create(folder.path(), settings(Some(130))).expect("a log");
        log.restored(130, &keyframe(18, Split::Train));
        log.end(260).expect("disk space");
        let read = Decisions::load(&folder.path().join("decisions-from-130.jsonl")).expect("a log");
        assert_eq!(
            (read.settings.from_step, read.pushed().count()),
            (Some(130), 1)
        );
        assert_eq!(
            std::fs::read_to_string(folder.path().join(FILE)).expect("the log"),
            before
        );
    }

    #[test]
    fn truncated_log_keeps_complete_lines() {
        let folder = tempfile::tempdir().expect("a folder");
        let text = written(folder.path());
        let lines = text.lines().count();
        let parse_prefix = |n_bytes: usize| Decisions::parse(&text[..n_bytes]).expect("a log");
        let ended = text.trim_end().rfind('\n').expect("lines") + 1;
        for n_bytes in [ended, ended + 5, text.len() - 1] {
            let read = parse_prefix(n_bytes);
            assert!(
                !read.is_complete() && read.entries.len() == lines - 2,
                "{n_bytes}: {:?}",
                read.entries
            );
        }
        assert!(
            parse_prefix(text.find('\n').expect("a line") + 1)
                .entries
                .is_empty()
        );
        assert!(
            Decisions::parse(&text[..9]).is_err(),
            "a log without settings is invalid"
        );
    }

    #[test]
    fn invalid_lines_are_reported_with_line_number() {
        let folder = tempfile::tempdir().expect("a folder");
        let text = written(folder.path());
        for (was, is, expected_error) in [
            ("\"version\":5", "\"version\":9", "version 9, expected 5"),
            ("\"version\"", "\"varsion\"", "line 1 has no version"),
            ("\"scale\"", "\"skale\"", "line 1: "),
            ("\"begin\":true", "\"begin\":false", "line 5: must be true"),
            ("\"seed\":true", "\"sing\":true", "line 3: "),
            (
                "\"validation\"",
                "\"selected\"",
                "line 6: \"selected\" is not train",
            ),
            (
                "{\"step\":40,\"remove\"",
                "{\"step\":70,\"remove\"",
                "line 8: step 40 comes after a later step",
            ),
            (
                "{\"step\":40,\"checkpoint\":true}",
                "{\"step\":40,\"end\":true}",
                "line 9 comes after the end",
            ),
        ] {
            assert!(text.contains(was), "{was}");
            let error = format!(
                "{:#}",
                Decisions::parse(&text.replace(was, is)).expect_err(is)
            );
            assert!(error.contains(expected_error), "{error}");
        }
    }
}
