//! Targets whose pose is ambiguous.

use targets::TargetSpec;

/// A warning if the pose of a target is ambiguous.
pub(crate) fn symmetry_warning(target: &TargetSpec) -> Option<String> {
    let turn = match target.symmetry().len() {
        0 | 1 => return None,
        2 => "half a turn",
        _ => "a quarter turn",
    };
    Some(format!(
        "{target} looks the same after {turn}, so a single image does not show how it is rotated; for hand-eye calibration, use a target whose orientation is unique, such as a chessboard with an even and an odd number of inner corners (9x6) or a ChArUco board"
    ))
}
