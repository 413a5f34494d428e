//! Checks the clock from which all stamps come.

use super::Finding;
use std::path::Path;
use std::time::{Duration, Instant};

/// Maximum step of the clock. It must be short compared with the readout time of an image row, tens
/// of microseconds.
const MAX_CLOCK_STEP: Duration = Duration::from_micros(1);

/// Measures the smallest step of the monotonic clock.
pub(super) fn clock() -> Finding {
    let mut min_step = Duration::MAX;
    for _ in 0..1000 {
        let start = Instant::now();
        let step = loop {
            let step = start.elapsed();
            if !step.is_zero() {
                break step;
            }
        };
        min_step = min_step.min(step);
    }
    let message = format!("monotonic clock, steps of {min_step:?}");
    if min_step <= MAX_CLOCK_STEP {
        Finding::ok("clock", message)
    } else {
        Finding::warn(
            "clock",
            message,
            "stamps are equally coarse: use another clock source, see below",
        )
    }
}

/// Checks that the kernel uses a fast clock source.
pub(super) fn clock_source(sys: &Path) -> Finding {
    let folder = sys.join("devices/system/clocksource/clocksource0");
    let Ok(current) = std::fs::read_to_string(folder.join("current_clocksource")) else {
        return Finding::ok("clock source", "not reported by the kernel");
    };
    let current = current.trim();
    if matches!(current, "hpet" | "acpi_pm" | "pit" | "jiffies") {
        let remedy = format!(
            "echo tsc | sudo tee {}",
            folder.join("current_clocksource").display()
        );
        return Finding::warn("clock source", format!("{current}: slow to read"), remedy);
    }
    Finding::ok("clock source", current)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;
    use crate::doctor::testing::folder_with;

    #[test]
    fn slow_clock_source_is_reported() {
        let path = "devices/system/clocksource/clocksource0/current_clocksource";
        assert_eq!(
            clock_source(folder_with(path, "hpet\n").path()).verdict,
            Verdict::Warn
        );
        assert_eq!(
            clock_source(folder_with(path, "tsc\n").path()).verdict,
            Verdict::Ok
        );
    }
}
