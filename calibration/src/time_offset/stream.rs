//! A stream of poses as a function of time.

use super::{PoseSample, stamps};
use crate::Error;
use kinematics::{Transform, transform};
use nalgebra::Vector3;

/// Minimum number of poses of a stream. Fewer poses cannot show a correlation.
const MIN_POSES: usize = 20;

/// Whether a sample is finite and its rotation has unit length.
fn is_valid(sample: &PoseSample) -> bool {
    sample.secs.is_finite()
        && transform::is_finite(&sample.pose)
        && (sample.pose.rotation.norm() - 1.0).abs() < transform::RIGID_TOLERANCE
}

/// Poses in the order of time, interpolated between neighbors that are not separated by a gap.
#[derive(Clone, Debug)]
pub(super) struct Stream {
    pub(super) samples: Vec<PoseSample>,
    /// Largest time between neighbors that are interpolated.
    max_gap_secs: f64,
}

impl Stream {
    /// Sorts the poses and drops repeated stamps.
    ///
    /// # Errors
    /// Fails if a value is not finite, or if there are too few poses.
    pub(super) fn new(name: &str, samples: &[PoseSample]) -> Result<Self, Error> {
        /// Neighbors whose distance exceeds the median by this factor are not interpolated. Up to
        /// two consecutive poses may thus be missing.
        const GAP: f64 = 3.5;
        let invalid = |why: String| Err(Error::TimeOffsetInput { why });
        if let Some(ix) = samples.iter().position(|sample| !is_valid(sample)) {
            return invalid(format!(
                "pose {ix} of stream {name} is not finite or its quaternion has no unit length"
            ));
        }
        let mut sorted = samples.to_vec();
        sorted.sort_by(|a, b| a.secs.total_cmp(&b.secs));
        if let Some(why) = stamps::repeated_stamps(name, &sorted) {
            return invalid(why);
        }
        // The first pose with a stamp is kept. Interpolation divides by the time between neighbors.
        sorted.dedup_by(|later, earlier| later.secs <= earlier.secs);
        if let Some(why) = stamps::distant_stamp(name, &sorted) {
            return invalid(why);
        }
        if sorted.len() < MIN_POSES {
            return invalid(format!(
                "stream {name} has {} poses with different stamps; at least {MIN_POSES} are needed",
                sorted.len()
            ));
        }
        let steps: Vec<f64> = sorted
            .windows(2)
            .map(|pair| pair[1].secs - pair[0].secs)
            .collect();
        let step_secs = numbers::quantile::median(&steps).unwrap_or(0.0);
        Ok(Self {
            samples: sorted,
            max_gap_secs: GAP * step_secs,
        })
    }

    /// Median time between neighbors, which gaps do not affect.
    pub(super) fn median_step_secs(&self) -> f64 {
        let steps: Vec<f64> = self
            .samples
            .windows(2)
            .map(|pair| pair[1].secs - pair[0].secs)
            .collect();
        numbers::quantile::median(&steps).unwrap_or(0.0)
    }

    /// The stream on a clock that advances by another factor.
    pub(super) fn scaled(&self, factor: f64) -> Self {
        let first_secs = self.start_secs();
        let mut scaled = self.clone();
        scaled.max_gap_secs *= factor;
        for sample in &mut scaled.samples {
            sample.secs = first_secs + factor * (sample.secs - first_secs);
        }
        scaled
    }

    pub(super) fn start_secs(&self) -> f64 {
        self.samples[0].secs
    }

    pub(super) fn end_secs(&self) -> f64 {
        self.samples[self.samples.len() - 1].secs
    }

    /// Typical time between poses.
    pub(super) fn step_secs(&self) -> f64 {
        (self.end_secs() - self.start_secs()) / (self.samples.len() - 1) as f64
    }

    /// The neighbors of a time, and the fraction between them. `None` outside the stream and in
    /// gaps.
    fn neighbors(&self, secs: f64) -> Option<(&PoseSample, &PoseSample, f64)> {
        let after = self.samples.partition_point(|sample| sample.secs <= secs);
        let (before, after) = match after {
            0 => return None,
            // The time of the last pose itself is in the stream.
            n if n == self.samples.len() => {
                let last = &self.samples[n - 1];
                if secs > last.secs {
                    return None;
                }
                (&self.samples[n - 2], last)
            }
            n => (&self.samples[n - 1], &self.samples[n]),
        };
        let step = after.secs - before.secs;
        (step <= self.max_gap_secs).then(|| (before, after, (secs - before.secs) / step))
    }

    /// The pose at a time.
    pub(super) fn at(&self, secs: f64) -> Option<Transform> {
        let (before, after, frac) = self.neighbors(secs)?;
        Some(transform::interpolate(&before.pose, &after.pose, frac))
    }

    /// The pose at a time and the angular velocity of the body in its own frame. The velocity is
    /// the mean over `half_secs` before and after this time.
    pub(super) fn at_with_rate(
        &self,
        secs: f64,
        half_secs: f64,
    ) -> Option<(Transform, Vector3<f64>)> {
        let before = self.at(secs - half_secs)?;
        let after = self.at(secs + half_secs)?;
        Some((
            self.at(secs)?,
            (before.rotation.inverse() * after.rotation).scaled_axis() / (2.0 * half_secs),
        ))
    }

    /// Magnitude of the mean rotation rate in a window around a time, rad/s.
    pub(super) fn rotation_rate(&self, secs: f64, window_secs: f64) -> Option<f64> {
        let before = self.at(secs - 0.5 * window_secs)?;
        let after = self.at(secs + 0.5 * window_secs)?;
        Some(before.rotation.angle_to(&after.rotation) / window_secs)
    }
}
