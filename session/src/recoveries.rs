//! Recovery from a GPU failure during a run: every model continues on a reopened device from its newest checkpoint.

use crate::open_gpu::open_gpu;
use crate::recovery::{GpuUnrecoverable, is_gpu_error};
use crate::session::Session;
use anyhow::Context;
use std::time::{Duration, Instant};

/// How many times a run tries to reopen the GPU.
const MAX_RECOVERIES: u32 = 3;
/// After this time without a failure the count restarts: a run of several days may fail occasionally.
const RESET_COUNT_AFTER: Duration = Duration::from_secs(600);
/// Pause between attempts: a driver reset takes a moment.
const RETRY_DELAY: Duration = Duration::from_secs(1);

/// What is saved of these sessions if they fail now: a sentence without a period, or empty if nothing is known.
pub(crate) fn describe_recoverable(sessions: &mut [Session]) -> String {
    let recoverable = sessions.iter_mut().filter_map(|session| {
        let has_checkpoint = session.has_checkpoint();
        Some(session.recovery()?.describe_recoverable(has_checkpoint))
    });
    recoverable.collect::<Vec<_>>().join("; ")
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
    let gpu = open_gpu().context("cannot reopen the GPU")?;
    sessions.iter_mut().try_for_each(|session| session.restart_on(&gpu))
}
