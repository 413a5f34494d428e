//! Drift of the reported base poses, which range scans show.

use super::camera_motion::Motion;
use crate::pose_distance::PoseDistance;
use calibration::{DriftTracker, RangeSensor};
use keyframe::RangePoints;
use kinematics::Stamp;
use nalgebra::Point3;
use serde::Serialize;

/// Corrects the drift of the base with range scans.
#[derive(Debug)]
pub(super) struct ScanCorrection {
    tracker: DriftTracker,
    report: DriftReport,
    /// Sums of the squared errors of reported and of corrected poses, and their number.
    squared_errors: [PoseDistance; 2],
    n_errors: f64,
}

/// What range scans showed about the drift of the base.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct DriftReport {
    /// Number of scans that were matched with earlier ones.
    n_matched: u64,
    /// Number of scans with too few surfaces that earlier scans have seen. The first scan is one of
    /// them.
    n_unmatched: u64,
    /// Root mean square distance of the points of the newest scan from the surfaces, meters.
    rms_m: f64,
    /// Distance between the reported and the corrected pose of the base at the newest scan.
    correction: PoseDistance,
    /// Root mean square errors of reported and of corrected base poses. They are known only in
    /// simulation.
    #[serde(skip_serializing_if = "Option::is_none")]
    base_error: Option<[PoseDistance; 2]>,
}

impl Default for ScanCorrection {
    fn default() -> Self {
        Self {
            tracker: DriftTracker::new(RangeSensor::Scanner),
            report: DriftReport::default(),
            squared_errors: Default::default(),
            n_errors: 0.0,
        }
    }
}

impl ScanCorrection {
    pub(super) fn report(&self) -> &DriftReport {
        &self.report
    }

    /// Forgets the surfaces, because the source has restarted.
    pub(super) fn restart(&mut self) {
        self.tracker = DriftTracker::new(RangeSensor::Scanner);
    }

    /// Matches a scan with earlier ones, and corrects base poses from then on. Returns the scan with
    /// corrected points.
    pub(super) fn correct(&mut self, scan: RangePoints, motion: &mut Motion) -> RangePoints {
        // The pose is known, because the scan was transformed with it.
        let Ok(world_from_base) = motion.world_from_base(scan.stamp) else {
            return scan;
        };
        let points: Vec<Point3<f64>> = scan
            .points_in_world_m
            .iter()
            .map(|point| Point3::from(*point).cast())
            .collect();
        let Some(found) = self.tracker.add(&points, &world_from_base) else {
            self.report.n_unmatched += 1;
            return scan;
        };
        motion.correct_base(scan.stamp, &found.motion);
        self.report.n_matched += 1;
        self.report.rms_m = found.rms_m;
        self.add_errors(scan.stamp, motion);
        let moved = points
            .iter()
            .map(|point| (found.motion * point).cast::<f32>().coords.into());
        RangePoints {
            world_from_scanner: found.motion * scan.world_from_scanner,
            points_in_world_m: moved.collect(),
            ..scan
        }
    }

    fn add_errors(&mut self, stamp: Stamp, motion: &Motion) {
        let Some([reported, corrected]) = motion.base_poses(stamp) else {
            return;
        };
        self.report.correction = PoseDistance::between(&reported, &corrected);
        let Some(truth) = motion.true_base(stamp) else {
            return;
        };
        self.n_errors += 1.0;
        for (sum, pose) in self.squared_errors.iter_mut().zip([reported, corrected]) {
            let error = PoseDistance::between(&pose, &truth);
            sum.m += error.m * error.m;
            sum.rad += error.rad * error.rad;
        }
        let root_mean = |sum: PoseDistance| PoseDistance {
            m: (sum.m / self.n_errors).sqrt(),
            rad: (sum.rad / self.n_errors).sqrt(),
        };
        self.report.base_error = Some(self.squared_errors.map(root_mean));
    }
}

impl DriftReport {
    /// Number of scans that were matched with earlier ones.
    #[must_use]
    pub fn n_matched(&self) -> u64 {
        self.n_matched
    }

    /// Number of scans with too few surfaces that earlier scans have seen. The first scan is one of
    /// them.
    #[must_use]
    pub fn n_unmatched(&self) -> u64 {
        self.n_unmatched
    }

    /// Root mean square errors of reported and of corrected base poses. They are known only in
    /// simulation.
    #[must_use]
    pub fn base_error(&self) -> Option<[PoseDistance; 2]> {
        self.base_error
    }
}

impl std::fmt::Display for DriftReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let n_scans = self.n_matched + self.n_unmatched;
        write!(
            f,
            "base drift: {} of {n_scans} range scans matched within {:.0} mm; now corrected by {}",
            self.n_matched,
            1e3 * self.rms_m,
            self.correction
        )?;
        if let Some([before, after]) = self.base_error {
            write!(f, "; mean error {before} before, {after} after")?;
        }
        Ok(())
    }
}
