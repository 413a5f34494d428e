//! Checkpoints of a model in training: taken periodically and written on a separate thread.

use crate::run_folder::{CHECKPOINT, expect_one_model};
use crate::stored_keyframes::StoredKeyframes;
use anyhow::Context;
use background::Task;
use keyframe::Keyframe;
use messages::{BadInput, Setting};
use model_files::checkpoint::Checkpoint;
use model_files::{Edits, RunHistory};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::{AlignedModel, ModelKind, PendingCheckpoint};

/// Default time between two checkpoints: the training time that a killed process loses at most.
/// Each checkpoint writes the whole state, so shorter periods write more to the disk.
const DEFAULT_PERIOD: Duration = Duration::from_secs(60);
/// Time between two writes of new keyframes in a live run. It is shorter than the period of
/// checkpoints, because images that are lost cannot be captured again, and each one is written only
/// once.
const KEYFRAME_PERIOD: Duration = Duration::from_secs(2);
/// Name of the flag as stored in checkpoints.
const CHECKPOINT_SECS: &str = "checkpoint-secs";

/// How often checkpoints are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CheckpointOptions {
    /// Time between two checkpoints. `None` stands for 60 s, and zero disables checkpoints.
    pub period: Option<Duration>,
}

impl CheckpointOptions {
    /// The flag as it is stored in a checkpoint, if it was given.
    pub fn flag(self) -> Option<(String, String)> {
        Some((
            CHECKPOINT_SECS.to_owned(),
            self.period?.as_secs_f64().to_string(),
        ))
    }

    /// Whether checkpoints are written, so that the run can be continued.
    pub fn are_written(self) -> bool {
        self.period != Some(Duration::ZERO)
    }

    /// These options, with the period of the earlier run if the flag was not given.
    pub fn or_previous(self, flags: &BTreeMap<String, String>) -> Self {
        Self {
            period: self.period.or_else(|| period_in(flags)),
        }
    }
}

/// The period among the flags of an earlier run; `None` if it was not given or is invalid.
fn period_in(flags: &BTreeMap<String, String>) -> Option<Duration> {
    parse_period(flags.get(CHECKPOINT_SECS)?).ok()
}

/// Parses a number of seconds that is at least 0.
///
/// # Errors
///
/// If the text is not such a number.
pub fn parse_period(text: &str) -> Result<Duration, String> {
    let secs = text
        .parse()
        .ok()
        .and_then(|secs| Duration::try_from_secs_f64(secs).ok());
    secs.ok_or_else(|| "expected a number of at least 0".to_owned())
}

/// Reads the checkpoint in a run folder. If the folder also contains the complete model, the edits
/// are those saved with it, which operators may have changed after the end of the run.
pub fn read(folder: &Path) -> anyhow::Result<Checkpoint> {
    expect_one_model(folder)?;
    let mut checkpoint = Checkpoint::read(&folder.join(CHECKPOINT))
        .with_context(|| format!("no checkpoint to resume from in {}", folder.display()))?;
    // The files of a model are moved into place one by one. The last one shows that all are there.
    let last_file =
        ModelKind::from_name(&checkpoint.method).and_then(|kind| kind.entry().files.last());
    if last_file.is_some_and(|file| folder.join(file).is_file()) {
        checkpoint.edits = Edits::read(folder)?;
    }
    Ok(checkpoint)
}

/// Rejects a limit in seconds that earlier training has already reached.
pub fn check_limit_not_passed(
    seconds: Option<f64>,
    checkpoint: &Checkpoint,
    subject: &str,
) -> anyhow::Result<()> {
    match seconds.filter(|seconds| *seconds <= checkpoint.seconds) {
        Some(seconds) => Err(BadInput(format!(
            "{} {seconds}: {subject} has already been trained for {:.1} s, which is part of the limit; give a larger limit",
            Setting::Seconds,
            checkpoint.seconds
        ))
        .into()),
        None => Ok(()),
    }
}

/// Contents of every checkpoint of a run besides the model state.
#[derive(Clone, Debug, Default)]
pub struct RunFlags {
    /// SHA-256 of the model from which depth was rendered.
    pub depth_from: Option<String>,
    /// Flags of the run that affect its keyframes or limits, by name.
    pub flags: BTreeMap<String, String>,
}

/// The checkpoints of one run. Each checkpoint replaces the previous one.
pub struct Checkpoints {
    path: PathBuf,
    run_flags: RunFlags,
    period: Duration,
    /// Time after `last` at which the next checkpoint is due.
    due_after: Duration,
    last: Instant,
    /// Storage of keyframes that exist nowhere else on disk; `None` if there is another copy.
    stored_keyframes: Option<StoredKeyframes>,
    last_keyframes: Instant,
    /// Keyframes that must be stored again, because their poses were revised.
    revised: Vec<Arc<Keyframe>>,
    writer: Option<WriterThread>,
    /// Whether this run has written a checkpoint.
    has_any: bool,
    /// Progress of the last requested checkpoint.
    requested: Option<CheckpointProgress>,
    /// Number of images that did not become keyframes so far, by reason.
    rejected: BTreeMap<String, u64>,
}

/// Progress of a requested checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CheckpointProgress {
    /// It is due.
    Due,
    /// It is being written.
    Writing,
    /// It is on disk.
    Written,
    /// It could not be written, for this reason.
    Failed(String),
}

/// A writer thread.
struct WriterThread {
    thread: Task<anyhow::Result<()>>,
    /// Keyframes that it stores again.
    revised: Vec<Arc<Keyframe>>,
    /// `true` if it writes a checkpoint, `false` if it writes only keyframes.
    is_checkpoint: bool,
}

/// A model in training, and the other contents of its checkpoint.
pub struct Snapshot<'a> {
    /// The model.
    pub method: &'a mut AlignedModel,
    /// All keyframes in the store, including test keyframes.
    pub keyframes: &'a [Arc<Keyframe>],
    /// Erased space.
    pub edits: &'a Edits,
    /// Training time in seconds and mean PSNR of the test images in dB, in order.
    pub psnr_history: &'a [(f64, f64)],
    /// Training time, seconds.
    pub seconds: f64,
    /// Whether training has reached its limit.
    pub is_finished: bool,
}

impl Checkpoints {
    /// Returns `None` if checkpoints are disabled. The first checkpoint is due after one period.
    pub fn new(folder: &Path, options: CheckpointOptions) -> Option<Self> {
        let period = options.period.unwrap_or(DEFAULT_PERIOD);
        (!period.is_zero()).then(|| Self {
            path: folder.join(CHECKPOINT),
            run_flags: RunFlags::default(),
            period,
            due_after: period,
            last: Instant::now(),
            stored_keyframes: None,
            last_keyframes: Instant::now(),
            revised: Vec::new(),
            writer: None,
            has_any: false,
            requested: None,
            rejected: BTreeMap::new(),
        })
    }

    /// Stores these flags in each checkpoint.
    pub fn with_flags(self, run_flags: RunFlags) -> Self {
        Self { run_flags, ..self }
    }

    /// Also stores the keyframes, for a live run whose images exist nowhere else. The first
    /// checkpoint is due as soon as the first keyframes are written, because resuming needs both.
    pub fn with_keyframes(self, run: &Path) -> Self {
        let due_after = self.period.min(KEYFRAME_PERIOD);
        Self {
            stored_keyframes: Some(StoredKeyframes::of_run(run)),
            due_after,
            ..self
        }
    }

    /// Whether keyframes are also stored.
    pub fn keeps_keyframes(&self) -> bool {
        self.stored_keyframes.is_some()
    }

    /// Starts a checkpoint if one is due and the previous one is complete. Returns whether a
    /// checkpoint was started. Write errors are logged and do not stop training.
    pub fn write_when_due(&mut self, now: Snapshot<'_>) -> Result<bool, trainer::Error> {
        // There is only one writer at a time. If the disk is slow, checkpoints become rarer, and
        // copies of the state do not accumulate in memory.
        if self
            .writer
            .as_ref()
            .is_some_and(|writer| !writer.thread.is_finished())
        {
            return Ok(false);
        }
        // A checkpoint of a live run without keyframes could not be resumed.
        let is_resumable = self.stored_keyframes.is_none() || !now.keyframes.is_empty();
        if self.last.elapsed() >= self.due_after && is_resumable {
            self.begin(now)?;
            return Ok(true);
        }
        if let Some(stored) = self
            .stored_keyframes
            .clone()
            .filter(|_| self.last_keyframes.elapsed() >= KEYFRAME_PERIOD)
        {
            // The last writer has finished. This logs its error, if there was one.
            self.wait_and_warn();
            let keyframes = now.keyframes.to_vec();
            let revised = std::mem::take(&mut self.revised);
            let written = revised.clone();
            let thread = Task::start("keyframes", move || stored.add(&keyframes, &written));
            self.writer = Some(WriterThread {
                thread,
                revised,
                is_checkpoint: false,
            });
            self.last_keyframes = Instant::now();
        }
        Ok(false)
    }

    /// Stores a keyframe again, because its pose was revised.
    pub(crate) fn store_again(&mut self, keyframe: &Arc<Keyframe>) {
        if self.stored_keyframes.is_some() {
            self.revised.push(Arc::clone(keyframe));
        }
    }

    /// Sets how many images did not become keyframes so far, by reason, for the next checkpoint.
    pub fn set_rejected(&mut self, rejected: &BTreeMap<String, u64>) {
        self.rejected.clone_from(rejected);
    }

    /// Makes the next checkpoint due now.
    pub fn request(&mut self) {
        self.due_after = Duration::ZERO;
        self.requested = Some(CheckpointProgress::Due);
    }

    /// Progress of the last requested checkpoint; `None` if none was requested.
    pub fn requested(&mut self) -> Option<&CheckpointProgress> {
        let has_ended = self
            .writer
            .as_ref()
            .is_some_and(|writer| writer.thread.is_finished());
        // Does not wait, because the writer has ended. This logs its error, if there was one.
        if has_ended && self.requested == Some(CheckpointProgress::Writing) {
            self.wait_and_warn();
        }
        self.requested.as_ref()
    }

    /// Waits for the checkpoint in progress, then starts a checkpoint of the current state.
    pub fn begin(&mut self, now: Snapshot<'_>) -> Result<(), trainer::Error> {
        let job = self.take(now)?;
        self.write(job);
        Ok(())
    }

    /// Copies the current state for [`Self::write`].
    pub fn take(&mut self, now: Snapshot<'_>) -> Result<CheckpointWrite, trainer::Error> {
        self.wait_and_warn();
        let started = Instant::now();
        let pending = now.method.checkpoint()?;
        log::debug!(
            "taking a checkpoint paused training for {:?}",
            started.elapsed()
        );
        Ok(CheckpointWrite {
            pending,
            seconds: now.seconds,
            is_finished: now.is_finished,
            edits: now.edits.clone(),
            history: RunHistory::new(now.psnr_history, self.rejected.clone()),
            run_flags: self.run_flags.clone(),
            path: self.path.clone(),
            keyframes: self
                .stored_keyframes
                .clone()
                .map(|stored| (stored, now.keyframes.to_vec())),
            revised: std::mem::take(&mut self.revised),
        })
    }

    /// Writes a copy on a separate thread.
    pub fn write(&mut self, job: CheckpointWrite) {
        let revised = job.revised.clone();
        let thread = Task::start("checkpoint", move || job.write());
        self.writer = Some(WriterThread {
            thread,
            revised,
            is_checkpoint: true,
        });
        if self.requested == Some(CheckpointProgress::Due) {
            self.requested = Some(CheckpointProgress::Writing);
        }
        // A checkpoint also writes the new keyframes.
        self.last = Instant::now();
        self.last_keyframes = Instant::now();
        // The first checkpoint and requested checkpoints may be due earlier. From now on, the
        // period applies again.
        self.due_after = self.period;
    }

    /// Whether a checkpoint or keyframes are being written.
    pub(crate) fn is_writing(&self) -> bool {
        self.writer
            .as_ref()
            .is_some_and(|writer| !writer.thread.is_finished())
    }

    fn wait_and_warn(&mut self) {
        let is_checkpoint = self
            .writer
            .as_ref()
            .is_some_and(|writer| writer.is_checkpoint);
        match self.wait() {
            Ok(()) => {}
            Err(error) if is_checkpoint => {
                let previous = if self.path.exists() {
                    "; the previous one is kept"
                } else {
                    ""
                };
                log::warn!("cannot write a checkpoint{previous}: {error:#}");
            }
            // The next checkpoint tries to store the same keyframes, and a failure is then logged
            // as a warning.
            Err(error) => log::debug!("cannot store keyframes: {error:#}"),
        }
    }

    /// Path of the newest checkpoint of this run. Waits for the checkpoint in progress; if it
    /// fails, the previous checkpoint is the newest.
    pub fn newest(&mut self) -> Option<&Path> {
        if let Err(error) = self.wait() {
            log::warn!("the checkpoint in progress failed: {error:#}");
        }
        self.has_any.then_some(&self.path)
    }

    /// Waits until the checkpoint in progress is on disk.
    pub fn wait(&mut self) -> anyhow::Result<()> {
        let Some(WriterThread {
            thread,
            revised,
            is_checkpoint,
        }) = self.writer.take()
        else {
            return Ok(());
        };
        match thread.join() {
            Ok(written) => {
                if written.is_err() {
                    self.revised.extend(revised);
                }
                if is_checkpoint && self.requested == Some(CheckpointProgress::Writing) {
                    self.requested = Some(match &written {
                        Ok(()) => CheckpointProgress::Written,
                        Err(error) => CheckpointProgress::Failed(format!("{error:#}")),
                    });
                }
                written?;
                // Set only after success: `newest` must not name a file that does not exist.
                self.has_any |= is_checkpoint;
                Ok(())
            }
            Err(panic) => std::panic::resume_unwind(panic),
        }
    }
}

/// A checkpoint that is ready to be written.
pub struct CheckpointWrite {
    pending: PendingCheckpoint,
    seconds: f64,
    is_finished: bool,
    edits: Edits,
    history: RunHistory,
    run_flags: RunFlags,
    path: PathBuf,
    keyframes: Option<(StoredKeyframes, Vec<Arc<Keyframe>>)>,
    revised: Vec<Arc<Keyframe>>,
}

impl CheckpointWrite {
    /// Writes new keyframes, then the checkpoint, then removes keyframes that only the previous
    /// checkpoint needed.
    fn write(self) -> anyhow::Result<()> {
        let started = Instant::now();
        let RunFlags { depth_from, flags } = self.run_flags;
        // In this order, the files on disk form a complete state at any time. The keyframes of the
        // new checkpoint are written before the checkpoint. The keyframes of the old checkpoint
        // exist until it is replaced.
        if let Some((stored, keyframes)) = &self.keyframes {
            stored.add(keyframes, &self.revised)?;
        }
        Checkpoint {
            seconds: self.seconds,
            is_finished: self.is_finished,
            edits: self.edits,
            history: self.history,
            depth_from,
            flags,
            ..self.pending.finish()?
        }
        .write(&self.path)?;
        if let Some((stored, keyframes)) = &self.keyframes {
            stored.keep_only(keyframes)?;
        }
        log::debug!("wrote a checkpoint in {:?}", started.elapsed());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use model_files::Aabb;
    use model_files::edits::Edit;

    #[test]
    fn checkpoint_period_must_be_a_number() {
        assert_eq!(parse_period("0"), Ok(Duration::ZERO));
        assert_eq!(parse_period("0.5"), Ok(Duration::from_millis(500)));
        for invalid in ["-1", "nan", "inf", "minute", ""] {
            assert!(parse_period(invalid).is_err(), "{invalid}");
        }
    }

    #[test]
    fn resumed_run_keeps_the_checkpoint_period() {
        let [none, one, two] = [None, Some(1.0), Some(2.5)].map(|secs| CheckpointOptions {
            period: secs.map(Duration::from_secs_f64),
        });
        let flags = |options: CheckpointOptions| options.flag().into_iter().collect();
        assert_eq!(none.or_previous(&flags(two)).period, two.period);
        assert_eq!(one.or_previous(&flags(two)).period, one.period);
        assert_eq!(none.or_previous(&flags(none)).period, None);
    }

    #[test]
    fn revised_keyframes_that_could_not_be_stored_are_stored_later() {
        let folder = tempfile::tempdir().expect("a folder");
        let checkpoints = Checkpoints::new(folder.path(), CheckpointOptions::default());
        let mut checkpoints = checkpoints
            .expect("checkpoints are written")
            .with_keyframes(folder.path());
        let keyframe = crate::stored_keyframes::tests::keyframe(3, false);
        let mut write = |fails: bool| {
            checkpoints.store_again(&keyframe);
            let revised = std::mem::take(&mut checkpoints.revised);
            checkpoints.writer = Some(WriterThread {
                thread: Task::start("keyframes", move || {
                    anyhow::ensure!(!fails, "the disk is full");
                    Ok(())
                }),
                revised,
                is_checkpoint: false,
            });
            assert_eq!(checkpoints.wait().is_err(), fails);
            std::mem::take(&mut checkpoints.revised).len()
        };
        assert_eq!([true, false].map(&mut write), [1, 0]);
    }

    #[test]
    fn edits_saved_with_the_model_replace_those_of_the_checkpoint() {
        let folder = tempfile::tempdir().expect("a folder");
        let folder = folder.path();
        let kind = ModelKind::from_name("tsdf").expect("a method");
        let edits_of = |n: usize| {
            let aabb = Aabb {
                world_from_box: kinematics::Transform::identity(),
                min_m: [0.0; 3],
                max_m: [1.0; 3],
            };
            let mut edits = Edits::default();
            (0..n).for_each(|_| edits.push(Edit::Box(aabb)).expect("few edits"));
            edits
        };
        let checkpoint = Checkpoint {
            method: kind.name().to_owned(),
            seconds: 1.0,
            depth_from: None,
            flags: BTreeMap::new(),
            is_finished: false,
            edits: edits_of(1),
            history: RunHistory::default(),
            state: serde_json::Value::Null,
            arrays: Vec::new(),
        };
        checkpoint.write(&folder.join(CHECKPOINT)).expect("written");
        let n_edits = || read(folder).expect("a checkpoint").edits.len();
        edits_of(2).write(folder).expect("written");
        assert_eq!(n_edits(), 1, "the model is not saved yet");
        let files = kind.entry().files;
        std::fs::write(folder.join(files[0]), "").expect("written");
        assert_eq!(n_edits(), 1, "the model is incomplete");
        std::fs::write(folder.join(files[files.len() - 1]), "").expect("written");
        assert_eq!(n_edits(), 2);
        edits_of(0).write(folder).expect("written");
        assert_eq!(n_edits(), 0, "all edits were undone");
    }

    #[test]
    fn a_requested_checkpoint_is_reported_when_it_is_on_disk() {
        let options = CheckpointOptions::default();
        let mut checkpoints = Checkpoints::new(Path::new("unused"), options).expect("enabled");
        assert_eq!(checkpoints.requested(), None);
        // The first writer fails, and the second one does not.
        let results = [Err(anyhow::anyhow!("the disk is full")), Ok(())];
        let expected = [
            CheckpointProgress::Failed("the disk is full".to_owned()),
            CheckpointProgress::Written,
        ];
        for (result, expected) in results.into_iter().zip(expected) {
            checkpoints.request();
            assert_eq!(checkpoints.requested(), Some(&CheckpointProgress::Due));
            checkpoints.requested = Some(CheckpointProgress::Writing);
            checkpoints.writer = Some(WriterThread {
                thread: Task::start("checkpoint", move || result),
                revised: Vec::new(),
                is_checkpoint: true,
            });
            while checkpoints.requested() == Some(&CheckpointProgress::Writing) {
                std::thread::yield_now();
            }
            assert_eq!(checkpoints.requested(), Some(&expected));
        }
    }

    #[test]
    fn missing_checkpoint_error_names_the_folder() {
        let folder = tempfile::tempdir().expect("a folder");
        let message = format!("{:#}", read(folder.path()).expect_err("none"));
        assert!(
            message.contains(folder.path().to_str().expect("plain"))
                && message.contains(CHECKPOINT),
            "{message}"
        );
    }
}
