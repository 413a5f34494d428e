//! Fit of one lens model with rejection of inconsistent images and corners.

use super::board_pose::board_pose;
use super::bundle::{self, Bundle, MIN_NOISE_PX};
use super::coefficients::{Coefficients, Family};
use super::homography::{self, homography};
use super::initial::Start;
use crate::BoardPoint;
use crate::least_squares::{Fit, Loss};
use kinematics::{Intrinsics, Transform};
use nalgebra::{Matrix3, Vector2};
use numbers::quantile::median;
use numbers::random::Random;

/// Minimum number of corners that an image keeps. With fewer corners, its pose has too little
/// redundancy.
pub(super) const MIN_POINTS: usize = 6;
/// A corner is rejected if its error exceeds this multiple of the standard deviation of the other
/// corners. Only 1 in 10^8 normally distributed errors would exceed it, but errors of real corners
/// have longer tails.
const MAX_SIGMAS: f64 = 6.0;
/// An image is rejected if its median error exceeds this multiple of the median error of the other
/// images. Blurred images have larger errors, but still contribute.
const MAX_MEDIAN_RATIO: f64 = 6.0;
/// An image is rejected if more than this fraction of its corners is rejected. In that case, the
/// rejected corners may be the correct corners.
const MAX_OUTLIER_FRAC: f64 = 0.5;
/// The norm of a normal error has a Rayleigh distribution. This is the ratio of the median of the
/// norm to the standard deviation per axis.
const MEDIAN_PER_SIGMA: f64 = 1.177_410_022_515_474_7;
/// Tolerance of the fits that alternate with the search for outliers. It corresponds to a tenth of
/// a standard deviation of the parameters. The next constant is the tolerance of the last fit.
const ROUGH: f64 = 1e-5;
const EXACT: f64 = 1e-12;

/// A fit and the images and corners that it uses.
#[derive(Clone, Debug)]
pub(super) struct RobustFit {
    /// The covariance contains errors that the corners of an image share.
    pub(super) fit: Fit<Bundle>,
    pub(super) coefficients: Coefficients,
    pub(super) kept: Kept,
    /// Median over the images of the median error, pixels.
    pub(super) typical_px: f64,
}

impl RobustFit {
    /// Number of images with a median error up to a limit.
    pub(super) fn n_explained(&self, max_error_px: f64) -> usize {
        let errors =
            |(ix, points): (usize, &Vec<BoardPoint>)| median(&self.fit.state.errors_px(ix, points));
        let medians = self.kept.points.iter().enumerate().filter_map(errors);
        medians
            .filter(|median_px| *median_px <= max_error_px)
            .count()
    }
}

/// Images and corners in use.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Kept {
    /// Indices of the images in the input, in the order of the poses of a fit.
    pub(super) image_ixs: Vec<usize>,
    /// Their remaining points.
    pub(super) points: Vec<Vec<BoardPoint>>,
}

impl Kept {
    pub(super) fn images(&self) -> Vec<&[BoardPoint]> {
        self.points.iter().map(|points| &points[..]).collect()
    }

    fn n_points(&self) -> usize {
        self.points.iter().map(Vec::len).sum()
    }
}

/// Fits a lens model to all consistent images. `None` if there is no solution.
///
/// Corners are weighted by Huber's loss until the outliers are found. The last fit weights all
/// remaining corners equally, which is optimal for normal errors. A rejected image or corner
/// returns if a later fit agrees with it.
///
/// * `start_images`: the points for the initial values, which come from [`without_gross_errors`].
pub(super) fn fit(
    images: &[&[BoardPoint]],
    start_images: &[&[BoardPoint]],
    start: &Start,
    coefficients: Coefficients,
) -> Option<RobustFit> {
    /// Images with a larger initial error than this multiple of the median are left out of the
    /// first fit.
    const MAX_START_RATIO: f64 = 8.0;
    let max_error_px = MAX_START_RATIO * start.median_error_px();
    // A wrong pose in the first fit would distort the lens parameters. Images that are left out
    // here are checked again later.
    let image_ixs: Vec<usize> = (0..images.len())
        .filter(|ix| start.errors_px[*ix] <= max_error_px)
        .collect();
    let poses = image_ixs
        .iter()
        .map(|ix| start.poses[*ix])
        .collect::<Option<Vec<_>>>()?;
    let kept = Kept {
        points: image_ixs
            .iter()
            .map(|ix| start_images[*ix].to_vec())
            .collect(),
        image_ixs,
    };
    // The coefficients of the rational model are nearly redundant, so they start from the
    // coefficients of the polynomial.
    let first = if coefficients.family == Family::RationalBrownConrady {
        Coefficients::BROWN_CONRADY
    } else {
        coefficients
    };
    let bundle = Bundle {
        intrinsics: first.applied_to(&start.intrinsics),
        poses,
    };
    let bundle = huber(&kept, bundle, first)?;
    refit(images, kept, bundle, coefficients)
}

/// The points of each image that are consistent with one homography, up to a smooth distortion. For
/// most images, these are all points.
///
/// Half of the points may be wrong, because the homography with the least median of errors over
/// random samples is used (Rousseeuw 1984).
pub(super) fn without_gross_errors(images: &[&[BoardPoint]]) -> Vec<Vec<BoardPoint>> {
    images
        .iter()
        .map(|points| consistent_points(points))
        .collect()
}

fn consistent_points(points: &[BoardPoint]) -> Vec<BoardPoint> {
    /// Samples of four points. With 45 % wrong points, at least one of the samples contains no
    /// wrong point with a probability of 99.9 %.
    const N_SAMPLES: usize = 75;
    /// Points with errors up to this multiple of the median error are kept. Deviations due to
    /// distortion are smaller.
    const MAX_MEDIAN_RATIO: f64 = 8.0;
    let pairs: Vec<_> = points
        .iter()
        .map(|point| (point.point_in_board.xy(), Vector2::from(point.pixel)))
        .collect();
    // Smooth distortion leaves small errors of similar size at all points.
    const MAX_SMOOTH_RATIO: f64 = 5.0;
    const MAX_SMOOTH_FRAC: f64 = 0.015;
    if let Some(all) = homography(&pairs) {
        let errors = transfer_errors(&all, &pairs);
        let max_px = errors.iter().copied().fold(0.0, f64::max);
        let median_px = median(&errors).unwrap_or(f64::INFINITY);
        let first = pairs[0].1;
        let extent_px = pairs
            .iter()
            .map(|(_, to)| (to - first).norm())
            .fold(0.0, f64::max);
        if max_px <= MAX_SMOOTH_RATIO * median_px.max(MIN_NOISE_PX)
            && median_px <= MAX_SMOOTH_FRAC * extent_px
        {
            return points.to_vec();
        }
    }
    // The seed depends only on the input, so that the result is repeatable.
    let mut random = Random::new(points.len() as u64);
    let sampled = (0..N_SAMPLES).filter_map(|_| {
        let sample: Vec<_> = (0..homography::MIN_POINTS)
            .map(|_| pairs[random.below(pairs.len())])
            .collect();
        let errors = transfer_errors(&homography(&sample)?, &pairs);
        Some((median(&errors)?, errors))
    });
    let Some((median_px, errors)) = sampled.min_by(|a, b| a.0.total_cmp(&b.0)) else {
        return points.to_vec();
    };
    let max_error_px = MAX_MEDIAN_RATIO * median_px.max(MIN_NOISE_PX);
    points
        .iter()
        .zip(errors)
        .filter(|(_, error)| *error <= max_error_px)
        .map(|(point, _)| *point)
        .collect()
}

/// Distances between the second points of pairs and the images of the first points. A distance is
/// infinite for a point at infinity.
fn transfer_errors(homography: &Matrix3<f64>, pairs: &[(Vector2<f64>, Vector2<f64>)]) -> Vec<f64> {
    pairs
        .iter()
        .map(|(from, to)| {
            let mapped = homography * from.push(1.0);
            let error = (mapped.xy() / mapped.z - to).norm();
            if error.is_nan() { f64::INFINITY } else { error }
        })
        .collect()
}

/// Fits a lens model from parameters that are close to the solution.
pub(super) fn refit(
    images: &[&[BoardPoint]],
    mut kept: Kept,
    mut bundle: Bundle,
    coefficients: Coefficients,
) -> Option<RobustFit> {
    /// The thresholds shrink with the errors until no outlier remains, usually in two to five
    /// rounds.
    const MAX_ROUNDS: usize = 20;
    let mut typical_px = f64::INFINITY;
    for round in 0..MAX_ROUNDS {
        bundle.intrinsics = coefficients.applied_to(&bundle.intrinsics);
        let (judged, judged_bundle, judged_typical_px) = judge(images, &kept, &bundle)?;
        typical_px = judged_typical_px;
        if judged == kept && round > 0 {
            break;
        }
        let has_changed = judged != kept;
        kept = judged;
        // Without outliers, the fit with equal weights follows at once.
        bundle = if has_changed {
            huber(&kept, judged_bundle, coefficients)?
        } else {
            squared(&kept, judged_bundle, coefficients, ROUGH)?.state
        };
    }
    let mut fit = squared(&kept, bundle, coefficients, EXACT)?;
    // Errors of the corners of one image are correlated, for example because of blur, a bent
    // target, or a lens that no model describes.
    fit.covariance = fit.covariance_with_shared_errors.clone();
    Some(RobustFit {
        fit,
        coefficients,
        kept,
        typical_px,
    })
}

/// A fit that limits the influence of remaining outliers.
fn huber(kept: &Kept, bundle: Bundle, coefficients: Coefficients) -> Option<Bundle> {
    // For normal errors, the norm exceeds this limit at 4 % of the corners, because exp(-2.5² / 2)
    // = 0.04.
    const THRESHOLD_SIGMAS: f64 = 2.5;
    let errors: Vec<f64> = (0..kept.points.len())
        .flat_map(|ix| bundle.errors_px(ix, &kept.points[ix]))
        .collect();
    let sigma_px = (median(&errors)? / MEDIAN_PER_SIGMA).max(MIN_NOISE_PX);
    let loss = Loss::Huber {
        threshold: THRESHOLD_SIGMAS * sigma_px,
    };
    Some(
        bundle::refine(&kept.images(), bundle, coefficients, loss, ROUGH)
            .ok()?
            .state,
    )
}

/// A fit that weights all corners equally.
fn squared(
    kept: &Kept,
    bundle: Bundle,
    coefficients: Coefficients,
    tolerance: f64,
) -> Option<Fit<Bundle>> {
    bundle::refine(
        &kept.images(),
        bundle,
        coefficients,
        Loss::Squared,
        tolerance,
    )
    .ok()
}

/// Errors of the corners of one image.
fn errors_px(intrinsics: &Intrinsics, pose: Transform, points: &[BoardPoint]) -> Vec<f64> {
    let single = Bundle {
        intrinsics: intrinsics.clone(),
        poses: vec![pose],
    };
    single.errors_px(0, points)
}

/// Median of the errors of an image with a pose.
fn median_px(image: &Option<(Transform, Vec<f64>)>) -> Option<f64> {
    image.as_ref().and_then(|(_, errors)| median(errors))
}

/// Selects the images and corners that agree with the intrinsics, and returns the poses of these
/// images and the typical error.
fn judge(images: &[&[BoardPoint]], kept: &Kept, bundle: &Bundle) -> Option<(Kept, Bundle, f64)> {
    // The poses of all images are estimated, including images that are not in use, so that such
    // images can be used again.
    let poses: Vec<_> = (0..images.len())
        .map(|image_ix| {
            let position = kept
                .image_ixs
                .iter()
                .position(|kept_ix| *kept_ix == image_ix);
            let known = position.map(|position| bundle.poses[position]);
            known.or_else(|| {
                Some(board_pose(&bundle.intrinsics, images[image_ix])?.camera_from_board)
            })
        })
        .collect();
    let located = |image_ix: usize, pose: Transform| {
        let errors = errors_px(&bundle.intrinsics, pose, images[image_ix]);
        (pose, errors)
    };
    let mut located_images: Vec<Option<(Transform, Vec<f64>)>> = (0..images.len())
        .map(|ix| Some(located(ix, poses[ix]?)))
        .collect();
    // The typical error is a median of medians, which neither wrong corners nor wrong images
    // change.
    let medians: Vec<f64> = kept
        .image_ixs
        .iter()
        .filter_map(|ix| median_px(&located_images[*ix]))
        .collect();
    let typical_px = median(&medians)?.max(MIN_NOISE_PX);
    let max_median_px = MAX_MEDIAN_RATIO * typical_px;
    for (image_ix, image) in located_images.iter_mut().enumerate() {
        // The pose may be in the wrong minimum.
        if median_px(image).is_some_and(|median_px| median_px > max_median_px) {
            let other = board_pose(&bundle.intrinsics, images[image_ix])
                .map(|found| located(image_ix, found.camera_from_board));
            if median_px(&other).is_some_and(|median_px| median_px <= max_median_px) {
                *image = other;
            }
        }
    }
    // Images and corners within the limits are kept. The limit for corners depends on their image,
    // because all corners of a blurred image have larger errors.
    let mut judged = Kept {
        image_ixs: Vec::new(),
        points: Vec::new(),
    };
    let mut judged_poses = Vec::new();
    for (image_ix, image) in located_images.into_iter().enumerate() {
        let Some((pose, errors)) = image else {
            continue;
        };
        let median_px = median(&errors)?;
        let max_error_px = MAX_SIGMAS * median_px.max(typical_px) / MEDIAN_PER_SIGMA;
        let inliers = images[image_ix]
            .iter()
            .zip(&errors)
            .filter(|(_, error)| **error <= max_error_px);
        let points: Vec<BoardPoint> = inliers.map(|(point, _)| *point).collect();
        let min_points = (1.0 - MAX_OUTLIER_FRAC) * images[image_ix].len() as f64;
        if median_px <= max_median_px
            && points.len() >= MIN_POINTS
            && points.len() as f64 >= min_points
        {
            judged.image_ixs.push(image_ix);
            judged.points.push(points);
            judged_poses.push(pose);
        }
    }
    let judged_bundle = Bundle {
        intrinsics: bundle.intrinsics.clone(),
        poses: judged_poses,
    };
    (judged.n_points() > 0).then_some((judged, judged_bundle, typical_px))
}
