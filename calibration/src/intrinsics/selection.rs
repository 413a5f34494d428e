//! Selection of the lens model by cross-validation over images.

use super::board_pose;
use super::bundle::{self, Bundle};
use super::coefficients::{Coefficients, Family};
use super::robust::{Kept, RobustFit};
use crate::BoardPoint;
use crate::least_squares::Loss;
use crate::trial::MeanGain;
use kinematics::Intrinsics;

/// Result of the comparison of two lens models on held-out corners.
#[derive(Clone, Debug, PartialEq)]
pub struct LensTrial {
    /// The simpler model and its estimated coefficients, such as `brown_conrady k1`.
    pub baseline: String,
    /// The model that was tested against it.
    pub variant: String,
    /// Decrease of the error on held-out corners, dB. It is 20 times the decimal logarithm of the
    /// ratio of the root mean squares, averaged over the images.
    pub gain_db: f64,
    /// Standard error of the gain, dB.
    pub standard_error_db: f64,
    /// Number of images.
    pub n_images: usize,
    /// Whether the variant replaces the baseline. This is the case if the gain is significant, or
    /// if the variant is simpler and not worse.
    pub kept: bool,
}

/// Minimum gain of additional coefficients, dB. Smaller gains do not change an image by a visible
/// amount.
const MIN_GAIN_DB: f64 = 0.05;
/// Minimum gain in standard errors. About 2 % of useless coefficients exceed it by chance.
const MIN_STANDARD_ERRORS: f64 = 2.0;

/// A model with its held-out error in each image.
struct Scored {
    coefficients: Coefficients,
    bundle: Bundle,
    errors_px: Vec<f64>,
}

/// Adds coefficients one group at a time, and keeps the groups that lower the error on held-out
/// corners significantly. Returns the selected model with its parameters, and all comparisons.
///
/// The selection of Brown-Conrady coefficients starts with a pinhole. It adds k1, then k2, then p1
/// and p2, then k3. If k3 was needed, it adds the rational terms. If k1 alone is not significant,
/// k1 and k2 are tried together. Finally, the result is compared with Kannala-Brandt. Since
/// Kannala-Brandt has fewer coefficients than a rational model, it replaces that model even if both
/// are equally good.
pub(super) fn select(
    kept: &Kept,
    near_pinhole: Option<&RobustFit>,
    fisheye: Option<&RobustFit>,
) -> Option<(Coefficients, Bundle, Vec<LensTrial>)> {
    const GROUPS: [[bool; 5]; 5] = [
        [true, false, false, false, false],
        [true, true, false, false, false],
        [false, false, true, true, false],
        [true, true, false, false, true],
        [true, true, true, true, true],
    ];
    let mut trials = Vec::new();
    let polynomial = near_pinhole.and_then(|fit| start_of(kept, fit));
    let mut best = polynomial
        .as_ref()
        .and_then(|start| score(kept, start, Coefficients::PINHOLE));
    // All comparisons start from this model.
    if best.is_none() {
        // A pinhole may not be able to image all points.
        best = polynomial
            .as_ref()
            .and_then(|start| score(kept, start, Coefficients::BROWN_CONRADY));
    }
    // Whether the last coefficient of the polynomial was tested and is not needed.
    let mut is_sufficient = false;
    let mut tested: Option<Coefficients> = None;
    for group in GROUPS.map(Some).into_iter().chain([None]) {
        let (Some(baseline), Some(start)) = (&best, &polynomial) else {
            break;
        };
        let coefficients = match group {
            Some(group) => baseline.coefficients.with(group),
            None => baseline.coefficients.rational(),
        };
        let is_new = coefficients != baseline.coefficients && tested != Some(coefficients);
        if !is_new || (group.is_none() && is_sufficient) {
            continue;
        }
        // The rational terms start from the polynomial's solution.
        let start = if group.is_some() {
            start
        } else {
            &baseline.bundle
        };
        if let Some(variant) = score(kept, start, coefficients) {
            let trial = compare(baseline, &variant);
            is_sufficient = !trial.kept && group.is_some_and(|[.., k3]| k3);
            tested = Some(coefficients);
            if trial.kept {
                best = Some(variant);
            }
            trials.push(trial);
        }
    }
    if let Some(variant) = fisheye
        .and_then(|fit| start_of(kept, fit))
        .and_then(|start| score(kept, &start, Coefficients::KANNALA_BRANDT))
    {
        let mut trial = best.as_ref().map(|baseline| compare(baseline, &variant));
        if let (Some(trial), Some(baseline)) = (&mut trial, &best) {
            // A fisheye lens with four coefficients is simpler than a rational model.
            trial.kept |= baseline.coefficients.family == Family::RationalBrownConrady
                && trial.gain_db >= 0.0;
        }
        if trial.as_ref().is_none_or(|trial| trial.kept) {
            best = Some(variant);
        }
        trials.extend(trial);
    }
    best.map(|best| (best.coefficients, best.bundle, trials))
}

/// Parameters of a fit for the images in use, as a start for other fits. `None` if the pose of an
/// image cannot be estimated.
fn start_of(kept: &Kept, fit: &RobustFit) -> Option<Bundle> {
    let position = |image_ix: &usize| fit.kept.image_ixs.iter().position(|ix| ix == image_ix);
    let positions = kept
        .image_ixs
        .iter()
        .map(position)
        .collect::<Option<Vec<usize>>>();
    if let Some(positions) = positions {
        return Some(fit.fit.state.with_images(positions.into_iter()));
    }
    // The fit rejected an image that the reference keeps. The pose of this image is estimated with
    // the lens of the fit, so that both models are compared on the same images.
    let intrinsics = &fit.fit.state.intrinsics;
    let pose = |points: &Vec<BoardPoint>| {
        Some(board_pose::board_pose(intrinsics, points)?.camera_from_board)
    };
    let poses = kept.points.iter().map(pose).collect::<Option<Vec<_>>>()?;
    Some(Bundle {
        intrinsics: intrinsics.clone(),
        poses,
    })
}

/// Compares two models by their held-out errors.
fn compare(baseline: &Scored, variant: &Scored) -> LensTrial {
    // The errors are compared image by image, because images differ in blur and distance much more
    // than models differ.
    let gain_db = |(baseline, variant): (&f64, &f64)| 20.0 * (baseline / variant).log10();
    let gains_db: Vec<f64> = baseline
        .errors_px
        .iter()
        .zip(&variant.errors_px)
        .map(gain_db)
        .collect();
    let gain = MeanGain::of(&gains_db);
    LensTrial {
        baseline: baseline.coefficients.to_string(),
        variant: variant.coefficients.to_string(),
        gain_db: gain.mean,
        standard_error_db: gain.standard_error,
        n_images: gains_db.len(),
        kept: gains_db.len() > 1
            && gain.mean > f64::max(MIN_GAIN_DB, MIN_STANDARD_ERRORS * gain.standard_error),
    }
}

/// Fits a model to all images, and computes its error in each image when that image is held out.
///
/// The intrinsics are fitted to the other folds. The pose of the held-out image is fitted to every
/// second corner and evaluated on the other corners. Then the two sets of corners swap roles.
fn score(kept: &Kept, start: &Bundle, coefficients: Coefficients) -> Option<Scored> {
    // Each fold requires a fit. With five folds, a fit uses 80 % of the images.
    const MAX_FOLDS: usize = 5;
    // Models differ by far more than the error that remains with this tolerance.
    const TOLERANCE: f64 = 1e-7;
    let images = kept.images();
    let start = Bundle {
        intrinsics: coefficients.applied_to(&start.intrinsics),
        ..start.clone()
    };
    let bundle = bundle::refine(&images, start, coefficients, Loss::Squared, TOLERANCE)
        .ok()?
        .state;
    let n_folds = images.len().min(MAX_FOLDS);
    let mut errors_px = vec![0.0; images.len()];
    for fold in 0..n_folds {
        let training = (0..images.len()).filter(|ix| ix % n_folds != fold);
        let training_images: Vec<&[BoardPoint]> = training.clone().map(|ix| images[ix]).collect();
        let training_bundle = bundle.with_images(training);
        let fit = bundle::refine(
            &training_images,
            training_bundle,
            coefficients,
            Loss::Squared,
            TOLERANCE,
        )
        .ok()?;
        for ix in (fold..images.len()).step_by(n_folds) {
            errors_px[ix] =
                held_out_error_px(&fit.state.intrinsics, images[ix], &bundle.poses[ix])?;
        }
    }
    Some(Scored {
        coefficients,
        bundle,
        errors_px,
    })
}

/// Root mean square error on corners that did not determine the pose, limited below by the noise of
/// corner detectors.
fn held_out_error_px(
    intrinsics: &Intrinsics,
    points: &[BoardPoint],
    camera_from_board: &kinematics::Transform,
) -> Option<f64> {
    let halves = [0, 1].map(|parity| -> Vec<BoardPoint> {
        points.iter().skip(parity).step_by(2).copied().collect()
    });
    let mut squares = 0.0;
    for (training, held_out) in [(&halves[0], &halves[1]), (&halves[1], &halves[0])] {
        let pose = board_pose::refine(intrinsics, training, *camera_from_board)?;
        let bundle = Bundle {
            intrinsics: intrinsics.clone(),
            poses: vec![pose.camera_from_board],
        };
        squares += bundle
            .errors_px(0, held_out)
            .into_iter()
            .map(|error| error * error)
            .sum::<f64>();
    }
    let rms_px = (squares / points.len() as f64).sqrt();
    rms_px
        .is_finite()
        .then_some(rms_px.max(bundle::MIN_NOISE_PX))
}
