//! The pose of a base in the map now, also while the input of the run waits for a busy trainer.
//!
//! The input delivers poses with the corrections of the map, but late. The device of the base reports
//! in time, but without corrections. A correction changes slowly, so the newest one that is known is
//! applied to the newest report.

use kinematics::{Stamp, Transform, transform};
use std::collections::VecDeque;

/// Time for which reports of the device are kept until the input delivers them, seconds.
const KEPT_SECS: f64 = 20.0;
/// Maximum number of reports that are kept: those of this time at 200 Hz.
const MAX_REPORTS: usize = 4000;
/// Largest difference of the stamps of a report and of a corrected pose that belong together,
/// seconds.
const MAX_DIFFERENCE_SECS: f64 = 0.03;

/// Largest time between two reports between which a pose is known, seconds.
const MAX_GAP_SECS: f64 = 0.2;

/// Reports of a base, and their correction.
#[derive(Debug, Default)]
pub(super) struct PoseTracker {
    reports: VecDeque<(Stamp, Transform)>,
    map_from_odom: Option<Transform>,
}

impl PoseTracker {
    /// Notes a report of the device. Reports must come in the order of their stamps.
    pub(super) fn report(&mut self, at: Stamp, odom_from_base: Transform) {
        if self.reports.back().is_some_and(|(last, _)| at <= *last) {
            return;
        }
        self.reports.push_back((at, odom_from_base));
        let is_old = |(first, _): &(Stamp, Transform)| at.secs_since(*first) > KEPT_SECS;
        while self.reports.len() > MAX_REPORTS || self.reports.front().is_some_and(is_old) {
            self.reports.pop_front();
        }
    }

    /// The newest correction.
    pub(super) fn map_from_odom(&self) -> Option<Transform> {
        self.map_from_odom
    }

    /// Notes a pose that is already in the map.
    pub(super) fn report_in_map(&mut self, at: Stamp, map_from_base: Transform) {
        self.map_from_odom = Some(Transform::identity());
        self.report(at, map_from_base);
    }

    /// Notes a pose in the map, which the input has delivered.
    pub(super) fn correct(&mut self, at: Stamp, map_from_base: &Transform) {
        let n_before = self.reports.partition_point(|(stamp, _)| *stamp < at);
        let neighbors = [n_before.checked_sub(1), Some(n_before)];
        let nearest = neighbors
            .into_iter()
            .flatten()
            .filter_map(|ix| self.reports.get(ix))
            .min_by_key(|(stamp, _)| stamp.nanos_since(at).abs());
        let Some((stamp, odom_from_base)) = nearest else {
            return;
        };
        if stamp.secs_since(at).abs() <= MAX_DIFFERENCE_SECS {
            self.map_from_odom = Some(map_from_base * odom_from_base.inverse());
        }
    }

    /// The pose in the map at a time, between two reports; `None` if it is not known.
    pub(super) fn at(&self, at: Stamp) -> Option<Transform> {
        let n_before = self.reports.partition_point(|(stamp, _)| *stamp < at);
        let map_from_odom = self.map_from_odom?;
        let (later_at, later) = self.reports.get(n_before)?;
        let Some((earlier_at, earlier)) = n_before.checked_sub(1).map(|ix| &self.reports[ix])
        else {
            return (*later_at == at).then(|| map_from_odom * later);
        };
        let gap_secs = later_at.secs_since(*earlier_at);
        if gap_secs > MAX_GAP_SECS {
            return None;
        }
        let share = at.secs_since(*earlier_at) / gap_secs;
        Some(map_from_odom * transform::interpolate(earlier, later, share))
    }

    /// The newest pose in the map; `None` without reports, or before the first correction.
    pub(super) fn newest(&self) -> Option<(Stamp, Transform)> {
        let (at, odom_from_base) = self.reports.back()?;
        Some((*at, self.map_from_odom? * odom_from_base))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: i64) -> Stamp {
        Stamp(1_000_000 * millis)
    }

    #[test]
    fn late_corrections_apply_to_the_newest_report() {
        let mut tracker = PoseTracker::default();
        let moved = |x_m: f64| Transform::translation(x_m, 0.0, 0.5);
        for step in 0..1000_i64 {
            tracker.report(at(10 * step), moved(0.01 * step as f64));
        }
        assert_eq!(tracker.newest(), None, "the map is not known yet");
        // The pose at 2 s arrives after 8 s. The map has shifted by 5 cm to the left.
        tracker.correct(at(2003), &Transform::translation(2.0, 0.05, 0.5));
        let (newest_at, pose) = tracker.newest().expect("corrected");
        assert_eq!(newest_at, at(9990));
        let expected = Transform::translation(9.99, 0.05, 0.5);
        let off = pose.translation.vector - expected.translation.vector;
        assert!(off.norm() < 1e-12, "{pose}");
        // A pose without a report of the same time corrects nothing.
        tracker.correct(at(99_000), &Transform::translation(77.0, 0.0, 0.0));
        assert_eq!(tracker.newest(), Some((newest_at, pose)));
    }

    #[test]
    fn poses_between_two_reports_are_interpolated_in_the_map() {
        let mut tracker = PoseTracker::default();
        let moved = |x_m: f64| Transform::translation(x_m, 0.0, 0.5);
        for step in 0..3_i64 {
            tracker.report(at(100 * step), moved(0.1 * step as f64));
        }
        tracker.report(at(900), moved(0.9));
        assert_eq!(tracker.at(at(50)), None, "the map is not known yet");
        tracker.correct(at(0), &Transform::translation(0.0, 1.0, 0.5));
        let pose = tracker.at(at(150)).expect("between two reports");
        let off = pose.translation.vector - moved(0.15).translation.vector;
        assert!((off - nalgebra::Vector3::new(0.0, 1.0, 0.0)).norm() < 1e-12);
        assert_eq!(tracker.at(at(500)), None, "a gap");
        assert_eq!(tracker.at(at(950)), None, "not reported yet");
    }

    #[test]
    fn repeated_reports_are_ignored_and_old_ones_are_dropped() {
        let mut tracker = PoseTracker::default();
        for step in 0..10_000_i64 {
            tracker.report(at(10 * step), Transform::identity());
            tracker.report(at(10 * step), Transform::translation(5.0, 0.0, 0.0));
        }
        assert_eq!(tracker.reports.len(), 2001);
        tracker.correct(at(10), &Transform::identity());
        assert_eq!(tracker.newest(), None, "its report was dropped");
    }
}
