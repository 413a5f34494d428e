//! The pose of the target that would improve a calibration the most.

use super::grid::{self, ProjectionDerivatives};
use crate::BoardPoint;
use kinematics::{Intrinsics, Transform};
use nalgebra::{DMatrix, Translation3, UnitQuaternion, Vector3};

/// A suggestion for the next image.
#[derive(Clone, Debug, PartialEq)]
pub struct NextView {
    /// The suggested pose of the target.
    pub camera_from_board: Transform,
    /// Instruction for the user, such as `tilt the target 35 degrees with its left side away from
    /// the camera, at the upper right of the image, 0.42 m away`.
    pub instruction: String,
    /// Root mean square over the image of the current projection uncertainty, pixels.
    pub sigma_px: f64,
    /// Predicted projection uncertainty with the suggested image, as the same root mean square,
    /// pixels.
    pub predicted_sigma_px: f64,
}

/// Parts of the image, each with its horizontal and vertical position from -1 (left, top) to 1, and
/// with its name.
const REGIONS: [([f64; 2], &str); 9] = [
    ([0.0, 0.0], "at the center of the image"),
    ([-1.0, -1.0], "at the upper left of the image"),
    ([0.0, -1.0], "at the top of the image"),
    ([1.0, -1.0], "at the upper right of the image"),
    ([-1.0, 0.0], "at the left of the image"),
    ([1.0, 0.0], "at the right of the image"),
    ([-1.0, 1.0], "at the lower left of the image"),
    ([0.0, 1.0], "at the bottom of the image"),
    ([1.0, 1.0], "at the lower right of the image"),
];

/// The tilt is large enough to determine the focal length, and small enough for corners to be
/// detected well.
const TILT_DEG: f64 = 35.0;
/// Rotation axes of the tilts in the camera frame, and the side of the target that is farther away.
const TILTS: [([f64; 2], Option<&str>); 9] = [
    ([0.0, 0.0], None),
    ([0.0, 1.0], Some("left side")),
    ([0.0, -1.0], Some("right side")),
    ([-1.0, 0.0], Some("upper side")),
    ([1.0, 0.0], Some("lower side")),
    ([-0.7, 0.7], Some("upper left corner")),
    ([-0.7, -0.7], Some("upper right corner")),
    ([0.7, 0.7], Some("lower left corner")),
    ([0.7, -0.7], Some("lower right corner")),
];
/// Size of the target in the image, relative to the image.
const EXTENT_FRACS: [f64; 2] = [0.4, 0.7];

/// A calibration so far.
pub(super) struct Known<'a> {
    pub(super) intrinsics: &'a Intrinsics,
    /// Indices of the estimated parameters in [`Intrinsics::params`].
    pub(super) params: &'a [usize],
    /// Information about the estimated parameters for residuals of unit variance.
    pub(super) information: &'a DMatrix<f64>,
    /// Variance of a residual, including the dispersion, px².
    pub(super) variance: f64,
}

/// Evaluates poses of the target in a fixed set of regions, tilts and distances, and returns the
/// pose with the smallest predicted projection uncertainty. `None` if the target does not fit into
/// the image or the information is singular.
///
/// Source: A-optimal design (Pukelsheim 1993, chapter 6) with the projection uncertainty as the
/// criterion.
pub(super) fn suggest(
    known: &Known<'_>,
    derivatives: &ProjectionDerivatives,
    images: &[&[BoardPoint]],
) -> Option<NextView> {
    let board = Board::new(images)?;
    let mean_square = derivatives.mean_square()?;
    let sigma_px = |information: DMatrix<f64>| {
        let covariance = information.cholesky()?.inverse() * known.variance;
        Some(mean_square.dot(&covariance).max(0.0).sqrt())
    };
    // 162 poses are evaluated. Each pose adds the information of one image in which all points of
    // the target are detected.
    let current_px = sigma_px(known.information.clone())?;
    let mut best: Option<NextView> = None;
    for (region, region_words) in REGIONS {
        for (axis, side) in TILTS {
            for extent_frac in EXTENT_FRACS {
                let Some(camera_from_board) =
                    board.pose(known.intrinsics, region, axis, extent_frac)
                else {
                    continue;
                };
                let added = grid::information(
                    known.intrinsics,
                    known.params,
                    &camera_from_board,
                    &board.points,
                );
                let predicted_sigma_px =
                    added.and_then(|added| sigma_px(known.information + added));
                let Some(predicted_sigma_px) =
                    predicted_sigma_px.filter(|sigma_px| sigma_px.is_finite())
                else {
                    continue;
                };
                if best
                    .as_ref()
                    .is_none_or(|best| predicted_sigma_px < best.predicted_sigma_px)
                {
                    let center = camera_from_board * nalgebra::Point3::from(board.center);
                    let distance_m = center.coords.norm();
                    let tilt = tilt_words(side);
                    best = Some(NextView {
                        camera_from_board,
                        instruction: format!("{tilt}, {region_words}, {distance_m:.2} m away"),
                        sigma_px: current_px,
                        predicted_sigma_px,
                    });
                }
            }
        }
    }
    best
}

/// How to hold the target.
fn tilt_words(side: Option<&str>) -> String {
    match side {
        Some(side) => {
            format!("tilt the target {TILT_DEG:.0} degrees with its {side} away from the camera")
        }
        None => "hold the target facing the camera".to_owned(),
    }
}

/// All points of the target that were seen in any image.
struct Board {
    points: Vec<Vector3<f64>>,
    center: Vector3<f64>,
    extent: Vector3<f64>,
}

impl Board {
    fn new(images: &[&[BoardPoint]]) -> Option<Self> {
        let mut points: Vec<Vector3<f64>> = images
            .iter()
            .flat_map(|points| *points)
            .map(|p| p.point_in_board)
            .collect();
        // The points are sorted, so that equal points are neighbors.
        let key = |point: &Vector3<f64>| [point.x, point.y, point.z];
        points.sort_by(|a, b| {
            key(a)
                .partial_cmp(&key(b))
                .unwrap_or(std::cmp::Ordering::Equal)
        });
        points.dedup();
        let (low, high) = points.iter().fold(
            (*points.first()?, *points.first()?),
            |(low, high), point| (low.inf(point), high.sup(point)),
        );
        Some(Self {
            points,
            center: 0.5 * (low + high),
            extent: high - low,
        })
    }

    /// Pose with the center of the target in a region of the image. The target faces the camera and
    /// is then tilted.
    fn pose(
        &self,
        intrinsics: &Intrinsics,
        region: [f64; 2],
        [x, y]: [f64; 2],
        extent_frac: f64,
    ) -> Option<Transform> {
        let size_px = intrinsics.size_px.map(f64::from);
        let distance_for = |axis: usize| {
            intrinsics.focal_px[axis] * self.extent[axis] / (extent_frac * size_px[axis])
        };
        // Both sides of the target must fit.
        let distance_m = f64::max(distance_for(0), distance_for(1));
        let pixel = [0, 1].map(|axis| {
            let half_extent_px = 0.5 * intrinsics.focal_px[axis] * self.extent[axis] / distance_m;
            // The margin makes the distance slightly larger, because tilted targets look larger on
            // one side.
            const MARGIN: f64 = 1.15;
            let reach_px = (0.5 * size_px[axis] - MARGIN * half_extent_px).max(0.0);
            0.5 * size_px[axis] + region[axis] * reach_px
        });
        let sight = intrinsics.unproject(pixel)?.normalize();
        let facing = UnitQuaternion::rotation_between(&Vector3::z(), &sight)?;
        let tilt =
            UnitQuaternion::from_scaled_axis(Vector3::new(x, y, 0.0) * TILT_DEG.to_radians());
        let rotation = facing * tilt;
        Some(Transform::from_parts(
            Translation3::from(sight * distance_m - rotation * self.center),
            rotation,
        ))
    }
}
