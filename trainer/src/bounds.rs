//! Approximate bounds of a model, for the initial view of a model without a list of cameras.

use numbers::quantile::{Rank, quantile};

/// Fraction of the points inside the radius. Stray points and distant backgrounds stay outside.
/// With a larger fraction, the initial view would show the background instead of the object. With a
/// smaller fraction, it would be inside the scene.
const INSIDE_FRAC: f64 = 0.8;
/// Fraction of the points inside the outer radius. It includes thin parts far from the center, such
/// as the neck of a guitar, but not stray points around a model.
const OUTER_FRAC: f64 = 0.99;
/// Maximum outer radius, in radii. Points that are farther away belong to the background of a
/// scene, because the farthest parts of an object are rarely beyond twice its radius.
const MAX_OUTER_RADII: f64 = 2.5;
/// Minimum radius, meters. It is needed for a model of a single point.
pub(crate) const MIN_RADIUS_M: f64 = 0.01;

/// A sphere that contains most of a model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Position in the world frame, meters.
    pub center_m: [f64; 3],
    /// Meters.
    pub radius_m: f64,
    /// Radius of a sphere with the same center that contains the whole object, meters. It equals
    /// `radius_m` if the model has a distant background.
    pub outer_radius_m: f64,
}

impl Bounds {
    /// The sphere is centered at the median along each axis, and its radius contains most points.
    /// `None` without points.
    pub(crate) fn of_points(points_m: &[[f64; 3]]) -> Option<Self> {
        // Medians and a quantile are used instead of mean and maximum, because a few distant stray
        // points would move the center and enlarge the radius without bound.
        let quantile = |mut values: Vec<f64>, frac| quantile(&mut values, frac, Rank::Nearest);
        let middle =
            |axis: usize| quantile(points_m.iter().map(|point| point[axis]).collect(), 0.5);
        let center_m = [middle(0)?, middle(1)?, middle(2)?];
        let distances_m: Vec<f64> = points_m
            .iter()
            .map(|point_m| distance_m(point_m, center_m))
            .collect();
        let radius_m = quantile(distances_m.clone(), INSIDE_FRAC)?.max(MIN_RADIUS_M);
        let outer_radius_m = quantile(distances_m, OUTER_FRAC)?.max(radius_m);
        let is_object = outer_radius_m <= MAX_OUTER_RADII * radius_m;
        Some(Self {
            center_m,
            radius_m,
            outer_radius_m: if is_object { outer_radius_m } else { radius_m },
        })
    }
}

/// Distance of a point from the center, meters.
fn distance_m(point_m: &[f64; 3], center_m: [f64; 3]) -> f64 {
    let squared = point_m
        .iter()
        .zip(center_m)
        .map(|(coordinate, center)| (coordinate - center).powi(2));
    squared.sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A disk of 900 points with radius 1, and 100 points evenly along a line from its edge to
    /// `reach_m`.
    fn disk_with_neck(reach_m: f64) -> Vec<[f64; 3]> {
        let disk = (0..900).map(|ix| {
            // The disk is filled evenly along a golden-angle spiral.
            let radius = (f64::from(ix) / 900.0).sqrt();
            let angle = 2.399_963 * f64::from(ix);
            [radius * angle.cos(), radius * angle.sin(), 0.0]
        });
        let neck = (0..100).map(|ix| [1.0 + (reach_m - 1.0) * f64::from(ix) / 99.0, 0.0, 0.0]);
        disk.chain(neck).collect()
    }

    #[test]
    fn outer_radius_contains_thin_parts_but_no_background() {
        let guitar = Bounds::of_points(&disk_with_neck(2.0)).expect("points");
        assert!(
            guitar.radius_m < 1.1 && guitar.outer_radius_m > 1.8,
            "{guitar:?}"
        );
        let scene = Bounds::of_points(&disk_with_neck(50.0)).expect("points");
        assert_eq!(scene.outer_radius_m, scene.radius_m, "{scene:?}");
    }
}
