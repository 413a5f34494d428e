//! The path of a moving base, for viewers.

use crate::client::server_message::ServerMessage;
use crate::clock::ServerClock;
use crate::topics::shared_topic::{SharedTopic, only_message};
use crate::topics::{DefaultRate, Priority};
use axum::extract::ws::Message;
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
        };
        only_message(Some(message.to_message()))
    }
}

/// Positions of the base so far, in world.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct BasePath {
    points_m: Vec<[f64; 3]>,
    spacing_m: f64,
    /// Time of the last position, whether it was added or left out.
    extended: Option<Instant>,
}

impl Default for BasePath {
    fn default() -> Self {
        Self {
            points_m: Vec::new(),
            spacing_m: INITIAL_SPACING_M,
            extended: None,
        }
    }
}

impl BasePath {
    /// Adds a position unless it is too close to the last one. Returns whether it was added.
    pub(crate) fn push(&mut self, position_m: [f64; 3]) -> bool {
        self.extended = Some(Instant::now());
        let distance = |last: &[f64; 3]| (Vector3::from(*last) - Vector3::from(position_m)).norm();
        if self
            .points_m
            .last()
            .is_some_and(|last| distance(last) < self.spacing_m)
        {
            return false;
        }
        // The length of a run is not known in advance. Halving the resolution keeps the whole path,
        // while removing the oldest points would lose its beginning.
        if self.points_m.len() == MAX_POINTS {
            let mut ix = 0;
            // Keeps the points with even indices, and thus the start of the path.
            self.points_m.retain(|_| {
                ix += 1;
                ix % 2 == 1
            });
            // Otherwise, the new part of the path would be denser than the old one.
            self.spacing_m *= 2.0;
        }
        self.points_m.push(position_m);
        true
    }

    /// Whether the next position is due.
    pub(crate) fn is_due(&self) -> bool {
        self.extended
            .is_none_or(|at| at.elapsed() >= POSITION_PERIOD)
    }

    /// The path, rounded to millimeters, which shortens the message.
    pub(crate) fn rounded(&self) -> Vec<[f64; 3]> {
        let rounded = |value: f64| (value * 1e3).round() / 1e3;
        self.points_m
            .iter()
            .map(|point| point.map(rounded))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::{BasePath, MAX_POINTS};

    #[test]
    fn long_paths_keep_their_shape_with_bounded_size() {
        let mut path = BasePath::default();
        let mut n_added = 0;
        for step in 0..100_000 {
            let angle = f64::from(step) * 1e-3;
            n_added += u32::from(path.push([10.0 * angle.cos(), 10.0 * angle.sin(), 0.0]));
        }
        assert!(
            n_added > 600 && path.points_m.len() <= MAX_POINTS,
            "{n_added}, {}",
            path.points_m.len()
        );
        assert_eq!(path.rounded()[0], [10.0, 0.0, 0.0]);
        let largest_gap = path.points_m.windows(2).map(|pair| {
            let between = nalgebra::Vector3::from(pair[1]) - nalgebra::Vector3::from(pair[0]);
            between.norm()
        });
        let largest_gap = largest_gap.fold(0.0, f64::max);
        assert!(
            largest_gap < 3.0 * path.spacing_m,
            "{largest_gap} with a spacing of {}",
            path.spacing_m
        );
    }

    #[test]
    fn a_base_at_rest_adds_nothing() {
        let mut path = BasePath::default();
        assert!(path.push([1.0, 2.0, 0.0]));
        assert!(!path.push([1.0, 2.01, 0.0]));
    }
}
