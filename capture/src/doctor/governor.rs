//! Checks the frequency governor of the CPU.

use super::Finding;
use std::path::Path;

/// Checks the CPU frequency governor, if the machine has one.
pub(super) fn governor(sys: &Path) -> Option<Finding> {
    let governor =
        std::fs::read_to_string(sys.join("devices/system/cpu/cpu0/cpufreq/scaling_governor"))
            .ok()?;
    let governor = governor.trim();
    Some(match governor {
        "performance" => Finding::ok("governor", governor),
        _ => Finding::warn(
            "governor",
            format!("{governor}: latencies vary"),
            "sudo cpupower frequency-set -g performance",
        ),
    })
}
