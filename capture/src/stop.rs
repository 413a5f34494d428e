//! Signals that end a run: it stops, saves, and exits.
//!
//! SIGINT (Ctrl-C), SIGTERM and SIGHUP (the terminal was closed) request an orderly stop. A second Ctrl-C ends the
//! process at once. SIGHUP never does, because a closing terminal sends it more than once: the kernel to the foreground
//! group, the shell to its jobs. If SIGHUP is ignored, as under `nohup`, it stays ignored.

use anyhow::Context;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::flag;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Exit code of a process ended by an interrupt, as shells report it: 128 + SIGINT.
const INTERRUPTED: i32 = 130;

/// Whether a stop was requested. Clones share the state.
#[derive(Clone, Debug, Default)]
pub(crate) struct Stop {
    /// By the program itself.
    requested: Arc<AtomicBool>,
    /// By a signal.
    signaled: Arc<AtomicBool>,
    /// Whether the signal was logged.
    logged: Arc<AtomicBool>,
    /// The message to log then.
    message: &'static str,
}

impl Stop {
    /// Handles SIGINT, SIGTERM and SIGHUP; at most once per process.
    pub(crate) fn on_ctrl_c() -> anyhow::Result<Self> {
        Self::on_ctrl_c_logging("stopping and saving; Ctrl-C again exits at once")
    }

    /// As [`Self::on_ctrl_c`], for a command that saves nothing.
    pub(crate) fn on_ctrl_c_logging(message: &'static str) -> anyhow::Result<Self> {
        let stop = Self { message, ..Self::default() };
        let interrupted = Arc::new(AtomicBool::new(false));
        let register = || -> std::io::Result<()> {
            // A signal's actions run in the order of registration: the first Ctrl-C only sets the flags.
            flag::register_conditional_shutdown(SIGINT, INTERRUPTED, interrupted.clone())?;
            flag::register(SIGINT, interrupted)?;
            termination_signals().try_for_each(|signal| flag::register(signal, stop.signaled.clone()).map(drop))
        };
        register().context("cannot install signal handlers")?;
        Ok(stop)
    }

    /// Requests a stop.
    pub(crate) fn request(&self) {
        self.requested.store(true, Ordering::Relaxed);
    }

    /// Whether a stop was requested.
    pub(crate) fn requested(&self) -> bool {
        self.requested.load(Ordering::Relaxed) || self.signaled()
    }

    /// Whether a signal requested a stop.
    pub(crate) fn signaled(&self) -> bool {
        let signaled = self.signaled.load(Ordering::Relaxed);
        if signaled && !self.logged.swap(true, Ordering::Relaxed) {
            log::info!("{}", self.message);
        }
        signaled
    }
}

/// The signals that request a stop; without SIGHUP if it is ignored.
pub(crate) fn termination_signals() -> impl Iterator<Item = i32> {
    [SIGINT, SIGTERM].into_iter().chain((!is_ignored(SIGHUP)).then_some(SIGHUP))
}

/// Whether this process was started with the signal ignored, which Linux reports in `/proc`.
fn is_ignored(signal: i32) -> bool {
    let Ok(status) = std::fs::read_to_string("/proc/self/status") else { return false };
    is_in_ignore_mask(&status, signal)
}

/// Reads the mask `SigIgn` of `/proc/self/status`: bit n - 1 is set if signal n is ignored.
fn is_in_ignore_mask(status: &str, signal: i32) -> bool {
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ignored_signals_are_parsed_from_the_mask() {
        let status = |mask: &str| format!("Name:\tfieldrig\nSigBlk:\t0000000000000001\nSigIgn:\t{mask}\nSigCgt:\tff\n");
        assert!(is_in_ignore_mask(&status("0000000000001001"), SIGHUP));
        assert!(!is_in_ignore_mask(&status("0000000000001000"), SIGHUP));
        assert!(is_in_ignore_mask(&status("0000000000001000"), 13));
        assert!(!is_in_ignore_mask("Name:\tfieldrig\n", SIGHUP));
    }
}
