//! Estimates the number of dropped images from the arrival times of the received images.

use kinematics::Stamp;

/// If an image is late by more than this many periods, images were dropped before it. Smaller
/// delays are jitter. With a smaller value, jitter would count as lost images; with a larger value,
/// losses would be missed.
const LATE_PERIODS: f64 = 0.75;
/// Fraction of the delay of an image by which the next due time is shifted. Without this
/// correction, due times would drift away from the images, because the actual frame rate differs
/// from the nominal rate. The value 0.05 averages over about 20 images. With a larger value, a
/// single late image would shift the due time by a larger amount.
const DRIFT_GAIN: f64 = 0.05;

/// Estimates when the images of a camera are due. Images may be late, but never early.
#[derive(Clone, Copy, Debug)]
pub(crate) struct GapEstimator {
    period_secs: f64,
    due: Option<Stamp>,
}

impl GapEstimator {
    pub(crate) fn new(rate_hz: f64) -> Self {
        Self {
            period_secs: 1.0 / rate_hz,
            due: None,
        }
    }

    /// Estimated number of images that were dropped before an image with this stamp.
    pub(crate) fn n_lost_before(&mut self, stamp: Stamp) -> u64 {
        let Some(due) = self.due else {
            self.due = Some(stamp.plus_secs(self.period_secs));
            return 0;
        };
        let late_periods = stamp.secs_since(due) / self.period_secs;
        let lost_periods = (late_periods - LATE_PERIODS).ceil().max(0.0);
        let delayed_secs = (late_periods - lost_periods) * self.period_secs;
        // Images are never early. If an image arrives before its due time, the due time is too
        // late: earlier images were delayed, or the actual frame rate is higher than the nominal
        // rate. The whole difference is therefore corrected.
        let correction_secs = if delayed_secs < 0.0 {
            delayed_secs
        } else {
            DRIFT_GAIN * delayed_secs
        };
        self.due = Some(due.plus_secs((1.0 + lost_periods) * self.period_secs + correction_secs));
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "not negative; the cast saturates"
        )]
        let n_lost = lost_periods as u64;
        n_lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Estimated number of dropped images for the given stamps in milliseconds.
    fn n_lost(rate_hz: f64, millis: impl IntoIterator<Item = f64>) -> u64 {
        let mut gap_estimator = GapEstimator::new(rate_hz);
        millis
            .into_iter()
            .map(|millis| gap_estimator.n_lost_before(Stamp::from_secs(millis * 1e-3)))
            .sum()
    }

    #[test]
    fn gaps_are_counted_but_jitter_is_not() {
        assert_eq!(n_lost(25.0, [0.0, 40.0, 80.0, 160.0, 200.0]), 1);
        assert_eq!(n_lost(25.0, [0.0, 40.0, 1080.0, 1120.0]), 25);
        // Images are delayed one after another, and then arrive on time again.
        assert_eq!(n_lost(25.0, [0.0, 65.0, 105.0, 122.0, 160.0]), 0);
        let jitter = |ix: u32| f64::from(ix) * 40.0 + f64::from(ix * ix % 27);
        assert_eq!(n_lost(25.0, (0..1000).map(jitter)), 0);
        assert_eq!(
            n_lost(25.0, (0..1000).filter(|ix| ix % 7 != 3).map(jitter)),
            143
        );
    }

    #[test]
    fn rate_mismatch_is_not_counted_as_loss() {
        for rate_hz in [29.9, 29.97, 30.1] {
            assert_eq!(
                n_lost(30.0, (0..10_000).map(|ix| f64::from(ix) * 1e3 / rate_hz)),
                0,
                "{rate_hz}"
            );
        }
    }
}
