//! The history of a run that its page shows, for runs that continue it.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Scores and rejected images of a run so far.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunHistory {
    /// Training time in seconds and mean PSNR of the test images in dB, in order. All numbers are
    /// finite.
    psnr: Vec<(f64, f64)>,
    /// Number of images that did not become keyframes, by reason.
    rejected: BTreeMap<String, u64>,
}

impl RunHistory {
    /// The history with these scores and numbers of rejected images. Scores that are not finite are
    /// left out, because JSON cannot express them. An example is the score of a perfect picture.
    #[must_use]
    pub fn new(psnr: &[(f64, f64)], rejected: BTreeMap<String, u64>) -> Self {
        let is_finite = |(secs, psnr): &&(f64, f64)| secs.is_finite() && psnr.is_finite();
        Self {
            psnr: psnr.iter().filter(is_finite).copied().collect(),
            rejected,
        }
    }

    /// Training time in seconds and mean PSNR of the test images in dB, in order.
    #[must_use]
    pub fn psnr(&self) -> &[(f64, f64)] {
        &self.psnr
    }

    /// Number of images that did not become keyframes, by reason.
    #[must_use]
    pub fn rejected(&self) -> &BTreeMap<String, u64> {
        &self.rejected
    }

    /// Whether there is nothing to keep.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.psnr.is_empty() && self.rejected.is_empty()
    }
}
