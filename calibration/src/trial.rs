//! Results of A/B trials. A result contains the gain of a change of a model on validation images,
//! and states whether the gain is significant.

use crate::ParamSet;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Minimum number of validation images for a trial. With fewer images, the standard error is too
/// uncertain.
pub const MIN_VALIDATION_IMAGES: usize = 4;
/// Minimum gain of camera parameters and of a color degree, dB. Smaller gains are not visible.
const MIN_GAIN_DB: f64 = 0.05;
/// Minimum gain in standard errors. About 2 % of useless changes exceed it by chance.
const MIN_STANDARD_ERRORS: f64 = 2.0;
/// Maximum loss from halving the number of splats, dB. It is larger than the other limits, because
/// splats take time and memory in every step.
const MAX_LOSS_OF_HALVING_DB: f64 = 0.1;

/// Selection of the camera parameters to optimize.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum CameraRefinement {
    /// Optimizes these parameters from the first step on.
    Always(ParamSet),
    /// Tries each of these sets in turn and keeps it if the gain is significant.
    Try(Vec<ParamSet>),
    /// Optimizes the first set from the first step on, and tries each of the others.
    AlwaysAndTry(ParamSet, Vec<ParamSet>),
    /// Optimizes the first set from the first step on, and also the second as soon as arriving
    /// keyframes show that it is needed.
    AlwaysAndWatch(ParamSet, ParamSet),
}

impl Default for CameraRefinement {
    fn default() -> Self {
        Self::Always(ParamSet::empty())
    }
}

impl CameraRefinement {
    /// The parameters that are optimized without a trial.
    pub fn always(&self) -> ParamSet {
        match self {
            Self::Always(params)
            | Self::AlwaysAndTry(params, _)
            | Self::AlwaysAndWatch(params, _) => *params,
            Self::Try(_) => ParamSet::empty(),
        }
    }

    /// The sets of parameters to try, in this order.
    pub fn candidates(&self) -> &[ParamSet] {
        match self {
            Self::Try(candidates) | Self::AlwaysAndTry(_, candidates) => candidates,
            Self::Always(_) | Self::AlwaysAndWatch(..) => &[],
        }
    }

    /// The parameters that are optimized once arriving keyframes show that they are needed.
    pub fn watched(&self) -> ParamSet {
        match self {
            Self::AlwaysAndWatch(_, params) => *params,
            Self::Always(_) | Self::Try(_) | Self::AlwaysAndTry(..) => ParamSet::empty(),
        }
    }
}

/// A change of the model that a trial tests.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Candidate {
    /// Optimizes these camera parameters in addition.
    Cameras(ParamSet),
    /// Removes the half of the splats with the smallest contribution.
    Halved {
        /// Splats before.
        from: u32,
        /// Splats after.
        to: u32,
    },
    /// Lowers the degree of the colors.
    ShDegree {
        /// Degree of spherical harmonics before.
        from: u32,
        /// Degree after.
        to: u32,
    },
}

impl Candidate {
    /// Minimum gain of an addition, or maximum loss of a reduction, dB.
    fn min_gain_db(self) -> f64 {
        match self {
            Self::Halved { .. } => MAX_LOSS_OF_HALVING_DB,
            Self::Cameras(_) | Self::ShDegree { .. } => MIN_GAIN_DB,
        }
    }

    /// Whether the change makes the model smaller.
    pub fn reduces_model(self) -> bool {
        !matches!(self, Self::Cameras(_))
    }
}

impl std::fmt::Display for Candidate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Cameras(params) => params.fmt(f),
            Self::Halved { from, to } => write!(f, "{to} of {from} splats"),
            Self::ShDegree { from, to } => write!(f, "colors of degree {to} instead of {from}"),
        }
    }
}

/// Mean of paired gains.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct MeanGain {
    pub(crate) mean: f64,
    /// Standard error of the mean.
    pub(crate) standard_error: f64,
}

impl MeanGain {
    pub(crate) fn of(gains: &[f64]) -> Self {
        let n = gains.len().max(1) as f64;
        let mean = gains.iter().sum::<f64>() / n;
        let variance =
            gains.iter().map(|gain| (gain - mean).powi(2)).sum::<f64>() / f64::max(n - 1.0, 1.0);
        Self {
            mean,
            standard_error: (variance / n).sqrt(),
        }
    }
}

/// Result of a trial.
///
/// ```
/// use calibration::{Candidate, ParamSet, Trial};
///
/// let poses = Candidate::Cameras(ParamSet::IMAGE_POSES);
/// assert!(Trial::of_gains(poses, &[0.4, 0.5, 0.3, 0.45]).kept);
/// assert!(!Trial::of_gains(poses, &[0.9, -0.8, 0.7, -0.6]).kept, "the images disagree");
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trial {
    /// The change that was tested.
    pub candidate: Candidate,
    /// Mean gain over the validation keyframes, dB.
    pub gain_db: f64,
    /// Standard error of the gain, dB.
    pub standard_error_db: f64,
    /// Number of validation keyframes.
    pub n_images: usize,
    /// Whether the change is kept.
    pub kept: bool,
    /// Mean gain over the validation keyframes of each camera, dB. Empty if it was not evaluated.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub gain_by_camera_db: BTreeMap<String, f64>,
    /// Standard error of these gains, dB. Cameras with fewer than [`MIN_VALIDATION_IMAGES`] are
    /// missing.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub standard_error_by_camera_db: BTreeMap<String, f64>,
}

impl Trial {
    /// Evaluates paired scores, dB.
    pub fn of(candidate: Candidate, baseline_db: &[f64], variant_db: &[f64]) -> Self {
        let gains_db = baseline_db
            .iter()
            .zip(variant_db)
            .map(|(baseline, variant)| variant - baseline);
        Self::of_gains(candidate, &gains_db.collect::<Vec<f64>>())
    }

    /// Evaluates the gains of single images, dB.
    pub fn of_gains(candidate: Candidate, gains_db: &[f64]) -> Self {
        let MeanGain {
            mean: gain_db,
            standard_error: standard_error_db,
        } = MeanGain::of(gains_db);
        let n_images = gains_db.len();
        let min_db = candidate.min_gain_db();
        // In case of doubt, neither additions nor reductions are accepted. Comparisons with NaN are
        // false, so a failed score accepts nothing.
        let is_significant = match candidate {
            Candidate::Halved { .. } | Candidate::ShDegree { .. } => {
                -gain_db + 0.5 * standard_error_db <= min_db
            }
            Candidate::Cameras(_) => {
                gain_db > f64::max(min_db, MIN_STANDARD_ERRORS * standard_error_db)
            }
        };
        // A single image has no standard error.
        let kept = n_images > 1 && is_significant;
        Self {
            candidate,
            gain_db,
            standard_error_db,
            n_images,
            kept,
            gain_by_camera_db: BTreeMap::new(),
            standard_error_by_camera_db: BTreeMap::new(),
        }
    }

    /// Adds the mean gain of each camera and its standard error from the gains of single images, dB.
    #[must_use]
    pub fn with_cameras<'a>(self, gains_db: impl Iterator<Item = (&'a str, f64)>) -> Self {
        let mut by_camera: BTreeMap<String, Vec<f64>> = BTreeMap::new();
        for (camera, gain_db) in gains_db {
            by_camera
                .entry(camera.to_owned())
                .or_default()
                .push(gain_db);
        }
        let mut trial = self;
        for (camera, gains_db) in by_camera {
            let gain = MeanGain::of(&gains_db);
            if gains_db.len() >= MIN_VALIDATION_IMAGES {
                trial
                    .standard_error_by_camera_db
                    .insert(camera.clone(), gain.standard_error);
            }
            trial.gain_by_camera_db.insert(camera, gain.mean);
        }
        trial
    }

    /// Whether the images of one camera gain significantly on their own. In a rig with several
    /// cameras, the mean over all images may hide that one camera gains nothing. `None` if the
    /// camera has too few validation images.
    pub fn is_significant_for(&self, camera: &str) -> Option<bool> {
        let gain_db = self.gain_by_camera_db.get(camera)?;
        let standard_error_db = self.standard_error_by_camera_db.get(camera)?;
        Some(*gain_db > MIN_STANDARD_ERRORS * standard_error_db)
    }

    /// Rejects the change if there are fewer than [`MIN_VALIDATION_IMAGES`].
    #[must_use]
    pub fn with_enough_images(self) -> Self {
        Self {
            kept: self.kept && self.n_images >= MIN_VALIDATION_IMAGES,
            ..self
        }
    }

    /// Report on the tested part of the model: the addition, or the part that the reduction would
    /// remove.
    pub fn report(&self) -> TrialReport {
        let (candidate, is_reduction) = match self.candidate {
            Candidate::Cameras(params) => (params.to_string(), false),
            Candidate::Halved { from, to } => (format!("{from} instead of {to} splats"), true),
            Candidate::ShDegree { from, to } => {
                (format!("colors of degree {from} instead of {to}"), true)
            }
        };
        TrialReport {
            candidate,
            gain_db: if is_reduction {
                -self.gain_db
            } else {
                self.gain_db
            },
            standard_error_db: self.standard_error_db,
            n_images: self.n_images,
            kept: self.kept != is_reduction,
        }
    }

    /// Logs the result.
    pub fn log_result(&self) {
        let verdict = match (self.candidate.reduces_model(), self.kept) {
            (false, true) => "accepted",
            (false, false) => "not significant",
            (true, true) => "sufficient",
            (true, false) => "not sufficient",
        };
        log::info!("{self}: {verdict}");
    }
}

impl std::fmt::Display for Trial {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            candidate,
            gain_db,
            standard_error_db,
            n_images,
            ..
        } = self;
        write!(
            f,
            "{candidate}: {gain_db:+.2} dB on {n_images} validation images (standard error {standard_error_db:.2})"
        )
    }
}

/// Result of a trial on validation images, for reports.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrialReport {
    /// Description of the tested part of the model: the addition, or the part that the reduction
    /// would remove.
    pub candidate: String,
    /// Mean PSNR with that part minus mean PSNR without it, dB.
    pub gain_db: f64,
    /// Standard error of the mean, dB.
    pub standard_error_db: f64,
    /// Number of validation images.
    pub n_images: usize,
    /// Whether that part was kept.
    pub kept: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    const POSES: Candidate = Candidate::Cameras(ParamSet::EXTRINSICS);

    /// The trial of two cameras with these gains of their images.
    fn trial(moving_db: &[f64], fixed_db: &[f64]) -> Trial {
        let all: Vec<f64> = moving_db.iter().chain(fixed_db).copied().collect();
        let moving = moving_db.iter().map(|gain_db| ("moving", *gain_db));
        let fixed = fixed_db.iter().map(|gain_db| ("fixed", *gain_db));
        Trial::of_gains(POSES, &all).with_cameras(moving.chain(fixed))
    }

    #[test]
    fn a_camera_must_gain_on_its_own() {
        let gains_db = [0.9, 1.1, 1.0, 0.8, 1.2];
        let noise_db = [0.4, -0.5, 0.3, -0.3, 0.2];
        let both = trial(&gains_db, &noise_db);
        assert!(both.kept, "the mean over all images is significant: {both}");
        assert_eq!(both.is_significant_for("moving"), Some(true));
        assert_eq!(both.is_significant_for("fixed"), Some(false));
        assert_eq!(both.is_significant_for("absent"), None);
        let failed = trial(&gains_db, &[f64::NAN; 5]);
        assert_eq!(failed.is_significant_for("fixed"), Some(false));
        let few = trial(&gains_db, &noise_db[..3]);
        assert_eq!(few.is_significant_for("fixed"), None, "too few images");
    }

    #[test]
    fn a_gain_within_twice_its_standard_error_is_rejected() {
        // The mean is 0.12 dB, the standard error 0.13 dB.
        let noisy = trial(&[0.5, -0.2, 0.4, -0.3, 0.2, 0.1], &[]);
        assert!(!noisy.kept && noisy.gain_db > MIN_GAIN_DB, "{noisy}");
        let steady = trial(&[0.14, 0.10, 0.12, 0.13, 0.11, 0.12], &[]);
        assert!(steady.kept, "{steady}");
    }
}
