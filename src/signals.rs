//! Signals that end a command: it stops, saves, and exits.
//!
//! SIGINT (Ctrl-C), SIGTERM, SIGHUP (the terminal was closed) and SIGXCPU (the limit of processor
//! time was reached) request an orderly stop. A second Ctrl-C ends the process at once, and prints
//! how to continue the run. Two signals within half a second count as one. SIGQUIT also ends the
//! process at once. In both cases, arms with CAN motors first get their fail-safe command.
//! SIGHUP never ends the process at once, because closing a terminal sends it more than once: the
//! kernel sends it to the foreground group, and the shell sends it to its jobs. The kernel repeats
//! SIGXCPU every second. If the process was started with SIGHUP or SIGXCPU ignored, as `nohup` does
//! for SIGHUP, the signal stays ignored.
//!
//! SIGXFSZ (a file reached the limit of its size) does not end a command: the write fails instead.

use crate::print;
use anyhow::Context;
use capture::Stop;
use capture::ctrl_c::{CtrlC, Request};
use files::partial;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;
use session::StartedRun;
use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGXCPU, SIGXFSZ};
use signal_hook::iterator::Signals;
use signal_hook::{flag, low_level};
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Shells report this plus the signal number as the exit code of a process that a signal ended.
const SIGNAL_EXIT_BASE: i32 = 128;

/// Lets a write beyond the limit of the file size (`ulimit -f`) fail with an error, as on a full
/// disk. By default, SIGXFSZ would end the process without saving.
pub(crate) fn fail_writes_at_size_limit() -> anyhow::Result<()> {
    // Nobody reads the flag: with any handler, the write returns an error.
    flag::register(SIGXFSZ, Arc::new(AtomicBool::new(false)))
        .context("cannot install signal handlers")?;
    Ok(())
}

/// Handles SIGINT, SIGTERM, SIGHUP and SIGXCPU of a command that saves its results. Call this at
/// most once per process.
pub(crate) fn stop_on_signals() -> anyhow::Result<Stop> {
    stop_on_signals_logging("stopping and saving; Ctrl-C again exits at once")
}

/// The same as [`stop_on_signals`], but for a command that saves nothing.
pub(crate) fn stop_on_signals_logging(message: &'static str) -> anyhow::Result<Stop> {
    let (stop, [signaled, interrupted]) = Stop::with_signal_flags(message);
    let signals = Signals::new(termination_signals().chain([SIGQUIT]))
        .context("cannot install signal handlers")?;
    std::thread::Builder::new()
        .name("signals".into())
        .spawn(move || handle_signals(signals, &signaled, &interrupted))
        .context("cannot start a thread")?;
    Ok(stop)
}

/// Handles signals until the process ends. The signals arrive on this thread, because the fail-safe
/// command of arms may block, which is not allowed in a signal handler.
fn handle_signals(mut signals: Signals, signaled: &AtomicBool, interrupted: &AtomicBool) {
    let mut ctrl_c = CtrlC::default();
    for signal in signals.forever() {
        if signal == SIGQUIT {
            drivers::motion::apply_fail_safe();
            let _ = low_level::emulate_default_handler(SIGQUIT); // It does not return.
        }
        if signal == SIGINT {
            match ctrl_c.request(interrupted.load(Ordering::Relaxed), Instant::now()) {
                Request::Stop => interrupted.store(true, Ordering::Relaxed),
                Request::Nothing => continue,
                Request::Exit => {
                    drivers::motion::apply_fail_safe();
                    StartedRun::lines_at_exit().iter().for_each(print::notice);
                    print::flush_briefly();
                    low_level::exit(SIGNAL_EXIT_BASE + SIGINT);
                }
            }
        }
        // The flag is set last, because `Stop::rearm` relies on this order.
        signaled.store(true, Ordering::Relaxed);
    }
}

/// Requests a stop when stdout or stderr is closed, for example because a terminal closed without
/// sending SIGHUP, or the reader of a pipe ended. In this case, nobody supervises the motion. Call
/// this at most once per process.
pub(crate) fn stop_when_output_closes(stop: &Stop) -> anyhow::Result<()> {
    let stop = stop.clone();
    std::thread::Builder::new()
        .name("output".into())
        .spawn(move || {
            wait_until_output_closes();
            log::warn!("the output was closed: stopping");
            stop.request();
        })
        .context("cannot start a thread")?;
    Ok(())
}

fn wait_until_output_closes() {
    let stdout = std::io::stdout();
    let stderr = std::io::stderr();
    // Errors and hang-ups are reported without being requested.
    let mut outputs = [stdout.as_fd(), stderr.as_fd()]
        .map(|output| PollFd::from_borrowed_fd(output, PollFlags::empty()));
    while poll(&mut outputs, None) == Err(Errno::INTR) {}
}

/// Removes partial files before a signal ends the process.
///
/// This is for commands that have nothing to save when they are canceled. Other commands use
/// [`stop_on_signals`].
pub(crate) fn remove_partial_files_on_signals() -> anyhow::Result<()> {
    let mut signals =
        Signals::new(termination_signals()).context("cannot install signal handlers")?;
    std::thread::Builder::new()
        .name("signals".into())
        .spawn(move || {
            if let Some(signal) = signals.forever().next() {
                // The guard keeps other threads from creating files until the process has ended.
                let _no_new_files = partial::remove_all();
                std::process::exit(SIGNAL_EXIT_BASE + signal);
            }
        })
        .context("cannot start a thread")?;
    Ok(())
}

/// The signals that request a stop. The list does not contain SIGHUP and SIGXCPU if they are
/// ignored.
fn termination_signals() -> impl Iterator<Item = i32> {
    let unless_ignored = [SIGHUP, SIGXCPU]
        .into_iter()
        .filter(|signal| !is_ignored(*signal));
    [SIGINT, SIGTERM].into_iter().chain(unless_ignored)
}

/// Whether this process was started with the signal ignored. Linux reports this in `/proc`.
fn is_ignored(signal: i32) -> bool {
    let Ok(status) = std::fs::read_to_string("/proc/self/status") else {
        return false;
    };
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
        let status = |mask: &str| {
            format!("Name:\tfieldrig\nSigBlk:\t0000000000000001\nSigIgn:\t{mask}\nSigCgt:\tff\n")
        };
        assert!(is_in_ignore_mask(&status("0000000000001001"), SIGHUP));
        assert!(!is_in_ignore_mask(&status("0000000000001000"), SIGHUP));
        assert!(is_in_ignore_mask(&status("0000000000001000"), 13));
        assert!(!is_in_ignore_mask("Name:\tfieldrig\n", SIGHUP));
    }
}
