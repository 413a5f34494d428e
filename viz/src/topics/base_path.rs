//! The path of a moving base, for viewers.

use crate::client::server_message::ServerMessage;
use crate::clock::ServerClock;
use crate::topics::shared_topic::{SharedTopic, only_message};
use crate::topics::{DefaultRate, Priority};
use axum::extract::ws::Message;
use kinematics::Stamp;
use nalgebra::Vector3;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Maximum number of points. Beyond it, every second point is removed. The whole path is sent after
/// every change, at most twice a second. With 512 points, the message has about 12 kB.
const MAX_POINTS: usize = 512;
/// Minimum distance of two points at first, meters. A base at rest, whose position is measured with
/// noise below this distance, adds no points.
const INITIAL_SPACING_M: f64 = 0.02;
/// Maximum time between two positions on the path.
const POSITION_PERIOD: Duration = Duration::from_millis(100);
/// A base that moves farther than this, meters, and faster than [`MAX_SPEED`] between two positions
/// has not driven there. Shorter motions can be corrections of the pose.
const MAX_JUMP_M: f64 = 0.5;
/// Maximum speed of a base, m/s.
const MAX_SPEED: f64 = 5.0;

/// The topic.
#[derive(Default)]
pub(crate) struct BasePathTopic;

impl SharedTopic for BasePathTopic {
    const NAME: &'static str = "base_path";
    const DEFAULT: DefaultRate = DefaultRate::Off;
    const PRIORITY: Priority = Priority::Short;
    const PERIOD: Duration = Duration::from_millis(500);
    type Source = BasePath;

    fn encode(&mut self, path: &BasePath, _: ServerClock) -> Vec<(Arc<str>, Message)> {
        let message = ServerMessage::BasePath {
            points_m: path.rounded(),
            line_starts: path.line_starts(),
        };
        only_message(Some(message.to_message()))
    }
}

/// A point of the path.
#[derive(Clone, Copy, Debug, PartialEq)]
struct PathPoint {
    /// Position in world.
    position_m: [f64; 3],
    /// Whether the base has not driven here from the previous point.
    starts_line: bool,
}

/// A position of the base that was passed to [`BasePath::push`].
#[derive(Clone, Copy, Debug, PartialEq)]
struct Passed {
    position_m: [f64; 3],
    /// Time of the position, on the clock of the source.
    stamp: Stamp,
    at: Instant,
}

/// Positions of the base so far, in world.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct BasePath {
    points: Vec<PathPoint>,
    spacing_m: f64,
    /// The last position, whether it was added or left out.
    last: Option<Passed>,
    /// Whether the next point starts a line.
    is_interrupted: bool,
}

impl Default for BasePath {
    fn default() -> Self {
        Self {
            points: Vec::new(),
            spacing_m: INITIAL_SPACING_M,
            last: None,
            is_interrupted: true,
        }
    }
}

impl BasePath {
    /// Adds a position unless it is too close to the last point. `stamp` is the time of the
    /// position on the clock of its source. Returns whether the position was added.
    pub(crate) fn push(&mut self, position_m: [f64; 3], stamp: Stamp) -> bool {
        let passed = Passed {
            position_m,
            stamp,
            at: Instant::now(),
        };
        let last = self.last.replace(passed);
        // The points are farther apart than the positions, so jumps are found between positions.
        self.is_interrupted |= last.is_some_and(|last| is_interruption(&last, &passed));
        if self
            .points
            .last()
            .is_some_and(|point| distance_m(point.position_m, position_m) < self.spacing_m)
        {
            return false;
        }
        if self.points.len() == MAX_POINTS {
            self.thin_out();
        }
        self.points.push(PathPoint {
            position_m,
            starts_line: std::mem::take(&mut self.is_interrupted),
        });
        true
    }

    /// Removes every second point.
    fn thin_out(&mut self) {
        // The length of a run is not known in advance. Halving the resolution keeps the whole path,
        // while removing the oldest points would lose its beginning.
        let mut ix = 0;
        let mut starts_line = false;
        // Keeps the points with even indices, and thus the start of the path. If a removed point
        // starts a line, the next point starts it instead.
        self.points.retain_mut(|point| {
            ix += 1;
            starts_line |= point.starts_line;
            if ix % 2 == 0 {
                return false;
            }
            point.starts_line = std::mem::take(&mut starts_line);
            true
        });
        self.is_interrupted |= starts_line;
        // Otherwise, the new part of the path would be denser than the old one.
        self.spacing_m *= 2.0;
    }

    /// Whether the next position is due.
    pub(crate) fn is_due(&self) -> bool {
        self.last
            .is_none_or(|last| last.at.elapsed() >= POSITION_PERIOD)
    }

    /// The path, rounded to millimeters, which shortens the message.
    pub(crate) fn rounded(&self) -> Vec<[f64; 3]> {
        let rounded = |value: f64| (value * 1e3).round() / 1e3;
        self.points
            .iter()
            .map(|point| point.position_m.map(rounded))
            .collect()
    }

    /// Indices of the points to which the base has not driven from the previous point.
    pub(crate) fn line_starts(&self) -> Vec<usize> {
        let numbered = self.points.iter().enumerate().skip(1);
        let starts = numbered.filter(|(_, point)| point.starts_line);
        starts.map(|(ix, _)| ix).collect()
    }
}

/// Whether the base cannot have driven from one position to the next: the source has restarted, as
/// a repeated recording does, or the pose has jumped.
fn is_interruption(from: &Passed, to: &Passed) -> bool {
    let secs = to.stamp.secs_since(from.stamp);
    let moved_m = distance_m(from.position_m, to.position_m);
    secs < 0.0 || (moved_m > MAX_JUMP_M && moved_m > MAX_SPEED * secs)
}

fn distance_m(from: [f64; 3], to: [f64; 3]) -> f64 {
    (Vector3::from(to) - Vector3::from(from)).norm()
}

#[cfg(test)]
mod tests {
    use super::{BasePath, MAX_POINTS};
    use kinematics::Stamp;
    use nalgebra::Vector3;

    /// Time of a step, at 10 Hz.
    fn at(step: i64) -> Stamp {
        Stamp(step * 100_000_000)
    }

    #[test]
    fn long_paths_keep_their_shape_with_bounded_size() {
        let mut path = BasePath::default();
        let mut n_added = 0;
        for step in 0..100_000 {
            let angle = f64::from(step) * 1e-3;
            let position = [10.0 * angle.cos(), 10.0 * angle.sin(), 0.0];
            n_added += u32::from(path.push(position, at(i64::from(step))));
        }
        assert!(
            n_added > 600 && path.points.len() <= MAX_POINTS,
            "{n_added}, {}",
            path.points.len()
        );
        assert_eq!(path.rounded()[0], [10.0, 0.0, 0.0]);
        let largest_gap = path.points.windows(2).map(|pair| {
            let between = Vector3::from(pair[1].position_m) - Vector3::from(pair[0].position_m);
            between.norm()
        });
        let largest_gap = largest_gap.fold(0.0, f64::max);
        assert!(
            largest_gap < 3.0 * path.spacing_m,
            "{largest_gap} with a spacing of {}",
            path.spacing_m
        );
        assert_eq!(path.line_starts(), [0; 0]);
    }

    #[test]
    fn a_base_at_rest_adds_nothing() {
        let mut path = BasePath::default();
        assert!(path.push([1.0, 2.0, 0.0], at(0)));
        assert!(!path.push([1.0, 2.01, 0.0], at(1)));
    }

    #[test]
    fn lines_end_at_jumps_and_where_the_source_restarts() {
        let mut path = BasePath::default();
        let mut push = |x: f64, step: i64| {
            path.push([x, 0.0, 0.0], at(step));
            path.line_starts()
        };
        push(0.0, 0);
        assert_eq!(push(0.4, 1), [0; 0], "fast, but a correction can be so");
        assert_eq!(push(3.4, 11), [0; 0], "far, but in a second");
        assert_eq!(push(5.0, 12), [3], "nothing drives 1.6 m in 0.1 s");
        assert_eq!(push(5.4, 13), [3]);
        assert_eq!(push(5.4, 2), [3], "restarted, and too close for a point");
        assert_eq!(push(5.8, 3), [3, 5], "restarted");
        assert_eq!(push(0.0, 3), [3, 5, 6], "two positions of one time");
    }

    #[test]
    fn lines_stay_apart_when_points_are_removed() {
        let mut path = BasePath::default();
        let mut step = 0;
        // Lines of 100 points at y = 0 m, 10 m, 20 m, and so on.
        for line in 0..40 {
            for ix in 0..100 {
                step += 1;
                path.push(
                    [f64::from(ix) * 0.03, f64::from(line) * 10.0, 0.0],
                    at(step),
                );
            }
        }
        let starts = path.line_starts();
        assert_eq!(starts.len(), 39);
        for (ix, pair) in path.rounded().windows(2).enumerate() {
            let is_apart = (pair[0][1] - pair[1][1]).abs() > 1.0;
            assert_eq!(starts.contains(&(ix + 1)), is_apart);
        }
    }
}
