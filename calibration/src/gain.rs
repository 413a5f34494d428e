//! Gain of a model variant on validation images, and its statistical significance.

/// Minimum gain for accepting a variant, dB.
pub const MIN_GAIN_DB: f64 = 0.05;
/// Minimum gain in standard errors.
const MIN_STANDARD_ERRORS: f64 = 2.0;

/// Mean gain of a variant over the baseline, scored on the same images.
///
/// ```
/// use calibration::{Gain, MIN_GAIN_DB};
///
/// let gain = Gain::of(&[0.4, 0.5, 0.3, 0.45]);
/// assert!(gain.is_significant(MIN_GAIN_DB));
/// assert!(!Gain::of(&[0.9, -0.8, 0.7, -0.6]).is_significant(MIN_GAIN_DB), "the images disagree");
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gain {
    /// Mean gain, dB.
    pub mean_db: f64,
    /// Standard error of the mean, dB.
    pub standard_error_db: f64,
    /// Number of images.
    pub n_images: usize,
}

impl Gain {
    /// Computes the mean gain from the gains of single images, dB.
    pub fn of(gains_db: &[f64]) -> Self {
        let n = gains_db.len().max(1) as f64;
        let mean_db = gains_db.iter().sum::<f64>() / n;
        let variance = gains_db.iter().map(|gain| (gain - mean_db).powi(2)).sum::<f64>() / f64::max(n - 1.0, 1.0);
        Self { mean_db, standard_error_db: (variance / n).sqrt(), n_images: gains_db.len() }
    }

    /// Whether the gain exceeds both `min_db` and two standard errors.
    pub fn is_significant(&self, min_db: f64) -> bool {
        self.mean_db > f64::max(min_db, MIN_STANDARD_ERRORS * self.standard_error_db)
    }
}
