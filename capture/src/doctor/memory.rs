//! Checks the available memory.

use super::{Finding, field};
use std::path::Path;

/// This memory is enough for a model of a million splats with its keyframes and the optimizer
/// state. With less memory, a run may have to swap, or may fail when its store of keyframes is
/// full.
const SUFFICIENT_MEMORY_KIB: u64 = 4 << 20;

/// Checks that the memory is sufficient for a run.
pub(super) fn memory(proc: &Path) -> Finding {
    let Some(available_kib) =
        field(&proc.join("meminfo"), "MemAvailable:").and_then(|kib| kib.parse::<u64>().ok())
    else {
        return Finding::ok("memory", "not reported by the kernel");
    };
    let message = format!("{} MiB available", available_kib >> 10);
    if available_kib >= SUFFICIENT_MEMORY_KIB {
        Finding::ok("memory", message)
    } else {
        Finding::warn(
            "memory",
            message,
            "close other programs, or lower max_keyframes and max_splats in the rig file",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;
    use crate::doctor::testing::folder_with;

    #[test]
    fn low_memory_is_reported() {
        let low = folder_with(
            "meminfo",
            "MemTotal:  8000000 kB\nMemAvailable:  1048576 kB\n",
        );
        assert_eq!(memory(low.path()).verdict, Verdict::Warn);
        assert!(memory(low.path()).message.contains("1024 MiB"));
        let plenty = folder_with(
            "meminfo",
            "MemTotal:  8000000 kB\nMemAvailable:  7000000 kB\n",
        );
        assert_eq!(memory(plenty.path()).verdict, Verdict::Ok);
    }
}
