//! Memory of this computer.

/// Memory that programs can still use, bytes. It includes free swap space. `None` if the system
/// does not report it.
pub(crate) fn available_bytes() -> Option<u64> {
    available_in(&std::fs::read_to_string("/proc/meminfo").ok()?)
}

fn available_in(meminfo: &str) -> Option<u64> {
    let kib = |key: &str| -> Option<u64> {
        let rest = meminfo.lines().find_map(|line| line.strip_prefix(key))?;
        rest.split_whitespace().next()?.parse().ok()
    };
    // A system without swap has no line `SwapFree`, but every Linux since 3.14 has `MemAvailable`.
    let available_kib = kib("MemAvailable:")?.saturating_add(kib("SwapFree:").unwrap_or(0));
    Some(available_kib.saturating_mul(1024))
}

#[cfg(test)]
mod tests {
    use super::available_in;

    #[test]
    fn swap_counts_as_available() {
        let meminfo =
            "MemTotal:  8000 kB\nMemAvailable:  3000 kB\nSwapTotal:  70 kB\nSwapFree:  7 kB\n";
        assert_eq!(available_in(meminfo), Some(3007 * 1024));
        assert_eq!(available_in("MemAvailable:  3000 kB\n"), Some(3000 * 1024));
        assert_eq!(available_in("MemTotal:  8000000 kB\n"), None);
    }
}
