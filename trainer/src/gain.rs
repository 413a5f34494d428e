//! What a part of a model brings on images held back, and whether that is more than chance.

/// Less is not worth having, dB.
pub(crate) const MIN_GAIN_DB: f64 = 0.05;
/// Standard errors that a gain must exceed.
const MIN_STANDARD_ERRORS: f64 = 2.0;

/// The gain on the same images with something and without.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Gain {
    pub(crate) mean_db: f64,
    pub(crate) standard_error_db: f64,
    pub(crate) n_images: usize,
}

impl Gain {
    /// Of what each image gains, dB.
    pub(crate) fn of(gains_db: &[f64]) -> Self {
        let n = gains_db.len().max(1) as f64;
        let mean_db = gains_db.iter().sum::<f64>() / n;
        let variance = gains_db.iter().map(|gain| (gain - mean_db).powi(2)).sum::<f64>() / f64::max(n - 1.0, 1.0);
        Self { mean_db, standard_error_db: (variance / n).sqrt(), n_images: gains_db.len() }
    }

    /// Whether it is at least this large, and not by chance.
    pub(crate) fn is_significant(&self, min_db: f64) -> bool {
        self.mean_db > f64::max(min_db, MIN_STANDARD_ERRORS * self.standard_error_db)
    }
}
