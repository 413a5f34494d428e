//! Drift of the reported base poses, which range scans show.

use super::camera_motion::Motion;
use crate::pose_distance::PoseDistance;
use calibration::DriftTracker;
use keyframe::RangePoints;
use kinematics::{Stamp, Transform, transform};
use nalgebra::Point3;
use serde::Serialize;
use std::collections::VecDeque;

/// Number of corrections kept. At 10 scans per second, they cover 25 s, which is longer than any
/// image waits.
const MAX_KEPT: usize = 256;

/// Corrections of reported base poses over time, in order.
#[derive(Debug, Default)]
pub(super) struct Corrections {
    kept: VecDeque<(Stamp, Transform)>,
}

impl Corrections {
    /// The correction at a stamp. It is interpolated, and constant after the newest one and before
    /// the oldest one.
    pub(super) fn at(&self, stamp: Stamp) -> Transform {
        let n_before = self.kept.partition_point(|(of, _)| *of <= stamp);
        let before = n_before.checked_sub(1).and_then(|ix| self.kept.get(ix));
        match (before, self.kept.get(n_before)) {
            (Some((from, before)), Some((to, after))) => {
                let frac = stamp.secs_since(*from) / to.secs_since(*from);
                transform::interpolate(before, after, frac)
            }
            (Some((_, nearest)), None) | (None, Some((_, nearest))) => *nearest,
            (None, None) => Transform::identity(),
        }
    }

    /// The newest correction.
    pub(super) fn newest(&self) -> Transform {
        self.kept
            .back()
            .map_or_else(Transform::identity, |(_, of)| *of)
    }

    /// Adds a correction. One that is not later than the newest one is ignored.
    pub(super) fn push(&mut self, stamp: Stamp, map_from_odom: Transform) {
        if self.kept.back().is_some_and(|(last, _)| *last >= stamp) {
            return;
        }
        self.kept.push_back((stamp, map_from_odom));
        if self.kept.len() > MAX_KEPT {
            self.kept.pop_front();
        }
    }
}

/// Largest speeds of a base, m/s and rad/s. Poses that imply a higher speed have jumped.
const MAX_SPEED_M_S: f64 = 5.0;
const MAX_SPEED_RAD_S: f64 = 6.0;
/// Changes that are not a jump at any speed, meters and radians. Matching finds errors of this size
/// by itself.
const MIN_JUMP_M: f64 = 0.1;
const MIN_JUMP_RAD: f64 = 0.1;

/// Removes jumps from reported base poses. A SLAM system jumps when it recognizes a place, but the
/// base has not moved.
#[derive(Debug)]
pub(super) struct JumpRemoval {
    continuous_from_reported: Transform,
    /// The last pose, without jumps.
    last: Option<(Stamp, Transform)>,
}

impl Default for JumpRemoval {
    fn default() -> Self {
        Self {
            continuous_from_reported: Transform::identity(),
            last: None,
        }
    }
}

impl JumpRemoval {
    /// The transform that removes all jumps so far, from the left.
    pub(super) fn continuous_from_reported(&self) -> &Transform {
        &self.continuous_from_reported
    }

    /// A reported pose without jumps.
    pub(super) fn continued(&mut self, stamp: Stamp, reported: &Transform) -> Transform {
        let mut pose = self.continuous_from_reported * reported;
        if let Some((last_stamp, last)) = self.last
            && transform::is_finite(&pose)
        {
            let moved = PoseDistance::between(&last, &pose);
            let secs = stamp.secs_since(last_stamp).max(0.0);
            if moved.m > MIN_JUMP_M + MAX_SPEED_M_S * secs
                || moved.rad > MIN_JUMP_RAD + MAX_SPEED_RAD_S * secs
            {
                log::warn!(
                    "the reported pose of the base jumped by {moved}; its poses continue without this jump"
                );
                self.continuous_from_reported = last * reported.inverse();
                pose = last;
            }
        }
        if transform::is_finite(&pose) {
            self.last = Some((stamp, pose));
        }
        pose
    }
}

/// Corrects the drift of the base with range scans.
#[derive(Debug, Default)]
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

impl ScanCorrection {
    pub(super) fn report(&self) -> &DriftReport {
        &self.report
    }

    /// Forgets the surfaces, because the source has restarted.
    pub(super) fn restart(&mut self) {
        self.tracker = DriftTracker::default();
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corrections_are_interpolated_and_constant_outside() {
        let mut corrections = Corrections::default();
        let x_at = |corrections: &Corrections, nanos| corrections.at(Stamp(nanos)).translation.x;
        assert_eq!(x_at(&corrections, 5), 0.0);
        corrections.push(Stamp(100), Transform::translation(1.0, 0.0, 0.0));
        corrections.push(Stamp(200), Transform::translation(3.0, 0.0, 0.0));
        // A correction that is not later is ignored.
        corrections.push(Stamp(200), Transform::translation(9.0, 0.0, 0.0));
        let x = [0, 100, 150, 200, 900].map(|nanos| x_at(&corrections, nanos));
        assert_eq!(x, [1.0, 1.0, 2.0, 3.0, 3.0]);
        assert_eq!(corrections.newest().translation.x, 3.0);
    }

    #[test]
    fn a_jump_is_removed_and_motion_goes_on() {
        let mut jump_removal = JumpRemoval::default();
        let mut at = |millis: i64, x: f64| {
            let pose = Transform::translation(x, 0.0, 0.0);
            jump_removal
                .continued(Stamp(millis * 1_000_000), &pose)
                .translation
                .x
        };
        // 0.5 m/s at 100 Hz, with a jump by 0.5 m, and a pause of 2 s in which the base drives 1 m.
        let poses = [
            (0, 0.0),
            (10, 0.005),
            (20, 0.510),
            (30, 0.515),
            (2030, 1.515),
        ];
        let got = poses.map(|(millis, x)| at(millis, x));
        let expected = [0.0, 0.005, 0.005, 0.01, 1.01];
        let is_close = |(a, b): (&f64, &f64)| (a - b).abs() < 1e-12;
        assert!(got.iter().zip(&expected).all(is_close), "{got:?}");
        assert!(at(2040, f64::NAN).is_nan());
        assert!((at(2050, 1.52) - 1.015).abs() < 1e-12);
    }
}
