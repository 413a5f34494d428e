//! Corrections of reported base poses over time, and jumps in them.

use crate::pose_distance::PoseDistance;
use kinematics::{Stamp, Transform, transform};
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
/// Changes that are not a jump at any speed, meters and radians. Scan matching corrects errors of
/// this size.
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
