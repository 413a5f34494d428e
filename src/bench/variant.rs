//! Ways to train that are compared with each other.

use trainer::splat::{CameraRefinement, SplatOptions};

/// One of them.
pub(crate) struct Variant {
    pub(crate) name: &'static str,
    pub(crate) change: fn(SplatOptions) -> SplatOptions,
}

/// Nothing is looked for about cameras.
pub(crate) const CAMERAS_AS_GIVEN: Variant = Variant {
    name: "cameras as given",
    change: |options| SplatOptions {
        cameras: CameraRefinement::default(),
        align: CameraRefinement::default(),
        ..options
    },
};

impl Variant {
    /// How it trains where `base` is asked for.
    pub(crate) fn options(&self, base: &SplatOptions) -> SplatOptions {
        (self.change)(base.clone())
    }
}
