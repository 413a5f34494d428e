//! Poses of what mostly stands still, averaged as long as it does.

use kinematics::{Transform, Twist, transform};
use nalgebra::{Matrix6, Vector6};

/// A pose this far from the average, by the square of standard deviations, tells that it moved: once in 10 000 where it did not
/// (chi-squared, 6 degrees of freedom).
const MOVED: f64 = 27.86;
/// What an average knows grows old at this rate a pose: errors of lenses and of what was measured by hand do not average out, so some
/// 30 poses are enough.
const AGEING: f64 = 0.97;

/// The average so far.
#[derive(Clone, Debug, Default)]
pub struct Steady {
    /// The pose, and its covariance in its own axes: metres first, then radians.
    average: Option<(Transform, Matrix6<f64>)>,
}

impl Steady {
    /// Takes the next pose with its covariance, which is of a small motion in the axes of what is there (metres first, then radians);
    /// comes back with the average since it last moved.
    pub fn push(&mut self, pose: &Transform, covariance: &Matrix6<f64>) -> Transform {
        let (average, covariance) = self.merged(pose, covariance).unwrap_or((*pose, *covariance));
        self.average = Some((average, covariance));
        average
    }

    /// The average with another pose; `None` where that is of another place.
    fn merged(&self, pose: &Transform, covariance: &Matrix6<f64>) -> Option<(Transform, Matrix6<f64>)> {
        let (average, known) = self.average.as_ref()?;
        let known = known / AGEING;
        let off = transform::log(&(average.inverse() * pose), 1.0);
        let off = Vector6::from_iterator(off.linear_m_s.iter().chain(&off.angular_rad_s).copied());
        let both = (known + covariance).try_inverse()?;
        if (off.transpose() * both * off).x > MOVED {
            return None;
        }
        let gain = known * both;
        let step = gain * off;
        let twist = Twist { linear_m_s: step.fixed_rows::<3>(0).into(), angular_rad_s: step.fixed_rows::<3>(3).into() };
        Some((average * transform::exp(&twist, 1.0), known - gain * known))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn covariance(sigma_m: f64, sigma_rad: f64) -> Matrix6<f64> {
        let variance = |ix: usize| if ix < 3 { sigma_m * sigma_m } else { sigma_rad * sigma_rad };
        Matrix6::from_diagonal(&Vector6::from_fn(|ix, _| variance(ix)))
    }

    /// There and back by a millimetre and a milliradian.
    fn noisy(place: &Transform, ix: usize) -> Transform {
        let by = if ix.is_multiple_of(2) { 1e-3 } else { -1e-3 };
        place * Transform::new(Vector3::new(by, -by, by), Vector3::new(by, by, -by))
    }

    #[test]
    fn noise_averages_out_and_a_motion_is_followed_at_once() {
        let place = Transform::new(Vector3::new(1.0, -2.0, 0.1), Vector3::new(0.1, 0.2, -0.7));
        let (mut steady, covariance) = (Steady::default(), covariance(1e-3, 1e-3));
        let mut off = [0.0; 60];
        for (ix, off) in off.iter_mut().enumerate() {
            let average = steady.push(&noisy(&place, ix), &covariance);
            *off = (average.inverse() * place).translation.vector.norm();
        }
        assert!(off[0] > 1.7e-3 && off[59] < 1e-4, "{off:?}");
        let elsewhere = place * Transform::translation(0.02, 0.0, 0.0);
        assert_eq!(steady.push(&elsewhere, &covariance), elsewhere);
        let slowly = |ix: usize| elsewhere * Transform::translation(0.0, 1e-4 * ix as f64, 0.0);
        for ix in 0..100 {
            let average = steady.push(&slowly(ix), &covariance);
            let behind = (average.inverse() * slowly(ix)).translation.vector.norm();
            assert!(behind < 3.5e-3, "{behind} m behind what creeps");
        }
    }

    #[test]
    fn what_is_known_better_counts_more() {
        let (mut steady, there) = (Steady::default(), Transform::translation(2e-3, 0.0, 0.0));
        steady.push(&Transform::identity(), &covariance(1e-3, 1e-3));
        let average = steady.push(&there, &covariance(3e-3, 1e-3));
        assert!((average.translation.x - 2e-3 * 1.0 / (1.0 + 9.0 * AGEING)).abs() < 1e-5, "{average}");
    }
}
