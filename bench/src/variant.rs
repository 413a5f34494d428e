//! Variants of the training options that benches compare.

use calibration::CameraRefinement;
use trainer::ModelOptions;

/// A named change of training options. It applies to one method with options `S`, or by default to
/// any method.
pub(crate) struct Variant<S = serde_json::Value> {
    pub(crate) name: &'static str,
    pub(crate) change: fn(&mut ModelOptions<S>),
}

impl<S: Clone> Variant<S> {
    /// No camera parameters are refined.
    pub(crate) const CAMERAS_AS_GIVEN: Self = Self {
        name: "cameras as given",
        change: |options| {
            options.common.cameras = CameraRefinement::default();
            options.common.align = CameraRefinement::default();
        },
    };

    /// The options `base` with this change applied.
    pub(crate) fn options(&self, base: &ModelOptions<S>) -> ModelOptions<S> {
        base.clone().with(self.change)
    }
}
