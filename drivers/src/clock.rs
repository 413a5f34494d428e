//! The monotonic clock that all stamps are on.

use kinematics::Stamp;
use std::time::Duration;

/// Now, on the kernel's `CLOCK_MONOTONIC`: the clock of every program on this computer, and of V4L2's images.
#[cfg(unix)]
pub fn now() -> Stamp {
    read(rustix::time::ClockId::Monotonic)
}

/// Now, on a clock that also counts while the computer sleeps: for what must be noticed after that, and nothing else.
#[cfg(target_os = "linux")]
pub(crate) fn now_including_suspend() -> Stamp {
    read(rustix::time::ClockId::Boottime)
}

#[cfg(unix)]
fn read(clock: rustix::time::ClockId) -> Stamp {
    const NANOS_PER_SEC: i64 = 1_000_000_000;
    let now = rustix::time::clock_gettime(clock);
    Stamp(now.tv_sec.saturating_mul(NANOS_PER_SEC).saturating_add(now.tv_nsec))
}

/// How long processors have worked for this process so far; `None` where the system is not asked.
#[cfg(unix)]
pub fn process_cpu_time() -> Option<Duration> {
    let spent = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    let [secs, nanos] = [spent.tv_sec, spent.tv_nsec].map(|part| u64::try_from(part).unwrap_or(0));
    Some(Duration::from_secs(secs) + Duration::from_nanos(nanos))
}

/// How long processors have worked for this process so far; `None` where the system is not asked.
#[cfg(not(unix))]
pub fn process_cpu_time() -> Option<Duration> {
    None
}

/// Now, since this was first asked for: a clock of this program alone, where there is no other.
#[cfg(not(unix))]
pub fn now() -> Stamp {
    static BEGAN: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    let began = BEGAN.get_or_init(std::time::Instant::now);
    Stamp(i64::try_from(began.elapsed().as_nanos()).unwrap_or(i64::MAX))
}
