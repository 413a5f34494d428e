//! Variants of the training options that benches compare.

use calibration::CameraRefinement;
use trainer::splat::SplatOptions;

/// A named change of the training options.
pub(crate) struct Variant {
    pub(crate) name: &'static str,
    pub(crate) change: fn(SplatOptions) -> SplatOptions,
}

/// No camera parameters are refined.
pub(crate) const CAMERAS_AS_GIVEN: Variant = Variant {
    name: "cameras as given",
    change: |options| SplatOptions {
        cameras: CameraRefinement::default(),
        align: CameraRefinement::default(),
        ..options
    },
};

impl Variant {
    /// The options `base` with this change.
    pub(crate) fn options(&self, base: &SplatOptions) -> SplatOptions {
        (self.change)(base.clone())
    }
}
