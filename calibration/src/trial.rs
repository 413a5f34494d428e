//! Results of A/B trials: whether a change of a model is a significant gain on validation images.

use crate::ParamSet;
use crate::gain::{Gain, MIN_GAIN_DB};
use serde::{Deserialize, Serialize};

/// Minimum gain that justifies twice as many splats, dB.
const MIN_GAIN_OF_DOUBLING_DB: f64 = 0.1;

/// Selection of the camera parameters to optimize.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum CameraRefinement {
    /// Optimizes these parameters from the first step on.
    Always(ParamSet),
    /// Tries each of these sets in turn and keeps it if the gain is significant.
    Try(Vec<ParamSet>),
}

impl Default for CameraRefinement {
    fn default() -> Self {
        Self::Always(ParamSet::empty())
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
            Self::Halved { .. } => MIN_GAIN_OF_DOUBLING_DB,
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

/// Result of a trial.
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
}

impl Trial {
    /// Evaluates paired scores, dB.
    pub fn of(candidate: Candidate, baseline_db: &[f64], variant_db: &[f64]) -> Self {
        let gains: Vec<f64> =
            baseline_db.iter().zip(variant_db).map(|(baseline, variant)| variant - baseline).collect();
        let gain = Gain::of(&gains);
        let min_db = candidate.min_gain_db();
        let Gain { mean_db: gain_db, standard_error_db, n_images } = gain;
        // In case of doubt, neither additions nor reductions are accepted.
        let is_significant = match candidate.reduces_model() {
            true => -gain_db + 0.5 * standard_error_db <= min_db,
            false => gain.is_significant(min_db),
        };
        Self { candidate, gain_db, standard_error_db, n_images, kept: n_images > 1 && is_significant }
    }

    /// Report on the tested part of the model: the addition, or the part that the reduction would remove.
    pub fn report(&self) -> TrialReport {
        let (candidate, is_reduction) = match self.candidate {
            Candidate::Cameras(params) => (params.to_string(), false),
            Candidate::Halved { from, to } => (format!("{from} instead of {to} splats"), true),
            Candidate::ShDegree { from, to } => (format!("colors of degree {from} instead of {to}"), true),
        };
        TrialReport {
            candidate,
            gain_db: if is_reduction { -self.gain_db } else { self.gain_db },
            standard_error_db: self.standard_error_db,
            n_images: self.n_images,
            kept: self.kept != is_reduction,
        }
    }

    /// Logs the result.
    pub fn log_result(&self) {
        let verdict = match (self.candidate, self.kept) {
            (Candidate::Cameras(_), true) => "accepted",
            (Candidate::Cameras(_), false) => "not significant",
            (Candidate::Halved { .. } | Candidate::ShDegree { .. }, true) => "sufficient",
            (Candidate::Halved { .. } | Candidate::ShDegree { .. }, false) => "not sufficient",
        };
        log::info!(
            "{}: {:+.2} dB on {} validation images (standard error {:.2}): {verdict}",
            self.candidate,
            self.gain_db,
            self.n_images,
            self.standard_error_db,
        );
    }
}

/// Result of a trial on validation images, for reports.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrialReport {
    /// Description of the tested part of the model: the addition, or the part that the reduction would remove.
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
