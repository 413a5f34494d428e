//! Planes in cells of space.

use nalgebra::{Matrix3, Point3, SymmetricEigen, Vector3};

/// Number of points after which a cell takes no more points. The plane is known well then, and
/// later points would move it by the errors of their poses.
const MAX_POINTS: u32 = 400;
/// Minimum number of points of a plane.
const MIN_POINTS: u32 = 10;
/// Growth of the number of points after which a plane is computed again.
const REFRESH_GROWTH: f64 = 1.3;
/// Maximum variance across a plane, relative to the smaller variance along it.
const MAX_THICKNESS: f64 = 0.01;
/// Minimum variance along the narrow side of a plane, relative to that along its wide side. The
/// points of a single ring lie on a line, which has no normal.
const MIN_WIDTH: f64 = 0.05;

/// Sums over the points in one cell, relative to the center of the cell.
#[derive(Clone, Debug, Default)]
pub(super) struct Cell {
    n_points: u32,
    sum: Vector3<f64>,
    sum_of_products: Matrix3<f64>,
    plane: Option<Plane>,
    /// Number of points from which `plane` was computed.
    n_in_plane: u32,
    /// Segment of the path from which the cell was first seen.
    segment: usize,
    /// Index of the last scan with a point in the cell.
    seen_at: u64,
}

/// A plane that was fitted to the points of a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Plane {
    /// Mean of the points, world frame, meters.
    pub(super) center: Point3<f64>,
    /// Unit normal. Its sign is arbitrary.
    pub(super) normal: Vector3<f64>,
    /// Variance of the points along the normal, square meters.
    pub(super) variance: f64,
    /// The smaller variance of the points along the plane, square meters.
    narrow_variance: f64,
    /// Number of points.
    n_points: u32,
}

impl Plane {
    /// Variance of the angle of the normal, square radians. `noise`: variance of the distance of a
    /// single point, square meters.
    pub(super) fn normal_variance(&self, noise: f64) -> f64 {
        noise / (f64::from(self.n_points) * self.narrow_variance)
    }

    /// Variance of the plane at a point, square meters. It grows with the distance from the center,
    /// because the normal is uncertain.
    pub(super) fn variance_at(&self, point: &Point3<f64>, noise: f64) -> f64 {
        let along = (point - self.center).cross(&self.normal).norm_squared();
        noise / f64::from(self.n_points) + self.normal_variance(noise) * along
    }

    /// Signed distance of a point, meters.
    pub(super) fn distance_m(&self, point: &Point3<f64>) -> f64 {
        self.normal.dot(&(point - self.center))
    }
}

impl Cell {
    /// An empty cell that is first seen from this segment of the path.
    pub(super) fn new(segment: usize) -> Self {
        Self {
            segment,
            ..Self::default()
        }
    }

    /// Segment of the path from which the cell was first seen.
    pub(super) fn segment(&self) -> usize {
        self.segment
    }

    /// Index of the last scan with a point in the cell.
    pub(super) fn seen_at(&self) -> u64 {
        self.seen_at
    }

    /// Adds a point of a scan, unless the cell is full. `offset`: from the center of the cell,
    /// meters.
    pub(super) fn add(&mut self, offset: &Vector3<f64>, scan_ix: u64) {
        self.seen_at = scan_ix;
        if self.n_points < MAX_POINTS {
            self.n_points += 1;
            self.sum += offset;
            self.sum_of_products += offset * offset.transpose();
        }
    }

    /// The plane of the points, if they lie on one.
    pub(super) fn plane(&self) -> Option<&Plane> {
        self.plane.as_ref()
    }

    /// Computes the plane again if the cell has enough new points.
    ///
    /// * `noise_m`: standard deviation that is added to the allowed thickness, meters.
    pub(super) fn refresh(&mut self, center: &Point3<f64>, noise_m: f64) {
        let is_known = f64::from(self.n_points) < REFRESH_GROWTH * f64::from(self.n_in_plane);
        let is_last = self.n_points == MAX_POINTS && self.n_in_plane < MAX_POINTS;
        if self.n_points < MIN_POINTS || (is_known && !is_last) {
            return;
        }
        self.n_in_plane = self.n_points;
        self.plane = self.fit(center, noise_m);
    }

    fn fit(&self, center: &Point3<f64>, noise_m: f64) -> Option<Plane> {
        let n = f64::from(self.n_points);
        let mean = self.sum / n;
        let covariance = self.sum_of_products / n - mean * mean.transpose();
        let eigen = SymmetricEigen::new(covariance);
        let mut order = [0, 1, 2];
        order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
        let [thin, narrow, wide] = order.map(|ix| eigen.eigenvalues[ix].max(0.0));
        let is_plane = thin <= MAX_THICKNESS * narrow + noise_m * noise_m
            && narrow >= MIN_WIDTH * wide
            // A cluster of points has no normal.
            && narrow >= 4.0 * thin
            && narrow > 0.0;
        is_plane.then(|| Plane {
            center: center + mean,
            normal: eigen.eigenvectors.column(order[0]).into_owned(),
            variance: thin,
            narrow_variance: narrow,
            n_points: self.n_points,
        })
    }
}
