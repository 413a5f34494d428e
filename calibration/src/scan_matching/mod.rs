//! Matching of range scans and depth images with the surfaces that earlier ones have measured.
//!
//! Odometry drifts, but the walls of a room do not. Each scan or depth image is moved so that its
//! points lie on the planes of a [`SurfaceMap`] (point to plane, Chen and Medioni 1992; planes in
//! cells as in `VoxelMap`, Yuan et al. 2022). The pose from odometry is the prior, with a
//! covariance that grows with the distance traveled. A direction that the surfaces do not
//! determine, such as that along a corridor, therefore follows odometry.

mod cells;
mod drift_tracker;
mod surface_map;
#[cfg(test)]
mod tests;

pub use drift_tracker::DriftTracker;

use crate::rigid_transform;
use kinematics::Transform;
use nalgebra::{Cholesky, Matrix3, Matrix6, Point3, SymmetricEigen, Vector3, Vector6};
use rustc_hash::FxHashMap;
use std::collections::BTreeMap;
use surface_map::{CellId, NearPlane, SurfaceMap};

/// Maximum number of points of a scan that are compared. More points would not be independent,
/// because they lie on the same planes.
const MAX_POINTS: usize = 5000;
/// Minimum number of points on known planes, and of such planes.
const MIN_MATCHED: usize = 100;
const MIN_PLANES: usize = 6;
/// Maximum number of Gauss-Newton steps. The matched planes are searched again for each of them.
const MAX_STEPS: usize = 20;
/// Steps that are smaller than this end the search, meters and radians.
const CONVERGED: f64 = 2e-5;
/// Minimum information about a direction of translation, relative to the information that errors of
/// normals give.
const MIN_INFORMATION: f64 = 5.0;

/// The kind of sensor that measures the points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RangeSensor {
    /// A scanner with centimeters of noise, which measures the walls of a room.
    Scanner,
    /// A depth camera with millimeters of noise, which measures objects within reach of an arm.
    DepthCamera,
}

impl RangeSensor {
    /// Sides of the cells of a map, meters. Large planes such as walls are found in large cells,
    /// which give the most accurate normals. Small cells find planes between other things.
    fn cell_sides_m(self) -> [f64; 4] {
        match self {
            Self::Scanner => [1.6, 0.8, 0.4, 0.2],
            Self::DepthCamera => [0.8, 0.4, 0.2, 0.1],
        }
    }

    /// Standard deviation of the points across a plane that may come from noise alone, meters. It
    /// does not become smaller in small cells.
    fn noise_m(self) -> f64 {
        match self {
            Self::Scanner => 0.03,
            Self::DepthCamera => 0.006,
        }
    }

    /// Noise of a point beside the variance of its plane, meters.
    fn point_noise_m(self) -> f64 {
        match self {
            Self::Scanner => 0.005,
            Self::DepthCamera => 0.001,
        }
    }

    /// Maximum distance of a point from its plane, in the first step and in the last ones, meters.
    fn max_distance_m(self) -> [f64; 2] {
        match self {
            Self::Scanner => [0.5, 0.1],
            Self::DepthCamera => [0.1, 0.02],
        }
    }

    /// Error of a plane that more points do not reduce, meters.
    fn plane_error_m(self) -> f64 {
        match self {
            Self::Scanner => 0.004,
            Self::DepthCamera => 0.001,
        }
    }
}

/// How accurately a scan was matched.
#[derive(Clone, Debug, PartialEq)]
pub struct ScanMatch {
    /// Motion by which the points of the scan must be moved, in the world frame.
    pub motion: Transform,
    /// Covariance of the motion: translation of the base (meters) and rotation about it (radians),
    /// both in world axes.
    pub covariance: Matrix6<f64>,
    /// Number of points on known planes.
    pub n_matched: usize,
    /// Root mean square distance of these points from their planes, meters.
    pub rms_m: f64,
}

/// A point of the scan on a plane of the map.
struct Match {
    cell: CellId,
    /// Segment of the path from which the plane was first seen.
    segment: usize,
    normal: Vector3<f64>,
    arm: Vector3<f64>,
    distance_m: f64,
    /// Variance of the distance of a single point, and of the plane, square meters.
    variance: [f64; 2],
    /// Variance of the angle of the normal, square radians.
    normal_variance: f64,
}

/// Matches a scan with a map.
///
/// * `points`: points of the scan in the world frame, according to odometry and the correction so
///   far, meters.
/// * `base`: position of the base in the same frame, meters.
/// * `prior`: covariance of the motion that is still to be found, as in [`ScanMatch::covariance`].
///
/// Returns `None` if too few points lie on known planes. Also returns how many points were matched
/// with the planes of each segment of the path. Not every search converges, because points near the
/// maximum distance may be matched in one step and not in the next. The last of [`MAX_STEPS`] steps
/// is then added to the covariance.
fn match_scan(
    map: &SurfaceMap,
    points: &[Point3<f64>],
    base: &Point3<f64>,
    prior: &Matrix6<f64>,
) -> Option<(ScanMatch, BTreeMap<usize, usize>)> {
    let stride = points.len().div_ceil(MAX_POINTS).max(1);
    let points: Vec<Point3<f64>> = points.iter().step_by(stride).copied().collect();
    let prior_information = Cholesky::new(*prior)?.inverse();
    let [widest_m, narrowest_m] = map.sensor().max_distance_m();
    let mut motion = Transform::identity();
    for step in 0..MAX_STEPS {
        let narrowed = (step as f64 / 4.0).min(1.0);
        let max_distance_m = widest_m * (narrowest_m / widest_m).powf(narrowed);
        let matches = find_matches(map, &points, base, &motion, max_distance_m);
        let n_planes = count_planes(&matches);
        if matches.len() < MIN_MATCHED || n_planes.len() < MIN_PLANES {
            return None;
        }
        // The prior pulls back to zero motion.
        let so_far = parameters(&motion, base);
        let mut information = prior_information;
        let mut gradient = prior_information * so_far;
        let undetermined = undetermined_directions(&matches, &n_planes);
        for of in &matches {
            let weight = of.weight(n_planes[&of.cell]);
            let row = of.row(&undetermined);
            information += row * row.transpose() * weight;
            gradient += row * (weight * of.distance_m);
        }
        let cholesky = Cholesky::new(information)?;
        let change = -cholesky.solve(&gradient);
        motion = from_parameters(&change, base) * motion;
        let has_converged = narrowed >= 1.0 && change.amax() < CONVERGED;
        if has_converged || step + 1 == MAX_STEPS {
            let last_step = if has_converged {
                Vector6::zeros()
            } else {
                change
            };
            let squares: f64 = matches.iter().map(|of| of.distance_m * of.distance_m).sum();
            let mut n_by_segment = BTreeMap::new();
            for of in &matches {
                *n_by_segment.entry(of.segment).or_default() += 1;
            }
            let found = ScanMatch {
                motion,
                covariance: cholesky.inverse() + last_step * last_step.transpose(),
                n_matched: matches.len(),
                rms_m: (squares / matches.len() as f64).sqrt(),
            };
            return Some((found, n_by_segment));
        }
    }
    None
}

fn find_matches(
    map: &SurfaceMap,
    points: &[Point3<f64>],
    base: &Point3<f64>,
    motion: &Transform,
    max_distance_m: f64,
) -> Vec<Match> {
    let [point_noise_m, plane_error_m] =
        [map.sensor().point_noise_m(), map.sensor().plane_error_m()];
    let moved = points.iter().map(|point| motion * point);
    let matches = moved.filter_map(|point| {
        let NearPlane {
            cell,
            plane,
            segment,
        } = map.plane_at(&point)?;
        let distance_m = plane.distance_m(&point);
        let noise = plane.variance + point_noise_m * point_noise_m;
        (distance_m.abs() <= max_distance_m).then(|| Match {
            cell,
            segment,
            normal: plane.normal,
            arm: point - base,
            distance_m,
            variance: [
                noise,
                plane.variance_at(&point, noise) + plane_error_m * plane_error_m,
            ],
            normal_variance: plane.normal_variance(noise),
        })
    });
    matches.collect()
}

/// Projection onto the directions of translation that the surfaces do not determine.
///
/// The normals of planes have errors, so even the walls of a straight corridor seem to resist a
/// motion along it. A direction counts as undetermined if it has little more information than such
/// errors give. Degenerate directions are left to the prior as in Zhang, Kaess and Singh (2016).
fn undetermined_directions(matches: &[Match], n_planes: &FxHashMap<CellId, usize>) -> Matrix3<f64> {
    let mut information = Matrix3::zeros();
    let mut by_errors = 0.0;
    for of in matches {
        let weight = of.weight(n_planes[&of.cell]);
        information += of.normal * of.normal.transpose() * weight;
        by_errors += weight * of.normal_variance;
    }
    let eigen = SymmetricEigen::new(information);
    let mut projection = Matrix3::zeros();
    for (value, direction) in eigen
        .eigenvalues
        .iter()
        .zip(eigen.eigenvectors.column_iter())
    {
        if *value < MIN_INFORMATION * by_errors {
            projection += direction * direction.transpose();
        }
    }
    projection
}

fn count_planes(matches: &[Match]) -> FxHashMap<CellId, usize> {
    let mut counts = FxHashMap::default();
    for of in matches {
        *counts.entry(of.cell).or_default() += 1;
    }
    counts
}

impl Match {
    /// Derivative of the distance by translation of the base and rotation about it, without the
    /// directions of translation that are not determined.
    fn row(&self, undetermined: &Matrix3<f64>) -> Vector6<f64> {
        let by_rotation = self.arm.cross(&self.normal);
        let by_translation = self.normal - undetermined * self.normal;
        Vector6::new(
            by_translation.x,
            by_translation.y,
            by_translation.z,
            by_rotation.x,
            by_rotation.y,
            by_rotation.z,
        )
    }

    /// Weight of the point if `n` points lie on its plane. Together, they cannot be more accurate
    /// than the plane. The second factor is that of a Cauchy loss, which limits the influence of
    /// things that have moved.
    fn weight(&self, n: usize) -> f64 {
        let [point, plane] = self.variance;
        let shared = point + n as f64 * plane;
        let squared = self.distance_m * self.distance_m / (9.0 * (point + plane));
        1.0 / (shared * (1.0 + squared))
    }
}

/// Translation of the base and rotation about it, as a vector.
fn parameters(motion: &Transform, base: &Point3<f64>) -> Vector6<f64> {
    let moved = motion * base - base;
    let rotation = motion.rotation.scaled_axis();
    Vector6::new(
        moved.x, moved.y, moved.z, rotation.x, rotation.y, rotation.z,
    )
}

fn from_parameters(parameters: &Vector6<f64>, base: &Point3<f64>) -> Transform {
    let [translation, rotation] = [0, 3].map(|row| parameters.fixed_rows::<3>(row).into_owned());
    let about_base = Transform::from(base.coords);
    about_base * rigid_transform(rotation, translation) * about_base.inverse()
}
