//! Follows the drift of odometry from one range scan to the next.

use super::{RangeSensor, ScanMatch, SurfaceMap, match_scan};
use kinematics::Transform;
use nalgebra::{Matrix6, Point3, Vector6};

/// Assumed drift of odometry after one meter, meters and radians. The drift is a random walk, so it
/// grows with the root of the distance. Legged robots and wheels on smooth floors drift less.
const DRIFT_M: f64 = 0.01;
const DRIFT_RAD: f64 = 0.01;
/// Assumed drift after a turn by one radian, meters and radians.
const TURN_DRIFT_M: f64 = 0.01;
const TURN_DRIFT_RAD: f64 = 0.01;
/// Smallest assumed drift between two scans, meters and radians. It keeps the prior invertible while
/// the base stands still.
const REST_DRIFT_M: f64 = 1e-5;
const REST_DRIFT_RAD: f64 = 1e-5;

/// Estimates the drift of odometry with range scans. It matches each scan with the surfaces of all
/// earlier ones.
#[derive(Debug)]
pub struct DriftTracker {
    map: SurfaceMap,
    /// Covariance of the current correction.
    covariance: Matrix6<f64>,
    /// Pose of the base at the last scan.
    last: Option<Transform>,
}

impl DriftTracker {
    /// A tracker without a scan.
    #[must_use]
    pub fn new(sensor: RangeSensor) -> Self {
        Self {
            map: SurfaceMap::new(sensor),
            covariance: Matrix6::zeros(),
            last: None,
        }
    }

    /// Covariance of the correction at the last scan, as in [`ScanMatch::covariance`]. Before the
    /// first one, it is zero.
    #[must_use]
    pub fn covariance(&self) -> &Matrix6<f64> {
        &self.covariance
    }

    /// Adds a scan, and returns how it was matched. `None` if it was added without a comparison,
    /// because it is the first one, or because no earlier scan has seen the same surfaces.
    ///
    /// * `points`: in the world frame, according to odometry and the correction so far, meters.
    /// * `world_from_base`: pose of the base according to the same correction.
    pub fn add(
        &mut self,
        points: &[Point3<f64>],
        world_from_base: &Transform,
    ) -> Option<ScanMatch> {
        let prior = self.prior(world_from_base);
        let Some(found) = self.match_with(points, world_from_base, &prior) else {
            self.map.add(points);
            self.covariance = prior;
            self.last = Some(*world_from_base);
            return None;
        };
        let moved: Vec<Point3<f64>> = points.iter().map(|point| found.motion * point).collect();
        self.map.add(&moved);
        self.covariance = found.covariance;
        self.last = Some(found.motion * world_from_base);
        Some(found)
    }

    /// Matches a scan without adding it. See [`Self::add`].
    #[must_use]
    pub fn locate(&self, points: &[Point3<f64>], world_from_base: &Transform) -> Option<ScanMatch> {
        self.match_with(points, world_from_base, &self.prior(world_from_base))
    }

    /// Covariance of the correction at a pose of the base, before a match.
    fn prior(&self, world_from_base: &Transform) -> Matrix6<f64> {
        self.last.map_or(self.covariance, |last| {
            carried(&self.covariance, &last, world_from_base)
                + drift_covariance(&last, world_from_base)
        })
    }

    fn match_with(
        &self,
        points: &[Point3<f64>],
        world_from_base: &Transform,
        prior: &Matrix6<f64>,
    ) -> Option<ScanMatch> {
        let base = Point3::from(world_from_base.translation.vector);
        (!self.map.is_empty())
            .then(|| match_scan(&self.map, points, &base, prior))
            .flatten()
    }
}

/// Covariance of the correction at another position of the base. A wrong rotation about the first
/// position moves the second one.
fn carried(covariance: &Matrix6<f64>, from: &Transform, to: &Transform) -> Matrix6<f64> {
    let moved = to.translation.vector - from.translation.vector;
    let mut change = Matrix6::identity();
    change
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&-moved.cross_matrix());
    change * covariance * change.transpose()
}

/// Covariance of the drift on the way between two poses.
fn drift_covariance(from: &Transform, to: &Transform) -> Matrix6<f64> {
    let distance_m = (to.translation.vector - from.translation.vector).norm();
    let turn_rad = from.rotation.angle_to(&to.rotation);
    let translation =
        REST_DRIFT_M.powi(2) + DRIFT_M.powi(2) * distance_m + TURN_DRIFT_M.powi(2) * turn_rad;
    let rotation =
        REST_DRIFT_RAD.powi(2) + DRIFT_RAD.powi(2) * distance_m + TURN_DRIFT_RAD.powi(2) * turn_rad;
    let [t, r] = [translation, rotation];
    Matrix6::from_diagonal(&Vector6::new(t, t, t, r, r, r))
}
