//! Uncertainty of estimated extrinsics, per camera and between cameras.

use super::AlignmentScene;
use super::layout::CalibrationParam;
use super::solve::Solution;
use kinematics::{Transform, Twist};
use nalgebra::{DMatrix, DVector, Matrix6, Vector3, Vector6};

/// Joint covariance of the extrinsics of all cameras that were estimated.
#[derive(Clone, Debug, PartialEq)]
pub struct ExtrinsicsCovariance {
    /// Names of the cameras.
    pub cameras: Vec<String>,
    /// For each camera, three translations (meters), then three rotations (radians), along and
    /// about its own axes.
    pub covariance: DMatrix<f64>,
}

/// Standard deviations of a pose along and about the axes of a camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSigmas {
    /// Translation, meters.
    pub m: [f64; 3],
    /// Rotation, radians.
    pub rad: [f64; 3],
}

impl PoseSigmas {
    fn of(covariance: &Matrix6<f64>) -> Self {
        let sigma = |ix: usize| covariance[(ix, ix)].max(0.0).sqrt();
        Self {
            m: [0, 1, 2].map(sigma),
            rad: [3, 4, 5].map(sigma),
        }
    }
}

/// Variance of the sum of two parameters.
fn variance_of_sum(solution: &Solution, n_params: usize, [a, b]: [usize; 2]) -> f64 {
    let mut weights = DVector::zeros(n_params);
    weights[a] += 1.0;
    weights[b] += 1.0;
    solution.variance(&weights)
}

impl ExtrinsicsCovariance {
    /// `None` if no extrinsics were estimated.
    pub(super) fn of(
        scene: &AlignmentScene,
        params: &[CalibrationParam],
        solution: &Solution,
    ) -> Option<Self> {
        let first = |(ix, param): (usize, &CalibrationParam)| match param {
            CalibrationParam::Extrinsics(camera, 0) => {
                Some((scene.cameras[*camera].to_string(), ix))
            }
            _ => None,
        };
        let (cameras, begins): (Vec<String>, Vec<usize>) =
            params.iter().enumerate().filter_map(first).unzip();
        (!cameras.is_empty()).then_some(())?;
        let ixs: Vec<usize> = begins.iter().flat_map(|begin| *begin..begin + 6).collect();
        // The solution returns variances of weighted sums of parameters. A covariance is computed
        // from the variance of the sum of two parameters. On the diagonal, the sum of a parameter
        // and itself has four times the variance of the parameter.
        let own: Vec<f64> = ixs
            .iter()
            .map(|ix| variance_of_sum(solution, params.len(), [*ix, *ix]) / 4.0)
            .collect();
        let covariance = DMatrix::from_fn(ixs.len(), ixs.len(), |row, column| {
            if row == column {
                own[row]
            } else {
                let sum = variance_of_sum(solution, params.len(), [ixs[row], ixs[column]]);
                0.5 * (sum - own[row] - own[column])
            }
        });
        Some(Self {
            covariance,
            cameras,
        })
    }

    /// Standard deviations of the pose of a camera in its parent frame. `None` if it was not
    /// estimated.
    pub fn of_camera(&self, camera: &str) -> Option<PoseSigmas> {
        let ix = self.ix(camera)?;
        Some(PoseSigmas::of(&self.block(ix, ix)))
    }

    /// Covariance of the extrinsics of a camera: translations (meters), then rotations (radians),
    /// along and about its own axes. `None` if they were not estimated.
    pub(super) fn matrix_of(&self, camera: &str) -> Option<Matrix6<f64>> {
        let ix = self.ix(camera)?;
        Some(self.block(ix, ix))
    }

    /// Standard deviations of the pose of a camera in the frame of another camera with the same
    /// parent, along and about its own axes. `None` if one of the two poses was not estimated.
    pub fn between(
        &self,
        first: &str,
        other: &str,
        first_from_other: &Transform,
    ) -> Option<PoseSigmas> {
        let first = self.ix(first)?;
        let other = self.ix(other)?;
        // A motion of the first camera moves the other camera in the opposite direction.
        let mut by_first = Matrix6::zeros();
        for part in 0..6 {
            let unit =
                |begin: usize| Vector3::from_fn(|row, _| f64::from(u8::from(begin + row == part)));
            let moved = Twist {
                linear_m_s: unit(0),
                angular_rad_s: unit(3),
            }
            .of_attached(first_from_other);
            let [v, w] = [moved.linear_m_s, moved.angular_rad_s];
            by_first.set_column(part, &-Vector6::new(v.x, v.y, v.z, w.x, w.y, w.z));
        }
        let cross = by_first * self.block(first, other);
        let own = by_first * self.block(first, first) * by_first.transpose();
        Some(PoseSigmas::of(
            &(own + cross + cross.transpose() + self.block(other, other)),
        ))
    }

    fn ix(&self, camera: &str) -> Option<usize> {
        self.cameras.iter().position(|name| name == camera)
    }

    fn block(&self, row: usize, column: usize) -> Matrix6<f64> {
        self.covariance
            .fixed_view::<6, 6>(6 * row, 6 * column)
            .into_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two cameras, the second 1 m along the x axis of the first.
    fn pair(correlation: f64) -> (ExtrinsicsCovariance, Transform) {
        let variances = DVector::from_fn(12, |ix, _| if ix % 6 < 3 { 1e-6 } else { 1e-8 });
        let mut covariance = DMatrix::from_diagonal(&variances);
        for ix in 0..6 {
            covariance[(ix, ix + 6)] = correlation * variances[ix];
            covariance[(ix + 6, ix)] = correlation * variances[ix];
        }
        let cameras = vec!["left".to_owned(), "right".to_owned()];
        (
            ExtrinsicsCovariance {
                cameras,
                covariance,
            },
            Transform::translation(1.0, 0.0, 0.0),
        )
    }

    #[test]
    fn independent_errors_add_up_and_common_ones_cancel() {
        let (covariance, left_from_right) = pair(0.0);
        assert_eq!(
            covariance.of_camera("right"),
            Some(PoseSigmas {
                m: [1e-3; 3],
                rad: [1e-4; 3]
            })
        );
        let sigmas = covariance
            .between("left", "right", &left_from_right)
            .expect("both were estimated");
        // A rotation of the first camera moves the second camera along y and z, by the angle times
        // the distance of 1 m.
        let expected_m = [2e-6f64.sqrt(), 2.01e-6f64.sqrt(), 2.01e-6f64.sqrt()];
        for (axis, expected_m) in expected_m.into_iter().enumerate() {
            assert!((sigmas.m[axis] - expected_m).abs() < 1e-12, "{sigmas:?}");
            assert!(
                (sigmas.rad[axis] - 2e-8f64.sqrt()).abs() < 1e-12,
                "{sigmas:?}"
            );
        }
        let (covariance, left_from_right) = pair(1.0);
        let sigmas = covariance
            .between("left", "right", &left_from_right)
            .expect("both were estimated");
        assert!(
            sigmas.m[0] < 1e-9 && (sigmas.m[1] - 1e-4).abs() < 1e-9 && sigmas.rad[0] < 1e-9,
            "{sigmas:?}"
        );
        assert_eq!(covariance.between("left", "top", &left_from_right), None);
    }
}
