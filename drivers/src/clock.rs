//! The monotonic clock from which all stamps come.

use kinematics::Stamp;
use std::time::Duration;

/// Current time of the kernel's `CLOCK_MONOTONIC`. All programs on this computer and V4L2 images
/// use this clock.
#[cfg(unix)]
pub fn now() -> Stamp {
    read(rustix::time::ClockId::Monotonic)
}

/// Current time of a clock that keeps counting while the computer is suspended. Use this clock only
/// to detect that the computer was suspended.
#[cfg(target_os = "linux")]
pub(crate) fn now_including_suspend() -> Stamp {
    read(rustix::time::ClockId::Boottime)
}

#[cfg(unix)]
fn read(clock: rustix::time::ClockId) -> Stamp {
    const NANOS_PER_SEC: i64 = 1_000_000_000;
    let now = rustix::time::clock_gettime(clock);
    Stamp(
        now.tv_sec
            .saturating_mul(NANOS_PER_SEC)
            .saturating_add(now.tv_nsec),
    )
}

/// CPU time that this process has used so far, or `None` on platforms where it is not implemented.
#[cfg(unix)]
pub fn process_cpu_time() -> Option<Duration> {
    let spent = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    let [secs, nanos] = [spent.tv_sec, spent.tv_nsec].map(|part| u64::try_from(part).unwrap_or(0));
    Some(Duration::from_secs(secs) + Duration::from_nanos(nanos))
}

/// CPU time that this process has used so far, or `None` on platforms where it is not implemented.
#[cfg(not(unix))]
pub fn process_cpu_time() -> Option<Duration> {
    None
}

/// Time since the first call. This clock is not shared with other programs.
#[cfg(not(unix))]
pub fn now() -> Stamp {
    static BEGAN: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    let began = BEGAN.get_or_init(std::time::Instant::now);
    Stamp(i64::try_from(began.elapsed().as_nanos()).unwrap_or(i64::MAX))
}
