//! The ranges of the joints of a chain.

use crate::{Chain, Error};
use std::f64::consts::{PI, TAU};

/// Distance by which a value of the closed form may be beyond a range because of rounding, radians.
/// Such a value is moved into the range, which changes the pose by a similar angle.
const ROUNDING_RAD: f64 = 1e-9;

/// Ranges of the joints, in the order of the chain.
#[derive(Clone, Debug)]
pub(super) struct Bounds {
    ranges: Vec<[f64; 2]>,
    /// Whether a joint gives the same pose after a full turn.
    is_periodic: Vec<bool>,
}

impl Bounds {
    /// # Errors
    /// Fails if there is not one range per joint, or if a range contains no value. Ranges may be
    /// infinite.
    pub(super) fn new(chain: &Chain, ranges: Vec<[f64; 2]>) -> Result<Self, Error> {
        if ranges.len() != chain.n_joints() {
            return Err(Error::JointCount {
                got: ranges.len(),
                expected: chain.n_joints(),
                joints: chain.joint_names().to_vec(),
            });
        }
        for (joint, &[lower, upper]) in chain.joint_names().iter().zip(&ranges) {
            // NaN is rejected, too, and so are two equal infinities.
            let has_value = lower <= upper && lower < f64::INFINITY && upper > f64::NEG_INFINITY;
            if !has_value {
                return Err(Error::JointRange {
                    joint: joint.clone(),
                    lower,
                    upper,
                });
            }
        }
        Ok(Self {
            ranges,
            is_periodic: (0..chain.n_joints())
                .map(|joint_ix| chain.is_periodic(joint_ix))
                .collect(),
        })
    }

    /// The same joints without limits.
    pub(super) fn unlimited(&self) -> Self {
        Self {
            ranges: vec![[f64::NEG_INFINITY, f64::INFINITY]; self.ranges.len()],
            is_periodic: self.is_periodic.clone(),
        }
    }

    pub(super) fn range(&self, joint_ix: usize) -> [f64; 2] {
        self.ranges[joint_ix]
    }

    pub(super) fn clamp(&self, joint_ix: usize, value: f64) -> f64 {
        let [lower, upper] = self.ranges[joint_ix];
        value.clamp(lower, upper)
    }

    /// Whether a joint is at an end of its range and a change would move it beyond this end.
    pub(super) fn would_leave(&self, joint_ix: usize, value: f64, change: f64) -> bool {
        let [lower, upper] = self.ranges[joint_ix];
        (value <= lower && change < 0.0) || (value >= upper && change > 0.0)
    }

    /// The value within the range that gives the same pose as `value` and is closest to
    /// `reference`. `None` if no value within the range gives this pose.
    pub(super) fn nearest_turn(&self, joint_ix: usize, value: f64, reference: f64) -> Option<f64> {
        let [lower, upper] = self.ranges[joint_ix];
        let mut turned = value;
        if self.is_periodic[joint_ix] {
            // Most values need no turn, and rounding takes longer than the comparison.
            if (reference - value).abs() > PI {
                turned += TAU * ((reference - value) / TAU).round();
            }
            // If the reference is near an end of the range, the closest value may be beyond this
            // end. Most of these values have no turn within the range, which is found without
            // rounding.
            if turned > upper + ROUNDING_RAD {
                if turned - TAU < lower - ROUNDING_RAD {
                    return None;
                }
                turned -= TAU * ((turned - upper - ROUNDING_RAD) / TAU).ceil();
            } else if turned < lower - ROUNDING_RAD {
                if turned + TAU > upper + ROUNDING_RAD {
                    return None;
                }
                turned += TAU * ((lower - ROUNDING_RAD - turned) / TAU).ceil();
            }
        }
        let is_inside = lower - ROUNDING_RAD <= turned && turned <= upper + ROUNDING_RAD;
        is_inside.then(|| turned.clamp(lower, upper))
    }

    /// The range from which random starts of a search are drawn. It is a part of the joint's range
    /// that covers all poses, and it is as close as possible to `around`.
    ///
    /// * `span_m`: half the range of a prismatic joint without limits, meters.
    pub(super) fn start_range(&self, joint_ix: usize, around: f64, span_m: f64) -> [f64; 2] {
        let [lower, upper] = self.ranges[joint_ix];
        let half = if self.is_periodic[joint_ix] {
            PI
        } else if (upper - lower).is_finite() {
            upper - lower
        } else {
            span_m
        };
        let center = around.clamp(lower, upper);
        // A window at an end of the range is moved inside, so that it keeps its width.
        let from = (center - half).min(upper - 2.0 * half).max(lower);
        [from, (from + 2.0 * half).min(upper)]
    }
}
