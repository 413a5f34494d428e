//! A GPU that fails during a run: every model continues on a newly opened device from its newest checkpoint.

use crate::commands;
use crate::decisions::Settings;
use crate::method::Recipe;
use crate::run_folder::CHECKPOINT;
use crate::session::Session;
use anyhow::Context;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Once, OnceLock};
use std::time::{Duration, Instant};
use trainer::Keyframe;
use trainer::gpu::Gpu;

/// How often a run opens the GPU again.
const MAX_RECOVERIES: u32 = 3;
/// A run that lasts for days may fail now and then: after this time without a failure the count begins again.
const FORGOTTEN_AFTER: Duration = Duration::from_secs(600);
/// A driver that resets needs a moment.
const BEFORE_RETRY: Duration = Duration::from_secs(1);

/// What a session needs to continue on another device.
pub(crate) struct Recovery {
    pub(crate) recipe: Recipe,
    /// Folder of the run.
    pub(crate) folder: PathBuf,
    /// Folder of the checkpoint that the run continues from, where it is a resumed one.
    pub(crate) resumed: Option<PathBuf>,
    /// Keyframes that the resumed model had learned from.
    pub(crate) known: Vec<Arc<Keyframe>>,
    /// Of the log of decisions.
    pub(crate) settings: Settings,
    /// What to type to continue from the newest checkpoint.
    pub(crate) resume_command: String,
}

impl Recovery {
    /// What is left of a run whose model could not be saved, as a sentence without a period.
    pub(crate) fn what_is_left(&self, has_checkpoint: bool) -> String {
        let Self { folder, resume_command, .. } = self;
        match (has_checkpoint, &self.resumed) {
            (true, _) => {
                format!("the newest checkpoint is {}: `{resume_command}` continues from it", in_folder(folder))
            }
            (false, Some(resumed)) => {
                format!(
                    "no checkpoint was written since that of {}, from which it can be resumed again",
                    resumed.display()
                )
            }
            (false, None) => "no checkpoint was written yet: start the run again".to_owned(),
        }
    }
}

fn in_folder(folder: &Path) -> String {
    folder.join(CHECKPOINT).display().to_string()
}

/// The GPU failed and a run could not continue on another device; says what is left on the disk.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct GpuGone(String);

/// Whether it is the GPU that failed.
pub(crate) fn is_of_gpu(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| cause.downcast_ref().is_some_and(trainer::Error::is_of_gpu))
}

/// What is left of these sessions on the disk, where they fail now: a sentence without a period; empty where nothing is known.
pub(crate) fn what_is_left(sessions: &mut [Session]) -> String {
    let left = sessions.iter_mut().filter_map(|session| {
        let has_checkpoint = session.has_checkpoint();
        Some(session.recovery()?.what_is_left(has_checkpoint))
    });
    left.collect::<Vec<_>>().join("; ")
}

/// An error of the GPU with what is left on the disk.
pub(crate) fn with_what_is_left(error: anyhow::Error, left: &str) -> anyhow::Error {
    if is_of_gpu(&error) && !left.is_empty() {
        error.context(format!("the GPU failed at the end of the run; {left}"))
    } else {
        error
    }
}

/// How often the GPU of a run was opened again.
#[derive(Debug, Default)]
pub(crate) struct Recoveries {
    n: u32,
    last: Option<Instant>,
}

impl Recoveries {
    /// Continues all sessions on a newly opened device where the error is one of the GPU; else gives the error back, as it does where
    /// that is in vain.
    pub(crate) fn recover(&mut self, sessions: &mut [Session], error: anyhow::Error) -> anyhow::Result<()> {
        if !is_of_gpu(&error) || sessions.iter().any(|session| session.recovery().is_none()) {
            return Err(error);
        }
        let began = Instant::now();
        if self.last.is_some_and(|last| last.elapsed() > FORGOTTEN_AFTER) {
            self.n = 0;
        }
        let mut error = error;
        while self.n < MAX_RECOVERIES {
            if self.n > 0 {
                std::thread::sleep(BEFORE_RETRY);
            }
            self.n += 1;
            log::warn!("{error:#}: opening the GPU again, attempt {} of {MAX_RECOVERIES}", self.n);
            match restart_all(sessions) {
                Ok(()) => {
                    // Several sessions share one clock.
                    sessions.iter().take(1).for_each(|session| session.exclude(began.elapsed()));
                    self.last = Some(Instant::now());
                    return Ok(());
                }
                Err(again) => error = again,
            }
        }
        let left = what_is_left(sessions);
        Err(GpuGone(format!("{error:#}; gave up after opening the GPU again {MAX_RECOVERIES} times; {left}")).into())
    }
}

fn restart_all(sessions: &mut [Session]) -> anyhow::Result<()> {
    sessions.iter_mut().for_each(Session::drop_model); // Its memory may be needed.
    let gpu = commands::open_gpu().context("the GPU cannot be opened again")?;
    sessions.iter_mut().try_for_each(|session| session.restart_on(&gpu))
}

/// Keeps quiet about a panic of wgpu that is caught: where it finds out while it waits that a driver lost its device, it panics.
pub(crate) fn hide_caught_panics() {
    static IS_SET: Once = Once::new();
    IS_SET.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            if !info.payload_as_str().is_some_and(|message| message.starts_with("Error in Device::poll")) {
                before(info);
            }
        }));
    });
}

/// For tests: `FIELDRIG_TEST_LOSE_GPU_AT_STEP=N` loses the device once, when a model reaches step N.
pub(crate) fn lose_for_tests(gpu: &Gpu, step: u64) {
    static AT_STEP: OnceLock<Option<u64>> = OnceLock::new();
    static IS_LOST: AtomicBool = AtomicBool::new(false);
    let at_step = AT_STEP.get_or_init(|| std::env::var("FIELDRIG_TEST_LOSE_GPU_AT_STEP").ok()?.parse().ok());
    if at_step.is_some_and(|at_step| step >= at_step) && !IS_LOST.swap(true, Ordering::Relaxed) {
        gpu.lose();
    }
}

/// For tests: with `FIELDRIG_TEST_OPEN_GPU_ONCE` set no GPU is found after the first was opened.
pub(crate) fn check_open_for_tests() -> Result<(), trainer::Error> {
    static IS_OPENED: AtomicBool = AtomicBool::new(false);
    let was_opened = IS_OPENED.swap(true, Ordering::Relaxed);
    if was_opened && std::env::var_os("FIELDRIG_TEST_OPEN_GPU_ONCE").is_some() {
        return Err(trainer::Error::NoAdapter);
    }
    Ok(())
}
