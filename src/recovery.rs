//! Recovery from a GPU failure during a run: every model continues on a reopened device from its newest checkpoint.

use crate::commands;
use crate::decisions::Settings;
use crate::method::ModelSpec;
use crate::run_folder::CHECKPOINT;
use crate::session::Session;
use anyhow::Context;
use keyframe::Keyframe;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Once, OnceLock};
use std::time::{Duration, Instant};
use trainer::gpu::Gpu;

/// How many times a run tries to reopen the GPU.
const MAX_RECOVERIES: u32 = 3;
/// After this time without a failure the count restarts: a run of several days may fail occasionally.
const RESET_COUNT_AFTER: Duration = Duration::from_secs(600);
/// Pause between attempts: a driver reset takes a moment.
const RETRY_DELAY: Duration = Duration::from_secs(1);

/// What a session needs to continue on another device.
pub(crate) struct Recovery {
    pub(crate) model_spec: ModelSpec,
    /// Folder of the run.
    pub(crate) folder: PathBuf,
    /// Folder of the checkpoint that the run was resumed from, if it was.
    pub(crate) resumed: Option<PathBuf>,
    /// Keyframes that the resumed model was trained on.
    pub(crate) known: Vec<Arc<Keyframe>>,
    /// Settings for the decision log.
    pub(crate) settings: Settings,
    /// The command that continues from the newest checkpoint.
    pub(crate) resume_command: String,
}

impl Recovery {
    /// What can be continued if the model cannot be saved, as a sentence without a period.
    pub(crate) fn describe_recoverable(&self, has_checkpoint: bool) -> String {
        let Self { folder, resume_command, .. } = self;
        match (has_checkpoint, &self.resumed) {
            (true, _) => {
                format!("the newest checkpoint is {}: `{resume_command}` continues from it", in_folder(folder))
            }
            (false, Some(resumed)) => {
                format!("no newer checkpoint was written: resume again from the one in {}", resumed.display())
            }
            (false, None) => "no checkpoint was written yet: start the run again".to_owned(),
        }
    }
}

fn in_folder(folder: &Path) -> String {
    folder.join(CHECKPOINT).display().to_string()
}

/// The GPU failed and the run could not continue on another device. The message names what is saved on disk.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct GpuUnrecoverable(String);

/// Whether the GPU caused the error.
pub(crate) fn is_gpu_error(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| cause.downcast_ref().is_some_and(trainer::Error::is_gpu_error))
}

/// What is saved of these sessions if they fail now: a sentence without a period, or empty if nothing is known.
pub(crate) fn describe_recoverable(sessions: &mut [Session]) -> String {
    let recoverable = sessions.iter_mut().filter_map(|session| {
        let has_checkpoint = session.has_checkpoint();
        Some(session.recovery()?.describe_recoverable(has_checkpoint))
    });
    recoverable.collect::<Vec<_>>().join("; ")
}

/// Adds what is saved on disk to an error of the GPU.
pub(crate) fn with_recoverable(error: anyhow::Error, recoverable: &str) -> anyhow::Error {
    if is_gpu_error(&error) && !recoverable.is_empty() {
        error.context(format!("the GPU failed at the end of the run; {recoverable}"))
    } else {
        error
    }
}

/// Counts the attempts of a run to reopen the GPU.
#[derive(Debug, Default)]
pub(crate) struct Recoveries {
    n: u32,
    last: Option<Instant>,
}

impl Recoveries {
    /// Continues all sessions on a reopened device if the GPU caused the error. Otherwise, and if all attempts fail,
    /// returns the error.
    pub(crate) fn recover(&mut self, sessions: &mut [Session], error: anyhow::Error) -> anyhow::Result<()> {
        if !is_gpu_error(&error) || sessions.iter().any(|session| session.recovery().is_none()) {
            return Err(error);
        }
        let began = Instant::now();
        if self.last.is_some_and(|last| last.elapsed() > RESET_COUNT_AFTER) {
            self.n = 0;
        }
        let mut error = error;
        while self.n < MAX_RECOVERIES {
            if self.n > 0 {
                std::thread::sleep(RETRY_DELAY);
            }
            self.n += 1;
            log::warn!("{error:#}: reopening the GPU, attempt {} of {MAX_RECOVERIES}", self.n);
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
        let recoverable = describe_recoverable(sessions);
        Err(GpuUnrecoverable(format!(
            "{error:#}; giving up after {MAX_RECOVERIES} attempts to reopen the GPU; {recoverable}"
        ))
        .into())
    }
}

fn restart_all(sessions: &mut [Session]) -> anyhow::Result<()> {
    sessions.iter_mut().for_each(Session::drop_model); // The new model may need its memory.
    let gpu = commands::open_gpu().context("cannot reopen the GPU")?;
    sessions.iter_mut().try_for_each(|session| session.restart_on(&gpu))
}

/// Hides the message of a panic that is caught: wgpu panics if it notices a lost device while it waits.
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

/// For tests: with `FIELDRIG_TEST_OPEN_GPU_ONCE` set, the GPU can be opened only once.
pub(crate) fn check_open_for_tests() -> Result<(), trainer::Error> {
    static IS_OPENED: AtomicBool = AtomicBool::new(false);
    let was_opened = IS_OPENED.swap(true, Ordering::Relaxed);
    if was_opened && std::env::var_os("FIELDRIG_TEST_OPEN_GPU_ONCE").is_some() {
        return Err(trainer::Error::NoAdapter);
    }
    Ok(())
}
