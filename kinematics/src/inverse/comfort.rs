//! Selects among joint values for the same pose. Values far from the ends of the ranges and close
//! to a posture are preferred.

use super::bounds::Bounds;

/// Width of the zone at each end of a range that is avoided, as a fraction of the range.
const ZONE_FRAC: f64 = 0.1;
/// Cost of a joint at the end of its range. A joint that is one radian from the posture has the
/// same cost.
const LIMIT_WEIGHT: f64 = 1.0;
/// Cost of the squared distance from the posture, per rad^2 or m^2.
const POSTURE_WEIGHT: f64 = 1.0;

/// A preference among joint values, given by a cost (Liegeois 1977). Unlike in this source, only
/// zones at the ends of the ranges have a cost, so that joints in the middle of their ranges are
/// not moved.
#[derive(Clone, Debug, Default)]
pub(super) struct Comfort {
    /// Preferred joint values. Empty without a posture.
    pub(super) posture: Vec<f64>,
}

impl Comfort {
    /// The cost of one joint value, at least 0.
    pub(super) fn cost_of(&self, bounds: &Bounds, joint_ix: usize, value: f64) -> f64 {
        let depth = zone_depth(bounds.range(joint_ix), value);
        let off_posture = self.off_posture(joint_ix, value);
        LIMIT_WEIGHT * depth * depth + POSTURE_WEIGHT * off_posture * off_posture
    }

    pub(super) fn cost(&self, bounds: &Bounds, joints: &[f64]) -> f64 {
        let values = joints.iter().enumerate();
        values
            .map(|(joint_ix, value)| self.cost_of(bounds, joint_ix, *value))
            .sum()
    }

    /// The change of one joint value that decreases the cost. It is the sum of the change that
    /// leaves the zone and the change that reaches the posture.
    pub(super) fn descent_of(&self, bounds: &Bounds, joint_ix: usize, value: f64) -> f64 {
        let range = bounds.range(joint_ix);
        let zone = ZONE_FRAC * (range[1] - range[0]);
        let depth = zone_depth(range, value);
        let push = if depth == 0.0 { 0.0 } else { depth * zone };
        -LIMIT_WEIGHT * push - POSTURE_WEIGHT * self.off_posture(joint_ix, value)
    }

    fn off_posture(&self, joint_ix: usize, value: f64) -> f64 {
        self.posture
            .get(joint_ix)
            .map_or(0.0, |posture| value - posture)
    }
}

/// Depth of a value inside a zone. It is 0 outside the zones, 1 at the upper end of the range, and
/// -1 at the lower end.
fn zone_depth([lower, upper]: [f64; 2], value: f64) -> f64 {
    let zone = ZONE_FRAC * (upper - lower);
    // A range of a single value and an infinite range have no zones.
    if !(zone > 0.0 && zone.is_finite()) {
        return 0.0;
    }
    let above = (value - (upper - zone)).max(0.0);
    let below = (lower + zone - value).max(0.0);
    // Most values are outside of the zones, and need no division.
    if above == 0.0 && below == 0.0 {
        return 0.0;
    }
    (above - below) / zone
}
