//! The path of a moving base, for viewers.

use nalgebra::Vector3;

/// Maximum number of points; beyond it, every second point is removed.
const MAX_POINTS: usize = 512;
/// Minimum distance of two points at first, meters.
const INITIAL_SPACING_M: f64 = 0.02;

/// Positions of the base so far, in world.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct BasePath {
    points_m: Vec<[f64; 3]>,
    spacing_m: f64,
}

impl Default for BasePath {
    fn default() -> Self {
        Self { points_m: Vec::new(), spacing_m: INITIAL_SPACING_M }
    }
}

impl BasePath {
    /// Adds a position unless it is too close to the last one. Returns whether it was added.
    pub(crate) fn push(&mut self, position_m: [f64; 3]) -> bool {
        let distance = |last: &[f64; 3]| (Vector3::from(*last) - Vector3::from(position_m)).norm();
        if self.points_m.last().is_some_and(|last| distance(last) < self.spacing_m) {
            return false;
        }
        if self.points_m.len() == MAX_POINTS {
            let mut ix = 0;
            self.points_m.retain(|_| {
                ix += 1;
                ix % 2 == 1
            });
            self.spacing_m *= 2.0;
        }
        self.points_m.push(position_m);
        true
    }

    /// The path, rounded to millimeters, which shortens the message.
    pub(crate) fn rounded(&self) -> Vec<[f64; 3]> {
        let rounded = |value: f64| (value * 1e3).round() / 1e3;
        self.points_m.iter().map(|point| point.map(rounded)).collect()
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
        assert!(n_added > 600 && path.points_m.len() <= MAX_POINTS, "{n_added}, {}", path.points_m.len());
        assert_eq!(path.rounded()[0], [10.0, 0.0, 0.0]);
        let largest_gap = path.points_m.windows(2).map(|pair| {
            let between = nalgebra::Vector3::from(pair[1]) - nalgebra::Vector3::from(pair[0]);
            between.norm()
        });
        let largest_gap = largest_gap.fold(0.0, f64::max);
        assert!(largest_gap < 3.0 * path.spacing_m, "{largest_gap} with a spacing of {}", path.spacing_m);
    }

    #[test]
    fn a_base_at_rest_adds_nothing() {
        let mut path = BasePath::default();
        assert!(path.push([1.0, 2.0, 0.0]));
        assert!(!path.push([1.0, 2.01, 0.0]));
    }
}
