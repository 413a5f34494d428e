//! Asks the kernel to wake a thread in time.

use franka::realtime::set_current_thread_scheduler_priority;
use rustix::mm::{MlockAllFlags, mlockall};

/// Above all ordinary threads and those of interrupts (50), below the kernel's own watchdogs (99).
const PRIORITY: i32 = 80;

/// Gives the calling thread a real-time priority and keeps what memory the program has now from being swapped out.
///
/// Memory that it asks for later stays as it is: images and models are large, and nothing at 1 kHz waits for them. What is not
/// allowed is logged, and the thread works without.
pub(super) fn request_realtime(device: &str) {
    let mut denied = Vec::new();
    if let Err(reason) = set_current_thread_scheduler_priority(PRIORITY) {
        denied.push(format!("real-time priority ({})", reason.trim_start_matches("libfranka: ")));
    }
    if let Err(error) = mlockall(MlockAllFlags::CURRENT | MlockAllFlags::ONFAULT) {
        denied.push(format!("locked memory ({error})"));
    }
    if !denied.is_empty() {
        let denied = denied.join(" and ");
        log::warn!(
            "{device}: works without {denied}; states may be read late. `fieldrig doctor` tells what mends that"
        );
    }
}
