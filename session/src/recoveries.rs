//! Recovers from a GPU failure during a run: reopens the device and continues every model from its
//! newest checkpoint.

use crate::error::{GpuUnrecoverable, is_gpu_error};
use crate::session::Session;
use anyhow::Context;
use gpu::Gpu;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Maximum number of attempts to reopen the GPU. A driver that resets needs seconds. A device that
/// is still missing after several attempts has probably failed. The run should then report the
/// failure instead of recording without training.
const MAX_RECOVERIES: u32 = 3;
/// The attempt count is reset after this time without a failure, because a run of several days may
/// fail occasionally.
const RESET_COUNT_AFTER: Duration = Duration::from_secs(600);
/// Pause between attempts, because a driver reset takes time.
const RETRY_DELAY: Duration = Duration::from_secs(1);

/// Describes how to continue these sessions if they fail now, as a sentence without a period. Empty
/// without recovery.
pub fn describe_recoverable(sessions: &mut [Session]) -> String {
    sessions
        .iter_mut()
        .filter_map(|session| session.persistence().describe_recoverable())
        .collect::<Vec<_>>()
        .join("; ")
}

/// Opens the GPU, also after a failure.
pub type OpenGpu = fn() -> anyhow::Result<Arc<Gpu>>;

/// Counts the attempts of a run to reopen the GPU.
#[derive(Debug)]
pub struct Recoveries {
    open_gpu: OpenGpu,
    n: u32,
    last: Option<Instant>,
}

impl Recoveries {
    /// A counter without attempts.
    #[must_use]
    pub fn new(open_gpu: OpenGpu) -> Self {
        Self {
            open_gpu,
            n: 0,
            last: None,
        }
    }

    /// Continues all sessions on a reopened device if the GPU caused `error`. Returns an error if
    /// the GPU was not the cause, or if all attempts fail.
    pub fn recover(
        &mut self,
        sessions: &mut [Session],
        error: anyhow::Error,
    ) -> anyhow::Result<()> {
        // Other errors would also occur on another device. All models share the device, so all of
        // them must be able to restart.
        let can_restart = sessions
            .iter_mut()
            .all(|session| session.persistence().can_restore());
        if !is_gpu_error(&error) || !can_restart {
            return Err(error);
        }
        let began = Instant::now();
        if self
            .last
            .is_some_and(|last| last.elapsed() > RESET_COUNT_AFTER)
        {
            self.n = 0;
        }
        let mut error = error;
        while self.n < MAX_RECOVERIES {
            // The first attempt is made at once: most failures need no pause.
            if self.n > 0 {
                std::thread::sleep(RETRY_DELAY);
            }
            self.n += 1;
            log::warn!(
                "{error:#}: reopening the GPU, attempt {} of {MAX_RECOVERIES}",
                self.n
            );
            match restart_all(sessions, self.open_gpu) {
                Ok(()) => {
                    // All sessions share one clock, so the time is excluded only once.
                    sessions
                        .iter()
                        .take(1)
                        .for_each(|session| session.time().exclude(began.elapsed()));
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

fn restart_all(sessions: &mut [Session], open_gpu: OpenGpu) -> anyhow::Result<()> {
    sessions.iter_mut().for_each(Session::drop_model); // Frees memory for the new models.
    let gpu = open_gpu().context("cannot reopen the GPU")?;
    sessions
        .iter_mut()
        .try_for_each(|session| session.restart_on(&gpu))
}

#[cfg(test)]
mod tests {
    use super::*;
    use gpu::GpuOptions;
    use std::sync::atomic::{AtomicU32, Ordering};

    static N_OPENED: AtomicU32 = AtomicU32::new(0);

    fn open_and_count() -> anyhow::Result<Arc<Gpu>> {
        N_OPENED.fetch_add(1, Ordering::Relaxed);
        Ok(Gpu::open(&GpuOptions::default())?)
    }

    #[test]
    fn only_gpu_errors_reopen_the_gpu() {
        let mut recoveries = Recoveries::new(open_and_count);
        let bug = trainer::Error::Internal("a buffer is missing".to_owned());
        let error = recoveries
            .recover(&mut [], bug.into())
            .expect_err("the bug is reported");
        assert!(error.to_string().contains("a buffer is missing"), "{error}");
        assert_eq!((N_OPENED.load(Ordering::Relaxed), recoveries.n), (0, 0));
        recoveries
            .recover(&mut [], gpu::Error::DeviceLost.into())
            .expect("the GPU is reopened");
        assert_eq!((N_OPENED.load(Ordering::Relaxed), recoveries.n), (1, 1));
    }
}
