//! Detects streams whose quaternions are in another order.

use super::{PoseSample, TimeOffset, TimeOffsetOptions, estimate};
use crate::Error;
use crate::hand_eye::Refusal;
use nalgebra::{Quaternion, UnitQuaternion};

/// Explains large residuals by quaternions in the order w, x, y, z in one or both streams. This is
/// the explanation if the orientations fit several times better with this order.
///
/// * `found`: the estimate for the order x, y, z, w.
pub(super) fn mistake(
    a: &[PoseSample],
    b: &[PoseSample],
    options: &TimeOffsetOptions,
    found: Result<&TimeOffset, &Error>,
) -> Option<Refusal> {
    /// Smaller residuals are normal errors of a tracking system.
    const MAX_GOOD_DEG: f64 = 2.0;
    /// Residual with the right order.
    const MAX_EXPLAINED_DEG: f64 = 6.0;
    /// Factor by which the other order must fit better. With a smaller factor, noisy streams would
    /// also be reported.
    const BETTER: f64 = 3.0;
    let found_deg = match found {
        Ok(offset) => median_deg(offset),
        Err(Error::Refused(_)) => f64::INFINITY,
        Err(_) => return None,
    };
    if found_deg <= MAX_GOOD_DEG {
        return None;
    }
    // Only the fit of the orientations matters here.
    let options = TimeOffsetOptions {
        hand_eye: false,
        ..*options
    };
    let w_first_a = w_first(a);
    let w_first_b = w_first(b);
    let variants = [
        ("stream A", &w_first_a[..], b),
        ("stream B", a, &w_first_b[..]),
        ("both streams", &w_first_a[..], &w_first_b[..]),
    ];
    let fits = variants
        .into_iter()
        .filter_map(|(name, a, b)| Some((median_deg(&estimate(a, b, &options).ok()?), name)));
    let (best_deg, name) = fits.min_by(|p, q| p.0.total_cmp(&q.0))?;
    if best_deg > MAX_EXPLAINED_DEG || best_deg * BETTER > found_deg {
        return None;
    }
    let as_given = if found_deg.is_finite() {
        format!("differ by {found_deg:.1} degrees (median) after alignment")
    } else {
        "do not agree".to_owned()
    };
    Some(Refusal::new(
        format!(
            "the quaternions of {name} are in the order w, x, y, z: as x, y, z, w the orientations {as_given}, as w, x, y, z they agree within {best_deg:.1} degrees"
        ),
        "write the quaternions in the order x, y, z, w",
    ))
}

/// Median difference of the orientations after alignment, which single wrong poses do not affect.
fn median_deg(offset: &TimeOffset) -> f64 {
    let residuals: Vec<f64> = offset.residuals.iter().map(|[_, deg]| *deg).collect();
    numbers::quantile::median(&residuals).unwrap_or(f64::INFINITY)
}

/// The poses for quaternions whose first number is w.
fn w_first(samples: &[PoseSample]) -> Vec<PoseSample> {
    let mut reordered = samples.to_vec();
    for sample in &mut reordered {
        // The coordinates are stored as x, y, z, w, in the order in which they were read.
        let [first, second, third, fourth]: [f64; 4] = sample.pose.rotation.coords.into();
        sample.pose.rotation =
            UnitQuaternion::from_quaternion(Quaternion::new(first, second, third, fourth));
    }
    reordered
}
