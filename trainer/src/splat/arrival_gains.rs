//! Detects that exposure or white balance changes during a live run.
//!
//! Each training keyframe is compared with a rendered picture when it arrives, before the model is
//! trained on it. The comparison is made without gains, and with the gains of the previous keyframe
//! of its camera. If the camera changes its exposure, abruptly or slowly, the previous gains
//! predict the next keyframes better than no gains.

use calibration::{Candidate, MIN_VALIDATION_IMAGES, ParamSet, Trial};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};

/// Number of latest keyframes that a decision is based on. With more keyframes, a change is
/// detected later. With fewer keyframes, a single outlier could decide.
const MAX_SCORED: usize = 8;
/// Minimum mean gain, dB. Smaller gains may come from areas that the model does not show yet.
const MIN_MEAN_GAIN_DB: f64 = 1.0;
/// Minimum PSNR with the best gains, dB. If it is lower, the picture differs in more than
/// brightness. A higher minimum ignores more keyframes, especially early in a run, when the model
/// is still coarse.
const MIN_PSNR_DB: f64 = 18.0;

/// Scores of the latest keyframes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ArrivalGains {
    /// Logarithms of the red, green and blue gains of the last keyframe, by camera.
    last_log_gains: BTreeMap<String, [f64; 3]>,
    /// Difference of PSNR with and without the gains of the previous keyframe, dB.
    differences_db: VecDeque<f64>,
}

impl ArrivalGains {
    /// Adds a keyframe. Returns the result if the latest keyframes show that gains are needed.
    ///
    /// * `log_gains`: logarithms of the gains that best match the picture to the keyframe.
    /// * `psnr`: returns the PSNR of the picture scaled by gains, dB. `None` if all pixels are
    ///   masked.
    pub(crate) fn add(
        &mut self,
        camera: &str,
        log_gains: [f64; 3],
        psnr: impl Fn([f64; 3]) -> Option<f64>,
    ) -> Option<Trial> {
        // Gains that were fitted to different content do not depend on the exposure, so they must
        // not predict the next keyframe either.
        if psnr(log_gains.map(f64::exp))? < MIN_PSNR_DB {
            return None;
        }
        // Cameras adapt their exposure independently, so the gains of a camera predict only its own
        // keyframes. The first keyframe of a camera has no prediction.
        let previous = self.last_log_gains.insert(camera.to_owned(), log_gains)?;
        self.differences_db
            .push_back(psnr(previous.map(f64::exp))? - psnr([1.0; 3])?);
        if self.differences_db.len() > MAX_SCORED {
            self.differences_db.pop_front();
        }
        let trial = Trial::of_gains(
            Candidate::Cameras(ParamSet::IMAGE_GAINS),
            self.differences_db.make_contiguous(),
        );
        // A wrong decision cannot be reverted in a live run, so significance alone is not enough.
        let is_clear = trial.n_images >= MIN_VALIDATION_IMAGES && trial.gain_db >= MIN_MEAN_GAIN_DB;
        (trial.kept && is_clear).then_some(trial)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Number of keyframes up to the decision, if the keyframes have these log gains and the model
    /// has no gains. The picture matches up to 30 dB.
    fn n_until_decision(log_gains: impl IntoIterator<Item = f64>) -> Option<usize> {
        let mut arrivals = ArrivalGains::default();
        let is_decided = |log_gain: f64| {
            let psnr = |gains: [f64; 3]| {
                let error = gains[0].ln() - log_gain;
                Some(-10.0 * (1e-3 + 0.25 * error * error).log10())
            };
            arrivals.add("wrist", [log_gain; 3], psnr).is_some()
        };
        log_gains
            .into_iter()
            .map(is_decided)
            .position(|decided| decided)
            .map(|ix| ix + 1)
    }

    #[test]
    fn steps_and_drifts_of_exposure_are_detected() {
        let step = |ev: f64| (0..40).map(move |ix| if ix < 20 { 0.0 } else { ev * 2.0_f64.ln() });
        let detected = n_until_decision(step(1.0)).expect("a step of 1 EV is detected");
        assert!((22..=26).contains(&detected), "{detected}");
        assert!(n_until_decision(step(0.2)).is_some());
        assert!(n_until_decision((0..40).map(|ix| 0.02 * f64::from(ix))).is_some());
    }

    #[test]
    fn noise_and_single_outliers_are_no_change_of_exposure() {
        let noise =
            |ix: u32| 0.02 * f64::from(ix.wrapping_mul(2_654_435_761) >> 16) / 65536.0 - 0.01;
        assert_eq!(n_until_decision((0..400).map(noise)), None);
        assert_eq!(
            n_until_decision((0..40).map(|ix| if ix == 20 { 0.7 } else { 0.0 })),
            None
        );
    }

    #[test]
    fn pictures_that_differ_in_more_than_brightness_are_not_scored() {
        let mut arrivals = ArrivalGains::default();
        let is_any = (0..20).any(|_| {
            arrivals
                .add("wrist", [0.7; 3], |gains| Some(10.0 + gains[0]))
                .is_some()
        });
        assert!(!is_any && arrivals == ArrivalGains::default());
    }
}
