//! The monotonic clock that all stamps are on.

use kinematics::Stamp;
use rustix::time::{ClockId, clock_gettime};

/// Now, on the kernel's `CLOCK_MONOTONIC`: the clock of every program on this computer, and of V4L2's images.
pub fn now() -> Stamp {
    const NANOS_PER_SEC: i64 = 1_000_000_000;
    let now = clock_gettime(ClockId::Monotonic);
    Stamp(now.tv_sec.saturating_mul(NANOS_PER_SEC).saturating_add(now.tv_nsec))
}
