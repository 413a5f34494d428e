//! Requests real-time scheduling for a thread.

use franka::realtime::set_current_thread_scheduler_priority;
use rustix::mm::{MlockAllFlags, mlockall};

/// Real-time priority. It is above all ordinary threads and interrupt threads (50), and below the
/// kernel's watchdogs (99).
const PRIORITY: i32 = 80;

/// Gives the calling thread a real-time priority, and locks the memory that the program currently
/// uses.
///
/// Memory allocated later is not locked. Images and models are large, and nothing at 1 kHz waits
/// for them. A denied request is logged, and the thread continues without it.
pub(super) fn request_realtime(device: &str) {
    let mut denied = Vec::new();
    if let Err(reason) = set_current_thread_scheduler_priority(PRIORITY) {
        denied.push(format!(
            "real-time priority ({})",
            reason.trim_start_matches("libfranka: ")
        ));
    }
    // A page fault that reads from a disk takes longer than the millisecond in which a state must
    // be answered. `ONFAULT` locks pages when they are used, so that large unused reservations take
    // no memory.
    if let Err(error) = mlockall(MlockAllFlags::CURRENT | MlockAllFlags::ONFAULT) {
        denied.push(format!("locked memory ({error})"));
    }
    if !denied.is_empty() {
        let denied = denied.join(" and ");
        log::warn!(
            "{device}: works without {denied}; states may be read late. Run `fieldrig doctor` for a fix"
        );
    }
}
