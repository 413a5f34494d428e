//! Approximate bounds of a model, for the initial view of a model without a list of cameras.

use numbers::quantile::{Rank, quantile};

/// Fraction of the points inside the radius. Stray points and distant backgrounds stay outside.
/// With a larger fraction, the initial view shows the background instead of the object; with a
/// smaller one, it starts inside the scene.
const INSIDE_FRAC: f64 = 0.8;
/// Minimum radius, meters. A model of a single point needs one, too.
pub(crate) const MIN_RADIUS_M: f64 = 0.01;

/// A sphere that contains most of a model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// In world, meters.
    pub center_m: [f64; 3],
    /// Meters.
    pub radius_m: f64,
}

impl Bounds {
    /// Centered at the median along each axis, with a radius that contains most points; `None`
    /// without points.
    pub(crate) fn of_points(points_m: &[[f64; 3]]) -> Option<Self> {
        // Medians and a quantile instead of mean and maximum: a few stray points far away would
        // move the center and enlarge the radius without bound.
        let quantile = |mut values: Vec<f64>, frac| quantile(&mut values, frac, Rank::Nearest);
        let middle =
            |axis: usize| quantile(points_m.iter().map(|point| point[axis]).collect(), 0.5);
        let center_m = [middle(0)?, middle(1)?, middle(2)?];
        let distances_m = points_m
            .iter()
            .map(|point_m| distance_m(point_m, center_m))
            .collect();
        let radius_m = quantile(distances_m, INSIDE_FRAC)?;
        Some(Self {
            center_m,
            radius_m: radius_m.max(MIN_RADIUS_M),
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
