//! Results of a calibration of intrinsics.

use super::board_pose::board_pose;
use super::bundle::Bundle;
use super::coefficients::Family;
use super::grid::{ImageGrid, ProjectionDerivatives};
use super::next_view::{self, NextView};
use super::robust::RobustFit;
use super::selection::LensTrial;
use crate::{BoardPoint, BoardView};
use kinematics::{Intrinsics, Lens, Transform};
use nalgebra::{DMatrix, Point3};
use numbers::quantile::median;

/// Result of [`super::calibrate_intrinsics`].
#[derive(Clone, Debug)]
pub struct IntrinsicsCalibration {
    /// The intrinsics. The lens is a pinhole if no coefficient was estimated.
    pub intrinsics: Intrinsics,
    /// The lens model and the coefficients that were estimated, such as `brown_conrady k1 k2`.
    pub model: String,
    /// The estimated parameters: focal lengths, principal point, and coefficients.
    pub params: Vec<EstimatedParam>,
    /// Covariance of [`Self::params`].
    pub covariance: DMatrix<f64>,
    /// Root mean square of the distances between detected and projected points, pixels. As in
    /// OpenCV, it is computed over the points in use.
    pub rms_px: f64,
    /// Standard deviation of a detected corner along one axis, estimated from the residuals,
    /// pixels.
    pub noise_px: f64,
    /// Ratio of the observed variance between images to the variance expected from independent
    /// corner errors. If the ratio is above 1, the corners of an image share errors. The covariance
    /// includes these shared errors.
    pub dispersion: f64,
    /// The images in use.
    pub images: Vec<ImageFit>,
    /// Images and corners that were not used, with the reason.
    pub rejected: Vec<Rejected>,
    /// Comparisons of lens models. The list is empty unless the model is
    /// [`super::LensModel::Auto`].
    pub trials: Vec<LensTrial>,
    /// Number of corners in use in each part of the image.
    pub coverage: ImageGrid<usize>,
    /// Standard deviation of the projection of a distant point in each part of the image, in the
    /// worst direction, pixels. `None` beyond the range of the lens model.
    ///
    /// The uncertainty of the intrinsics is propagated to the pixel. A rotation of the camera frame
    /// has almost the same effect as a change of the intrinsics. The effect of such a rotation is
    /// removed, because it does not matter for images of unknown pose. mrcal 2.4 ("projection
    /// uncertainty") derives this rotation from the poses of the target. Here, the rotation
    /// minimizes the squared displacements over the whole image.
    pub uncertainty_px: ImageGrid<Option<f64>>,
    /// The pose of the target that would lower the projection uncertainty the most.
    pub next_view: Option<NextView>,
}

impl IntrinsicsCalibration {
    /// Covariance of [`Intrinsics::params`]. Coefficients that were not estimated are assumed to be
    /// exact.
    pub fn intrinsics_covariance(&self) -> DMatrix<f64> {
        let n = self.intrinsics.params().len();
        let mut covariance = DMatrix::zeros(n, n);
        for (row, param) in self.params.iter().enumerate() {
            for (column, other) in self.params.iter().enumerate() {
                covariance[(param.ix, other.ix)] = self.covariance[(row, column)];
            }
        }
        covariance
    }
}

/// An estimated parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EstimatedParam {
    /// `fx`, `fy`, `cx`, `cy` (pixels), or OpenCV's name of a coefficient.
    pub name: &'static str,
    /// Index in [`Intrinsics::params`].
    pub ix: usize,
    /// The estimate.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
}

/// An image that was used.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageFit {
    /// Name of the view.
    pub name: String,
    /// Root mean square of the distances between detected and projected points in use, pixels.
    pub rms_px: f64,
    /// Pose of the target in the camera frame.
    pub camera_from_board: Transform,
    /// The points in use.
    pub points: Vec<PointFit>,
}

/// A point that was used.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointFit {
    /// Detected position, pixels.
    pub pixel: [f64; 2],
    /// Detected minus projected position, pixels.
    pub residual_px: [f64; 2],
}

/// An image or some of its corners that were not used.
#[derive(Clone, Debug, PartialEq)]
pub struct Rejected {
    /// Name of the view.
    pub image: String,
    /// The reason.
    pub reason: RejectionReason,
}

impl std::fmt::Display for Rejected {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.image, self.reason)
    }
}

/// Why an image or some of its corners were not used.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RejectionReason {
    /// The image has too few points for a pose.
    TooFewPoints {
        /// Number of points.
        n_points: usize,
        /// Minimum number.
        min_points: usize,
    },
    /// The image repeats an earlier image.
    Repeated {
        /// Median distance of the points in the two images, pixels.
        distance_px: f64,
    },
    /// No pose of the target explains the points.
    Inconsistent {
        /// Median error of this image, pixels.
        median_px: f64,
        /// Median error of a typical image, pixels.
        typical_px: f64,
    },
    /// Single corners are inconsistent with the others. The rest of the image is used.
    Corners {
        /// Number of rejected corners.
        n_corners: usize,
        /// Largest error among them, pixels.
        max_px: f64,
        /// Median error of a typical image, pixels.
        typical_px: f64,
    },
}

impl std::fmt::Display for RejectionReason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::TooFewPoints {
                n_points,
                min_points,
            } => {
                write!(f, "{n_points} points, expected at least {min_points}")
            }
            Self::Repeated { distance_px } => {
                write!(
                    f,
                    "repeats an earlier image: the corners differ by {distance_px:.1} px; move the target or the camera"
                )
            }
            Self::Inconsistent {
                median_px,
                typical_px,
            } => write!(
                f,
                "median error {median_px:.2} px, {typical_px:.2} px in a typical image: the target was detected wrongly, \
                 or its layout differs"
            ),
            Self::Corners {
                n_corners,
                max_px,
                typical_px,
            } => write!(
                f,
                "{n_corners} corners off by up to {max_px:.2} px, {typical_px:.2} px in a typical image; its other \
                 corners are used"
            ),
        }
    }
}

/// The images and corners that a fit does not use.
pub(super) fn rejections(views: &[&BoardView], fit: &RobustFit) -> Vec<Rejected> {
    let mut rejected = Vec::new();
    for (image_ix, view) in views.iter().enumerate() {
        if let Some(reason) = rejection(image_ix, view, fit) {
            rejected.push(Rejected {
                image: view.name.clone(),
                reason,
            });
        }
    }
    rejected
}

/// The reason why an image or some of its corners are not used. `None` if all corners are used.
fn rejection(image_ix: usize, view: &BoardView, fit: &RobustFit) -> Option<RejectionReason> {
    let kept = &fit.kept;
    let intrinsics = &fit.fit.state.intrinsics;
    let typical_px = fit.typical_px;
    let position = kept
        .image_ixs
        .iter()
        .position(|kept_ix| *kept_ix == image_ix);
    // A rejected image has no pose in the fit, so its best pose is computed here.
    let pose = match position {
        Some(position) => Some(fit.fit.state.poses[position]),
        None => board_pose(intrinsics, &view.points).map(|pose| pose.camera_from_board),
    };
    let errors_px = pose.map_or(vec![f64::INFINITY], |pose| {
        let single = Bundle {
            intrinsics: intrinsics.clone(),
            poses: vec![pose],
        };
        single.errors_px(0, &view.points)
    });
    let Some(position) = position else {
        let median_px = median(&errors_px).unwrap_or(f64::INFINITY);
        return Some(RejectionReason::Inconsistent {
            median_px,
            typical_px,
        });
    };
    // Corners with the largest errors are rejected first, so the largest error belongs to a
    // rejected corner.
    let n_corners = view.points.len() - kept.points[position].len();
    let max_px = errors_px.iter().copied().fold(0.0, f64::max);
    (n_corners > 0).then_some(RejectionReason::Corners {
        n_corners,
        max_px,
        typical_px,
    })
}

/// Summarizes a fit.
pub(super) fn report(
    views: &[&BoardView],
    RobustFit {
        fit,
        coefficients,
        kept,
        ..
    }: RobustFit,
    rejected: Vec<Rejected>,
    trials: Vec<LensTrial>,
) -> IntrinsicsCalibration {
    let params = coefficients.params();
    let values = fit.state.intrinsics.params();
    let estimated = coefficients.names().into_iter().zip(&params).enumerate();
    let estimated = estimated.map(|(ix, (name, param))| EstimatedParam {
        name,
        ix: *param,
        value: values[*param],
        sigma: fit.sigma(ix),
    });
    let images: Vec<ImageFit> = kept
        .image_ixs
        .iter()
        .enumerate()
        .map(|(ix, view_ix)| {
            let pose = fit.state.poses[ix];
            let points = point_fits(&fit.state.intrinsics, &pose, &kept.points[ix]);
            ImageFit {
                name: views[*view_ix].name.clone(),
                rms_px: rms_px(points.iter()),
                camera_from_board: pose,
                points,
            }
        })
        .collect();
    // The current projection uncertainty, and the next image that reduces it most.
    let derivatives = ProjectionDerivatives::new(&fit.state.intrinsics, &params);
    let known = next_view::Known {
        intrinsics: &fit.state.intrinsics,
        params: &params,
        information: &fit.information,
        variance: fit.variance * fit.dispersion.max(1.0),
    };
    let is_pinhole = coefficients.family == Family::BrownConrady && params.len() == 4;
    let points = || images.iter().flat_map(|image| &image.points);
    IntrinsicsCalibration {
        model: coefficients.to_string(),
        params: estimated.collect(),
        rms_px: rms_px(points()),
        noise_px: fit.variance.sqrt(),
        dispersion: fit.dispersion,
        rejected,
        trials,
        coverage: ImageGrid::coverage(
            fit.state.intrinsics.size_px,
            points().map(|point| point.pixel),
        ),
        uncertainty_px: derivatives.sigmas_px(&fit.covariance),
        next_view: next_view::suggest(&known, &derivatives, &kept.images()),
        intrinsics: Intrinsics {
            lens: if is_pinhole {
                Lens::Pinhole
            } else {
                fit.state.intrinsics.lens
            },
            ..fit.state.intrinsics
        },
        covariance: fit.covariance,
        images,
    }
}

/// Reprojection errors of points. Points that the lens cannot image are left out.
pub(crate) fn point_fits(
    intrinsics: &Intrinsics,
    camera_from_board: &Transform,
    points: &[BoardPoint],
) -> Vec<PointFit> {
    points
        .iter()
        .filter_map(|point| {
            let in_camera = camera_from_board * Point3::from(point.point_in_board);
            let [u, v] = intrinsics.project(&in_camera.coords)?;
            Some(PointFit {
                pixel: point.pixel,
                residual_px: [point.pixel[0] - u, point.pixel[1] - v],
            })
        })
        .collect()
}

/// Root mean square of the norms of the residuals.
fn rms_px<'a>(points: impl Iterator<Item = &'a PointFit> + Clone) -> f64 {
    let squares: f64 = points
        .clone()
        .map(
            |PointFit {
                 residual_px: [x, y],
                 ..
             }| x * x + y * y,
        )
        .sum();
    (squares / points.count().max(1) as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::super::tests::{board, brown_conrady_camera, observe};
    use super::*;

    #[test]
    fn point_behind_the_camera_does_not_shift_the_errors_of_the_others() {
        let camera = brown_conrady_camera();
        let pose = Transform::translation(-0.05, -0.08, 0.5);
        let mut points = observe(&camera, &pose, &board());
        points[3].pixel[0] += 2.0;
        points[1].point_in_board.z = -1.0;
        let fits = point_fits(&camera, &pose, &points);
        assert_eq!(fits.len(), points.len() - 1);
        assert_eq!(fits[2].pixel, points[3].pixel);
        for (ix, fit) in fits.iter().enumerate() {
            let expected = if ix == 2 { 2.0 } else { 0.0 };
            let [x, y] = fit.residual_px;
            assert!((x - expected).hypot(y) < 1e-9, "{ix}: {fit:?}");
        }
    }
}
