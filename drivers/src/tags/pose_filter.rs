//! Averages poses of a mostly stationary object, and restarts when it moves.

use kinematics::{Transform, Twist, transform};
use nalgebra::{Matrix6, Vector6};

/// Maximum squared Mahalanobis distance of a new pose from the average. If the distance is larger,
/// the object is assumed to have moved. Without motion, one in 10 000 poses exceeds the maximum
/// (chi-squared distribution with 6 degrees of freedom).
const MAX_CHI_SQUARED: f64 = 27.86;
/// Information in the average decays by this factor per pose, which limits the average to about 30
/// poses. More poses would not help, because errors of the lens parameters and of measured tag
/// poses do not average out.
const FORGETTING_FACTOR: f64 = 0.97;

/// Running average of a pose.
#[derive(Clone, Debug, Default)]
pub struct StationaryPoseFilter {
    /// The average pose, and its covariance in the pose's own axes. Meters come first, then
    /// radians.
    average: Option<(Transform, Matrix6<f64>)>,
}

impl StationaryPoseFilter {
    /// Adds a pose with its covariance in its own axes (meters first, then radians). Returns the
    /// average since the last motion.
    pub fn push(&mut self, pose: &Transform, covariance: &Matrix6<f64>) -> Transform {
        let (average, covariance) = self
            .merged(pose, covariance)
            .unwrap_or((*pose, *covariance));
        self.average = Some((average, covariance));
        average
    }

    /// Merges a new pose into the average. `None` if the new pose is too far from the average.
    fn merged(
        &self,
        pose: &Transform,
        covariance: &Matrix6<f64>,
    ) -> Option<(Transform, Matrix6<f64>)> {
        let (average, average_covariance) = self.average.as_ref()?;
        // The covariance of the average is increased, so that new poses have more weight.
        let average_covariance = average_covariance / FORGETTING_FACTOR;
        let residual = transform::log(&(average.inverse() * pose), 1.0);
        let residual = Vector6::from_iterator(
            residual
                .linear_m_s
                .iter()
                .chain(&residual.angular_rad_s)
                .copied(),
        );
        // This is the Kalman filter of a constant. The covariance of the distance between average
        // and pose is the sum of both covariances.
        let innovation_inverse = (average_covariance + covariance).try_inverse()?;
        if (residual.transpose() * innovation_inverse * residual).x > MAX_CHI_SQUARED {
            return None;
        }
        // Along each axis, the average moves toward the new pose in proportion to its own
        // uncertainty. For example, distant tags determine the direction well, but the distance
        // poorly.
        let gain = average_covariance * innovation_inverse;
        let step = gain * residual;
        let twist = Twist {
            linear_m_s: step.fixed_rows::<3>(0).into(),
            angular_rad_s: step.fixed_rows::<3>(3).into(),
        };
        Some((
            average * transform::exp(&twist, 1.0),
            average_covariance - gain * average_covariance,
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn covariance(sigma_m: f64, sigma_rad: f64) -> Matrix6<f64> {
        let variance = |ix: usize| {
            if ix < 3 {
                sigma_m * sigma_m
            } else {
                sigma_rad * sigma_rad
            }
        };
        Matrix6::from_diagonal(&Vector6::from_fn(|ix, _| variance(ix)))
    }

    /// Alternates by one millimeter and one milliradian.
    fn with_noise(true_pose: &Transform, ix: usize) -> Transform {
        let by = if ix.is_multiple_of(2) { 1e-3 } else { -1e-3 };
        true_pose * Transform::new(Vector3::new(by, -by, by), Vector3::new(by, by, -by))
    }

    #[test]
    fn noise_averages_out_and_motion_is_followed() {
        let true_pose = Transform::new(Vector3::new(1.0, -2.0, 0.1), Vector3::new(0.1, 0.2, -0.7));
        let (mut steady, covariance) = (StationaryPoseFilter::default(), covariance(1e-3, 1e-3));
        let mut residual = [0.0; 60];
        for (ix, residual) in residual.iter_mut().enumerate() {
            let average = steady.push(&with_noise(&true_pose, ix), &covariance);
            *residual = (average.inverse() * true_pose).translation.vector.norm();
        }
        assert!(residual[0] > 1.7e-3 && residual[59] < 1e-4, "{residual:?}");
        let moved_pose = true_pose * Transform::translation(0.02, 0.0, 0.0);
        assert_eq!(steady.push(&moved_pose, &covariance), moved_pose);
        let drifting = |ix: usize| moved_pose * Transform::translation(0.0, 1e-4 * ix as f64, 0.0);
        for ix in 0..100 {
            let average = steady.push(&drifting(ix), &covariance);
            let lag_m = (average.inverse() * drifting(ix)).translation.vector.norm();
            assert!(lag_m < 3.5e-3, "lags behind a slow motion by {lag_m} m");
        }
    }

    #[test]
    fn lower_covariance_weighs_more() {
        let (mut steady, second_pose) = (
            StationaryPoseFilter::default(),
            Transform::translation(2e-3, 0.0, 0.0),
        );
        steady.push(&Transform::identity(), &covariance(1e-3, 1e-3));
        let average = steady.push(&second_pose, &covariance(3e-3, 1e-3));
        assert!(
            (average.translation.x - 2e-3 * 1.0 / (1.0 + 9.0 * FORGETTING_FACTOR)).abs() < 1e-5,
            "{average}"
        );
    }
}
