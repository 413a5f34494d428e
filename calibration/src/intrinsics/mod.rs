//! Calibration of focal length, principal point and lens of one camera from images of a flat
//! target.
//!
//! The sources are Zhang 2000 for the approach, OpenCV for the lens models, and mrcal for the
//! projection uncertainty.

pub(crate) mod board_pose;
mod bundle;
mod check;
mod coefficients;
mod grid;
pub(crate) mod homography;
mod initial;
mod lens_coverage;
mod next_view;
mod report;
mod robust;
mod selection;
#[cfg(test)]
mod tests;

pub use board_pose::{BoardPose, board_pose};
pub use grid::ImageGrid;
pub use lens_coverage::{
    CoverageGoal, GoalProgress, ImagePart, LensCoverage, NextPhotograph, RECOMMENDED_IMAGES, Side,
};
pub use next_view::NextView;
pub(crate) use report::point_fits;
pub use report::{
    EstimatedParam, ImageFit, IntrinsicsCalibration, PointFit, Rejected, RejectionReason,
};
pub use selection::LensTrial;

use crate::{BoardPoint, BoardView, Error, MIN_VALIDATION_IMAGES};
use coefficients::Coefficients;
use robust::RobustFit;

/// Detected points and the lens model to estimate.
#[derive(Clone, Copy, Debug)]
pub struct IntrinsicsInput<'a> {
    /// The target in each image. The numbering of its points must be consistent. It may be mirrored
    /// or rotated.
    pub views: &'a [BoardView],
    /// Width and height of each image, pixels. All sizes must be equal.
    pub sizes_px: &'a [[u32; 2]],
    /// The lens model.
    pub model: LensModel,
}

/// A lens model to estimate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LensModel {
    /// The simplest model that explains the images. A coefficient is estimated only if it lowers
    /// the error on held-out corners significantly. With fewer than four images, two models are
    /// compared: Brown-Conrady (k1, k2, p1, p2, k3) and Kannala-Brandt. In this case, all
    /// coefficients of the better model are estimated.
    #[default]
    Auto,
    /// No distortion.
    Pinhole,
    /// k1, k2, p1, p2, k3.
    BrownConrady5,
    /// OpenCV's rational model with the coefficients k1, k2, p1, p2, k3, k4, k5, k6.
    BrownConrady8,
    /// k1, k2, k3, k4 of OpenCV's fisheye model.
    KannalaBrandt,
}

impl LensModel {
    /// All models.
    pub const ALL: [Self; 5] = [
        Self::Auto,
        Self::Pinhole,
        Self::BrownConrady5,
        Self::BrownConrady8,
        Self::KannalaBrandt,
    ];

    /// Its name in options.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Pinhole => "pinhole",
            Self::BrownConrady5 => "brown-conrady",
            Self::BrownConrady8 => "rational-brown-conrady",
            Self::KannalaBrandt => "kannala-brandt",
        }
    }

    /// Its coefficients.
    #[must_use]
    pub fn description(self) -> &'static str {
        match self {
            Self::Auto => "The simplest model that explains the images",
            Self::Pinhole => "No distortion",
            Self::BrownConrady5 => "k1, k2, p1, p2, k3",
            Self::BrownConrady8 => "k1, k2, p1, p2, k3, k4, k5, k6",
            Self::KannalaBrandt => "k1 to k4 of OpenCV's fisheye model",
        }
    }
}

/// Estimates the intrinsics of a camera from images of a flat target, with their uncertainty.
///
/// Images may show parts of the target. Images and corners that are inconsistent with the others
/// are rejected and named. Up to half of the images may be inconsistent.
///
/// # Errors
/// Fails if the input is malformed, if too few images are usable, or if no lens model fits. Also
/// fails if the images do not determine the focal length or the principal point. The message
/// contains the remedy.
pub fn calibrate_intrinsics(input: &IntrinsicsInput<'_>) -> Result<IntrinsicsCalibration, Error> {
    // Each phase removes errors that would affect the next phase. In order, the phases reject
    // malformed input, gross errors of single corners, images that contradict the others, and
    // results that are not determined.
    let (usable, mut rejected) = check::usable_images(input.views, input.sizes_px)?;
    let images: Vec<&[BoardPoint]> = usable
        .iter()
        .map(|ix| &input.views[*ix].points[..])
        .collect();
    let size_px = input.sizes_px[0];
    let start_points = robust::without_gross_errors(&images);
    let starts: Vec<&[BoardPoint]> = start_points.iter().map(|points| &points[..]).collect();
    let near_pinhole = |coefficients| {
        robust::fit(
            &images,
            &starts,
            &initial::pinhole(&starts, size_px)?,
            coefficients,
        )
    };
    let fisheye = || {
        robust::fit(
            &images,
            &starts,
            &initial::fisheye(&starts, size_px)?,
            Coefficients::KANNALA_BRANDT,
        )
    };
    let (fit, trials) = match input.model {
        LensModel::Auto => select(
            &images,
            near_pinhole(Coefficients::BROWN_CONRADY),
            fisheye(),
        )?,
        LensModel::Pinhole => (near_pinhole(Coefficients::PINHOLE), Vec::new()),
        LensModel::BrownConrady5 => (near_pinhole(Coefficients::BROWN_CONRADY), Vec::new()),
        LensModel::BrownConrady8 => (near_pinhole(Coefficients::RATIONAL), Vec::new()),
        LensModel::KannalaBrandt => (fisheye(), Vec::new()),
    };
    let fit = fit.ok_or(Error::NoLensFits)?;
    check_match(&fit, size_px)?;
    check::check_n_images(fit.kept.image_ixs.len())?;
    check::check_observable(&fit.fit)?;
    let views: Vec<&BoardView> = usable.iter().map(|ix| &input.views[*ix]).collect();
    rejected.extend(report::rejections(&views, &fit));
    Ok(report::report(&views, fit, rejected, trials))
}

/// Selects the lens model, starting from two fits. The selection uses the images and corners that
/// the better fit keeps. With too few images for a comparison of coefficients, the better fit is
/// the result.
fn select(
    images: &[&[BoardPoint]],
    near_pinhole: Option<RobustFit>,
    fisheye: Option<RobustFit>,
) -> Result<(Option<RobustFit>, Vec<LensTrial>), Error> {
    // Maximum error relative to the smaller of the two typical errors. The errors of a wrong lens
    // model are far above this maximum.
    const MAX_ERROR_RATIO: f64 = 3.0;
    // A fit that rejects images is not better than a fit that explains them. A fit with large
    // errors explains no images.
    let fits = || {
        [near_pinhole.as_ref(), fisheye.as_ref()]
            .into_iter()
            .flatten()
    };
    let max_error_px = MAX_ERROR_RATIO
        * fits()
            .map(|fit| fit.typical_px)
            .fold(f64::INFINITY, f64::min);
    let reference = fits().max_by(|a, b| {
        let n_explained = |fit: &RobustFit| fit.n_explained(max_error_px);
        n_explained(a)
            .cmp(&n_explained(b))
            .then(b.typical_px.total_cmp(&a.typical_px))
    });
    let reference = reference.ok_or(Error::NoLensFits)?;
    check_match(reference, reference.fit.state.intrinsics.size_px)?;
    check::check_n_images(reference.kept.image_ixs.len())?;
    // Comparisons of models are not meaningful if the images do not determine the focal length.
    check::check_observable(&reference.fit)?;
    if reference.kept.image_ixs.len() < MIN_VALIDATION_IMAGES {
        return Ok((Some(reference.clone()), Vec::new()));
    }
    let selected = selection::select(&reference.kept, near_pinhole.as_ref(), fisheye.as_ref());
    let (coefficients, bundle, trials) = selected.ok_or(Error::NoLensFits)?;
    Ok((
        robust::refit(images, reference.kept.clone(), bundle, coefficients),
        trials,
    ))
}

/// Refuses a fit with errors that no corner detector has.
fn check_match(fit: &RobustFit, size_px: [u32; 2]) -> Result<(), Error> {
    // Maximum error as a fraction of the longer side of the image. For a side of 1280 px, it is 38
    // px. Larger errors come from a wrong layout of the target.
    const MAX_ERROR_FRAC: f64 = 0.03;
    let side_px = f64::from(size_px[0].max(size_px[1]));
    if fit.typical_px < MAX_ERROR_FRAC * side_px {
        Ok(())
    } else {
        Err(Error::TargetMismatch {
            error_px: format!("{:.1}", fit.typical_px),
        })
    }
}
