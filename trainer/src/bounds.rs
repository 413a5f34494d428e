//! Approximate bounds of a model, for the initial view of a model without a list of cameras.

use kinematics::quantile::{Rank, quantile};

/// Fraction of the points inside the radius. Stray points and distant backgrounds stay outside.
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
        let quantile = |mut values: Vec<f64>, frac| quantile(&mut values, frac, Rank::Nearest);
        let middle =
            |axis: usize| quantile(points_m.iter().map(|point| point[axis]).collect(), 0.5);
        let center_m = [middle(0)?, middle(1)?, middle(2)?];
        let distance_m = |point: &[f64; 3]| {
            let squared = point
                .iter()
                .zip(center_m)
                .map(|(coordinate, center)| (coordinate - center).powi(2));
            squared.sum::<f64>().sqrt()
        };
        let radius_m = quantile(points_m.iter().map(distance_m).collect(), INSIDE_FRAC)?;
        Some(Self {
            center_m,
            radius_m: radius_m.max(MIN_RADIUS_M),
        })
    }
}
