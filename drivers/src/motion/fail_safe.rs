//! Ends all motion of this process at once, before it exits without an orderly stop.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// Whether all arms must send their fail-safe command now.
static IS_DUE: AtomicBool = AtomicBool::new(false);
/// Arms that this process commands, and that need a fail-safe command.
static N_COMMANDED: AtomicUsize = AtomicUsize::new(0);
/// Maximum time to wait for the arms. An arm resends the fail-safe command for at most its timeout
/// plus 2 s. The largest timeout is 2 s. The remaining second is a reserve for a busy computer.
const MAX_WAIT: Duration = Duration::from_secs(5);

/// Sends the fail-safe command to all arms with CAN motors or servos that this process moves. The
/// arms are not brought to rest first. Waits until their threads have ended, for at most 5 s. These
/// arms accept no further commands. Call this function before the process ends without an orderly
/// stop.
///
/// Franka arms brake when the connection ends. The program that moves an arm of Universal Robots
/// brakes it when the setpoints end.
pub fn apply_fail_safe() {
    // The flag is never reset, because the program is about to end. An arm that is opened after
    // this point therefore sends no commands either.
    IS_DUE.store(true, Ordering::Relaxed);
    let deadline = Instant::now() + MAX_WAIT;
    // Polling needs no locks, so this also works if another thread has panicked or holds a lock.
    while N_COMMANDED.load(Ordering::Relaxed) > 0 && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// An arm that is commanded as long as this value exists.
#[derive(Debug)]
pub(crate) struct CommandedArm(());

impl CommandedArm {
    pub(crate) fn new() -> Self {
        N_COMMANDED.fetch_add(1, Ordering::Relaxed);
        Self(())
    }

    /// Whether the arm must send its fail-safe command now.
    pub(crate) fn is_fail_safe_due() -> bool {
        IS_DUE.load(Ordering::Relaxed)
    }
}

impl Drop for CommandedArm {
    fn drop(&mut self) {
        N_COMMANDED.fetch_sub(1, Ordering::Relaxed);
    }
}
