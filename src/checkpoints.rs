//! Checkpoints of a model in training: taken every so often, written on a thread of their own.

use crate::run_folder::{CHECKPOINT, expect_one_model};
use anyhow::Context;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use trainer::Method;
use trainer::checkpoint::{Checkpoint, PendingCheckpoint};

/// How often checkpoints are written.
#[derive(Clone, Copy, Debug, clap::Args)]
pub(crate) struct CheckpointArgs {
    /// Write all that training needs to go on every S seconds and at the end, for `train --resume`; 0: never
    #[arg(long, value_name = "S", default_value = "60", value_parser = secs)]
    checkpoint_secs: Duration,
}

fn secs(text: &str) -> Result<Duration, String> {
    let secs = text.parse().ok().and_then(|secs| Duration::try_from_secs_f64(secs).ok());
    secs.ok_or_else(|| "expected a number of at least 0".to_owned())
}

/// Reads the checkpoint in the folder of a run.
pub(crate) fn read(folder: &Path) -> anyhow::Result<Checkpoint> {
    expect_one_model(folder)?;
    Checkpoint::read(&folder.join(CHECKPOINT)).with_context(|| format!("nothing to go on from in {}", folder.display()))
}

/// What checkpoints say of the data.
#[derive(Clone, Debug, Default)]
pub(crate) struct OfData {
    /// SHA-256 of the model that depth was drawn from.
    pub(crate) depth_from: Option<String>,
    /// Flags that keyframes were made by.
    pub(crate) flags: BTreeMap<String, String>,
}

/// The checkpoints of one run; each replaces the one before.
pub(crate) struct Checkpoints {
    path: PathBuf,
    of_data: OfData,
    every: Duration,
    last: Instant,
    writing: Option<JoinHandle<Result<(), trainer::Error>>>,
}

impl Checkpoints {
    /// None where they are not wanted. The first is due after the time between two.
    pub(crate) fn new(folder: &Path, args: CheckpointArgs) -> Option<Self> {
        let (every, path) = (args.checkpoint_secs, folder.join(CHECKPOINT));
        (!every.is_zero()).then(|| Self {
            path,
            of_data: OfData::default(),
            every,
            last: Instant::now(),
            writing: None,
        })
    }

    /// Says this in each.
    pub(crate) fn with_data(self, of_data: OfData) -> Self {
        Self { of_data, ..self }
    }

    /// Begins one when it is due and the one before is written, and says so. A disk that refuses one does not stop training.
    pub(crate) fn when_due(&mut self, method: &mut dyn Method, seconds: f64) -> Result<bool, trainer::Error> {
        if self.last.elapsed() < self.every || self.writing.as_ref().is_some_and(|thread| !thread.is_finished()) {
            return Ok(false);
        }
        if let Err(error) = self.wait() {
            log::warn!("no checkpoint, training goes on: {error:#}");
        }
        self.begin(method, seconds)?;
        Ok(true)
    }

    /// Begins one of the state as it is now, after the one under way.
    pub(crate) fn begin(&mut self, method: &mut dyn Method, seconds: f64) -> Result<(), trainer::Error> {
        if let Err(error) = self.wait() {
            log::warn!("no checkpoint: {error:#}");
        }
        let asked = Instant::now();
        let pending = method.checkpoint()?;
        log::debug!("a checkpoint held training up for {:?}", asked.elapsed());
        let (path, of_data) = (self.path.clone(), self.of_data.clone());
        self.writing = Some(std::thread::spawn(move || write(pending, seconds, of_data, &path)));
        self.last = Instant::now();
        Ok(())
    }

    /// Waits until the one under way is on the disk.
    pub(crate) fn wait(&mut self) -> anyhow::Result<()> {
        let Some(thread) = self.writing.take() else { return Ok(()) };
        match thread.join() {
            Ok(written) => Ok(written?),
            Err(panic) => std::panic::resume_unwind(panic),
        }
    }
}

fn write(pending: PendingCheckpoint, seconds: f64, of_data: OfData, path: &Path) -> Result<(), trainer::Error> {
    let begun = Instant::now();
    let OfData { depth_from, flags: data_flags } = of_data;
    Checkpoint { seconds, depth_from, data_flags, ..pending.finish()? }.write(path)?;
    log::debug!("a checkpoint was written in {:?}", begun.elapsed());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_between_two_is_a_number() {
        assert_eq!(secs("0"), Ok(Duration::ZERO));
        assert_eq!(secs("0.5"), Ok(Duration::from_millis(500)));
        for wrong in ["-1", "nan", "inf", "minute", ""] {
            assert!(secs(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_folder_without_a_checkpoint_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let told = format!("{:#}", read(folder.path()).expect_err("none"));
        assert!(told.contains(folder.path().to_str().expect("plain")) && told.contains(CHECKPOINT), "{told}");
    }
}
