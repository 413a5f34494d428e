//! Follows the drift of odometry from one range scan to the next.

use super::{RangeSensor, ScanMatch, SurfaceMap, match_scan};
use kinematics::Transform;
use nalgebra::{Matrix6, Point3, Vector6};
use std::collections::BTreeMap;

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
///
/// The path has several segments if a scan cannot be matched, for example because the base has
/// passed through a place without surfaces. A new segment begins there. Later scans are located
/// relative to the surfaces of this segment, which are as uncertain as the pose at its begin.
#[derive(Debug)]
pub struct DriftTracker {
    map: SurfaceMap,
    segments: Vec<Segment>,
    /// Covariance of the current correction relative to the matched surfaces.
    relative: Matrix6<f64>,
    /// Covariance of these surfaces.
    of_surfaces: Matrix6<f64>,
    /// The segment that most of these surfaces belong to.
    segment: usize,
    /// Pose of the base at the last scan.
    last: Option<Transform>,
}

/// A part of the path in which each scan was matched with earlier ones.
#[derive(Debug)]
struct Segment {
    /// Pose of the base at its first scan.
    world_from_base: Transform,
    /// Covariance of the correction there.
    covariance: Matrix6<f64>,
}

impl DriftTracker {
    /// A tracker without a scan.
    #[must_use]
    pub fn new(sensor: RangeSensor) -> Self {
        Self {
            map: SurfaceMap::new(sensor),
            segments: Vec::new(),
            relative: Matrix6::zeros(),
            of_surfaces: Matrix6::zeros(),
            segment: 0,
            last: None,
        }
    }

    /// Whether no scan was added yet.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.map.is_empty()
    }

    /// Covariance of the correction at the last scan, as in [`ScanMatch::covariance`]. Before the
    /// first one, it is zero.
    #[must_use]
    pub fn covariance(&self) -> Matrix6<f64> {
        self.relative + self.of_surfaces
    }

    /// Covariance of the correction at a pose of the base for which there is no match.
    #[must_use]
    pub fn covariance_at(&self, world_from_base: &Transform) -> Matrix6<f64> {
        let Some(last) = self.last else {
            return self.covariance();
        };
        self.prior(world_from_base) + carried(&self.of_surfaces, &last, world_from_base)
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
        let Some((found, n_by_segment)) = self.matched(points, world_from_base) else {
            let covariance = self.covariance_at(world_from_base);
            self.segment = self.segments.len();
            self.map.add(points, self.segment);
            self.segments.push(Segment {
                world_from_base: *world_from_base,
                covariance,
            });
            self.relative = prior;
            self.of_surfaces = covariance - prior;
            self.last = Some(*world_from_base);
            return None;
        };
        let moved: Vec<Point3<f64>> = points.iter().map(|point| found.motion * point).collect();
        let here = found.motion * world_from_base;
        // Surfaces that are seen for the first time are placed relative to known ones of a segment.
        self.segment = largest(&n_by_segment);
        self.map.add(&moved, self.segment);
        self.relative = found.covariance;
        self.of_surfaces = self.of_surfaces(&n_by_segment, &here);
        self.last = Some(here);
        Some(ScanMatch {
            covariance: self.covariance(),
            ..found
        })
    }

    /// Matches a scan without adding it. See [`Self::add`].
    #[must_use]
    pub fn locate(&self, points: &[Point3<f64>], world_from_base: &Transform) -> Option<ScanMatch> {
        let (found, n_by_segment) = self.matched(points, world_from_base)?;
        let here = found.motion * world_from_base;
        Some(ScanMatch {
            covariance: found.covariance + self.of_surfaces(&n_by_segment, &here),
            ..found
        })
    }

    /// Matches a scan. Surfaces of another segment than before may have another error, so the
    /// correction may change by the covariance of both.
    fn matched(
        &self,
        points: &[Point3<f64>],
        world_from_base: &Transform,
    ) -> Option<(ScanMatch, BTreeMap<usize, usize>)> {
        let prior = self.prior(world_from_base);
        let found = self.match_with(points, world_from_base, &prior)?;
        if largest(&found.1) == self.segment {
            return Some(found);
        }
        let wider = self.covariance_at(world_from_base);
        self.match_with(points, world_from_base, &wider)
    }

    /// Covariance of matched surfaces, seen from a pose of the base. All surfaces of a segment have
    /// the same error. Those of several segments are assumed to have related errors.
    fn of_surfaces(
        &self,
        n_by_segment: &BTreeMap<usize, usize>,
        world_from_base: &Transform,
    ) -> Matrix6<f64> {
        let n_all: usize = n_by_segment.values().sum();
        let weighted = n_by_segment.iter().map(|(ix, n)| {
            let Segment {
                world_from_base: from,
                covariance,
            } = &self.segments[*ix];
            carried(covariance, from, world_from_base) * (*n as f64 / n_all as f64)
        });
        weighted.sum()
    }

    /// Covariance of the correction at a pose of the base before a match, relative to the surfaces
    /// of the last match.
    fn prior(&self, world_from_base: &Transform) -> Matrix6<f64> {
        self.last.map_or(self.relative, |last| {
            carried(&self.relative, &last, world_from_base)
                + drift_covariance(&last, world_from_base)
        })
    }

    fn match_with(
        &self,
        points: &[Point3<f64>],
        world_from_base: &Transform,
        prior: &Matrix6<f64>,
    ) -> Option<(ScanMatch, BTreeMap<usize, usize>)> {
        let base = Point3::from(world_from_base.translation.vector);
        (!self.map.is_empty())
            .then(|| match_scan(&self.map, points, &base, prior))
            .flatten()
    }
}

/// The segment with the most points of a match.
fn largest(n_by_segment: &BTreeMap<usize, usize>) -> usize {
    let largest = n_by_segment.iter().max_by_key(|(_, n)| **n);
    largest.map_or(0, |(segment, _)| *segment)
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
