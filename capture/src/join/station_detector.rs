//! Detects stations of the base from its reported poses. Only past poses are used, so images do not
//! have to wait for later poses.

use kinematics::{Stamp, Transform};
use std::collections::VecDeque;

/// Time for which the base must stay near one pose to count as stationary. With a shorter time, the
/// moment at which a base reverses would count as a station. With a longer time, the first
/// keyframes of a station would be lost.
const STATIONARY_SECS: f64 = 0.5;
/// Maximum distance from the pose near which the base is stationary, meters. With larger values,
/// slow motion would become part of a station. With smaller values, a station would be split if the
/// base sways while its arm moves.
const STATIONARY_M: f64 = 0.005;
/// Maximum rotation relative to the same pose, radians.
const STATIONARY_RAD: f64 = 0.005;
/// Maximum number of stations kept. No image waits for so long that it would need an older station.
const MAX_STATIONS: usize = 64;

/// The stations of a moving base, counted from 0.
#[derive(Debug, Default)]
pub(super) struct StationDetector {
    /// Pose near which the base currently is, and the stamp since which it has been there.
    stationary_since: Option<(Stamp, Transform)>,
    /// Whether the newest station is at that pose.
    is_known: bool,
    stations: VecDeque<Span>,
}

#[derive(Clone, Copy, Debug)]
struct Span {
    station: usize,
    from: Stamp,
    to: Stamp,
}

impl StationDetector {
    /// Adds the next pose of the base.
    pub(super) fn push(&mut self, stamp: Stamp, world_from_base: &Transform) {
        // Each pose is compared with the first pose of the standstill, not with its predecessor.
        // Otherwise, a base that creeps would count as stationary.
        let Some((since, _)) = self
            .stationary_since
            .filter(|(_, pose)| is_near(pose, world_from_base))
        else {
            self.stationary_since = Some((stamp, *world_from_base));
            self.is_known = false;
            return;
        };
        if stamp.secs_since(since) < STATIONARY_SECS {
            return;
        }
        // A station begins when it is detected, not when the base came to rest. An image from
        // before the detection may have been decided already, without a station.
        if !std::mem::replace(&mut self.is_known, true) {
            let station = self.stations.back().map_or(0, |last| last.station + 1);
            self.stations.push_back(Span {
                station,
                from: stamp,
                to: stamp,
            });
            if self.stations.len() > MAX_STATIONS {
                self.stations.pop_front();
            }
        }
        if let Some(span) = self.stations.back_mut() {
            span.to = stamp;
        }
    }

    /// Ends the current station, because the base pose has jumped.
    pub(super) fn restart(&mut self) {
        self.stationary_since = None;
    }

    /// The station at a stamp that is not later than the newest pose; `None` while the base moves
    /// or has just stopped.
    pub(super) fn at(&self, stamp: Stamp) -> Option<usize> {
        // Images are close to the newest pose, so the search goes backwards.
        let span = self.stations.iter().rev().find(|span| span.from <= stamp)?;
        (stamp <= span.to).then_some(span.station)
    }
}

fn is_near(pose: &Transform, other: &Transform) -> bool {
    // This comparison is false for a pose with NaN.
    (pose.translation.vector - other.translation.vector).norm() <= STATIONARY_M
        && pose.rotation.angle_to(&other.rotation) <= STATIONARY_RAD
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn station_begins_after_rest_and_ends_with_motion() {
        // The base rests for 2 s and moves 1 m within 2 s. Then it rests, turns on the spot, and
        // rests again.
        let pose = |secs: f64| {
            let x = (0.5 * (secs - 2.0)).clamp(0.0, 1.0);
            let yaw_rad = (0.3 * (secs - 6.0)).clamp(0.0, 0.3);
            let sway = 0.001 * (20.0 * secs).sin();
            Transform::new(Vector3::new(x, sway, 0.0), Vector3::new(0.0, 0.0, yaw_rad))
        };
        let mut station_detector = StationDetector::default();
        let mut immediate = Vec::new();
        for tick in 0..1000 {
            let stamp = Stamp::from_secs(0.01 * f64::from(tick));
            station_detector.push(stamp, &pose(0.01 * f64::from(tick)));
            immediate.push((stamp, station_detector.at(stamp)));
        }
        let at = |secs: f64| station_detector.at(Stamp::from_secs(secs));
        assert_eq!(
            [0.4, 0.6, 1.9, 2.1, 3.0, 4.3, 4.7, 5.9, 6.1, 7.7].map(at),
            [
                None,
                Some(0),
                Some(0),
                None,
                None,
                None,
                Some(1),
                Some(1),
                None,
                Some(2)
            ]
        );
        assert_eq!(at(20.0), None, "no poses yet");
        // Answers given immediately equal answers given later.
        assert!(
            immediate
                .iter()
                .all(|(stamp, station)| station_detector.at(*stamp) == *station)
        );
    }

    #[test]
    fn restart_begins_another_station() {
        let mut station_detector = StationDetector::default();
        let mut push = |from_tick: i32| {
            (from_tick..from_tick + 100).for_each(|tick| {
                station_detector.push(
                    Stamp::from_secs(0.01 * f64::from(tick)),
                    &Transform::identity(),
                );
            });
            station_detector.restart();
        };
        push(0);
        push(100);
        let at = |secs: f64| station_detector.at(Stamp::from_secs(secs));
        assert_eq!([0.9, 1.2, 1.9].map(at), [Some(0), None, Some(1)]);
    }

    #[test]
    fn slow_motion_and_non_finite_poses_give_no_station() {
        let mut station_detector = StationDetector::default();
        for tick in 0..500 {
            let creeping = Transform::translation(0.02 * 0.01 * f64::from(tick), 0.0, 0.0);
            station_detector.push(Stamp::from_secs(0.01 * f64::from(tick)), &creeping);
        }
        let broken = Transform::translation(f64::NAN, 0.0, 0.0);
        for tick in 500..700 {
            station_detector.push(Stamp::from_secs(0.01 * f64::from(tick)), &broken);
        }
        assert!((0..700).all(|tick| {
            station_detector
                .at(Stamp::from_secs(0.01 * f64::from(tick)))
                .is_none()
        }));
    }
}
