//! The monotonic clock that all stamps are on.

use kinematics::Stamp;
use rustix::time::{ClockId, clock_gettime};
use std::time::Duration;

/// Now, on the kernel's `CLOCK_MONOTONIC`: the clock of every program on this computer, and of V4L2's images.
pub fn now() -> Stamp {
    read(ClockId::Monotonic)
}

/// Now, on a clock that also counts while the computer sleeps: for what must be noticed after that, and nothing else.
#[cfg(target_os = "linux")]
pub(crate) fn now_with_sleep() -> Stamp {
    read(ClockId::Boottime)
}

fn read(clock: ClockId) -> Stamp {
    const NANOS_PER_SEC: i64 = 1_000_000_000;
    let now = clock_gettime(clock);
    Stamp(now.tv_sec.saturating_mul(NANOS_PER_SEC).saturating_add(now.tv_nsec))
}

/// How long processors have worked for this process so far.
pub fn processor() -> Duration {
    let spent = clock_gettime(ClockId::ProcessCPUTime);
    let [secs, nanos] = [spent.tv_sec, spent.tv_nsec].map(|part| u64::try_from(part).unwrap_or(0));
    Duration::from_secs(secs) + Duration::from_nanos(nanos)
}
