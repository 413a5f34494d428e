//! WGSL that kernels of this crate and of others import by name.

use crate::Source;

/// Index of a workgroup in a dispatch that is folded onto two axes, as [`crate::Passes`] folds it.
pub const FOLDED: Source = Source {
    name: "folded",
    text: include_str!("folded.wgsl"),
};
/// Sums within a workgroup of 256 lanes.
pub const SCAN: Source = Source {
    name: "scan",
    text: include_str!("scan.wgsl"),
};
