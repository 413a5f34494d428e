//! Lists the CAN interfaces of this computer.

use std::path::Path;

/// Sorted names of the CAN interfaces in a folder such as `/sys`, including virtual ones.
pub fn interfaces(sys: &Path) -> Vec<String> {
    let net = sys.join("class/net");
    // ARPHRD_CAN of `linux/if_arp.h`.
    let is_can = |name: &String| {
        std::fs::read_to_string(net.join(name).join("type")).is_ok_and(|kind| kind.trim() == "280")
    };
    // An unreadable folder counts as empty: a container may hide it, and the caller then reports
    // that there is no interface.
    let all = std::fs::read_dir(&net).into_iter().flatten();
    let mut names: Vec<String> = all
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .filter(is_can)
        .collect();
    names.sort();
    names
}
