//! Checks of the points before a calibration, and of the observability after it.

use super::bundle::Bundle;
use super::report::{Rejected, RejectionReason};
use super::robust::MIN_POINTS;
use crate::least_squares::Fit;
use crate::{BoardPoint, BoardView, Error};
use nalgebra::Vector3;
use numbers::quantile::median;

/// Minimum number of images. Each image gives two constraints on focal lengths and principal point.
pub(super) const MIN_IMAGES: usize = 3;
/// Images whose corners differ by less than this, in pixels, are repetitions. If they counted as
/// independent, the uncertainty would be underestimated.
const MIN_DISTANCE_PX: f64 = 1.0;

/// Returns the indices of the images with enough points that do not repeat an earlier image, and
/// rejects the others.
///
/// # Errors
/// Fails if the sizes differ, a value is not finite, the target is not flat or has an implausible
/// size, or there are too few images.
pub(super) fn usable_images(
    views: &[BoardView],
    sizes_px: &[[u32; 2]],
) -> Result<(Vec<usize>, Vec<Rejected>), Error> {
    check_views(views, sizes_px)?;
    check_target(views.iter().flat_map(|view| &view.points))?;
    let mut usable = Vec::new();
    let mut rejected = Vec::new();
    for (ix, view) in views.iter().enumerate() {
        let n_points = view.points.len();
        let distance_px = |other: &usize| median_distance_px(view, &views[*other]);
        let same_px = usable
            .iter()
            .filter_map(distance_px)
            .find(|distance_px| *distance_px < MIN_DISTANCE_PX);
        let reason = match same_px {
            _ if n_points < MIN_POINTS => RejectionReason::TooFewPoints {
                n_points,
                min_points: MIN_POINTS,
            },
            Some(distance_px) => RejectionReason::Repeated { distance_px },
            None => {
                usable.push(ix);
                continue;
            }
        };
        rejected.push(Rejected {
            image: view.name.clone(),
            reason,
        });
    }
    check_n_images(usable.len())?;
    Ok((usable, rejected))
}

/// Rejects images of different sizes, and points that are not finite.
fn check_views(views: &[BoardView], sizes_px: &[[u32; 2]]) -> Result<(), Error> {
    if sizes_px.len() != views.len() {
        return Err(Error::ImageSizes {
            n_images: views.len(),
            n_sizes: sizes_px.len(),
        });
    }
    for (view, size_px) in views.iter().zip(sizes_px) {
        // All images must have the same size, because cropped or scaled images have different
        // intrinsics.
        if *size_px != sizes_px[0] {
            return Err(Error::MixedImageSizes {
                first: views[0].name.clone(),
                first_px: sizes_px[0],
                other: view.name.clone(),
                other_px: *size_px,
            });
        }
        if size_px.contains(&0) {
            return Err(Error::EmptyImage {
                image: view.name.clone(),
            });
        }
        if !view.points.iter().all(is_finite) {
            return Err(Error::NonFinitePoint {
                image: view.name.clone(),
            });
        }
    }
    Ok(())
}

/// Whether all coordinates of a point are finite.
fn is_finite(point: &BoardPoint) -> bool {
    point
        .pixel
        .iter()
        .chain(point.point_in_board.iter())
        .all(|value| value.is_finite())
}

/// Median distance of the points that two images share, pixels. `None` if they do not share most of
/// their points.
fn median_distance_px(view: &BoardView, other: &BoardView) -> Option<f64> {
    let distances: Vec<f64> = view
        .points
        .iter()
        .filter_map(|point| {
            let mut others = other.points.iter();
            let same = others.find(|other| other.point_in_board == point.point_in_board)?;
            Some((point.pixel[0] - same.pixel[0]).hypot(point.pixel[1] - same.pixel[1]))
        })
        .collect();
    if 2 * distances.len() < view.points.len() {
        None
    } else {
        median(&distances)
    }
}

pub(super) fn check_n_images(n_images: usize) -> Result<(), Error> {
    if n_images < MIN_IMAGES {
        Err(Error::TooFewImages {
            n_images,
            min_images: MIN_IMAGES,
        })
    } else {
        Ok(())
    }
}

/// Rejects targets of an implausible size, and targets that are not flat.
fn check_target<'a>(points: impl Iterator<Item = &'a BoardPoint> + Clone) -> Result<(), Error> {
    /// If the size is outside this range, the points are probably in other units.
    const SIZES_M: std::ops::RangeInclusive<f64> = 0.002..=10.0;
    /// Allowed deviation from a plane, relative to the size of the target.
    const MAX_BEND: f64 = 0.02;
    let infinite = Vector3::repeat(f64::INFINITY);
    let (low, high) = points.fold((infinite, -infinite), |(low, high), point| {
        (
            low.inf(&point.point_in_board),
            high.sup(&point.point_in_board),
        )
    });
    let extent = high - low;
    let size_m = extent.x.max(extent.y);
    if size_m < 0.0 {
        return Ok(()); // No points: reported as too few images.
    }
    if !SIZES_M.contains(&size_m) {
        return Err(Error::TargetSize {
            size_m: size_m.to_string(),
        });
    }
    if extent.z > MAX_BEND * size_m {
        return Err(Error::TargetNotFlat {
            depth_mm: format!("{:.1}", 1e3 * extent.z),
        });
    }
    Ok(())
}

/// Refuses a result whose focal length or principal point the images do not determine.
pub(super) fn check_observable(fit: &Fit<Bundle>) -> Result<(), Error> {
    /// Maximum standard deviation of the focal length and of the principal point. For the focal
    /// length, it is relative to the focal length. For the principal point, it is relative to the
    /// focal length or to the longer side of the image.
    const MAX_SIGMA_FRAC: f64 = 0.05;
    /// Focal lengths, relative to the longer side of the image, that occur in cameras.
    const FOCAL_FRACS: std::ops::Range<f64> = 0.05..100.0;
    let intrinsics = &fit.state.intrinsics;
    let side_px = f64::from(intrinsics.size_px[0].max(intrinsics.size_px[1]));
    // Messages contain the largest tilt, because focal length and distance cannot be distinguished
    // without tilts.
    let max_tilt_deg = fit.state.poses.iter().map(|pose| {
        let normal = pose.rotation * Vector3::z();
        normal.z.abs().min(1.0).acos().to_degrees()
    });
    let max_tilt_deg = max_tilt_deg.fold(0.0, f64::max);
    for (axis, focal_px) in intrinsics.focal_px.into_iter().enumerate() {
        // The condition is written so that NaN is refused.
        let sigma_frac = fit.sigma(axis) / focal_px.abs();
        if !(sigma_frac < MAX_SIGMA_FRAC && FOCAL_FRACS.contains(&(focal_px / side_px))) {
            return Err(Error::FocalLengthUnobservable {
                sigma_percent: format!("{:.0}", 100.0 * sigma_frac.min(10.0)),
                max_tilt_deg: format!("{max_tilt_deg:.0}"),
            });
        }
        let sigma_px = fit.sigma(2 + axis);
        // For a long focal length, a change of the principal point has almost the same effect as a
        // rotation of the camera.
        if sigma_px.is_nan() || sigma_px >= MAX_SIGMA_FRAC * side_px.max(focal_px) {
            return Err(Error::PrincipalPointUnobservable {
                sigma_px: format!("{:.0}", sigma_px.min(side_px)),
                max_tilt_deg: format!("{max_tilt_deg:.0}"),
            });
        }
    }
    Ok(())
}
