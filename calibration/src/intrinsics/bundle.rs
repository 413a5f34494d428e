//! The reprojection errors of all images as a function of the intrinsics and the poses of the
//! target.

use super::board_pose;
use super::coefficients::Coefficients;
use crate::least_squares::{BlockSums, Problem};
use crate::{BoardPoint, Error, least_squares};
use kinematics::{Intrinsics, MAX_INTRINSICS_PARAMS, Transform};
use least_squares::{Fit, Loss, Options};
use nalgebra::{DVector, Point3, Vector2, Vector6};

/// Minimum noise of corner detectors, pixels.
pub(super) const MIN_NOISE_PX: f64 = 0.005;

/// Models with nearly redundant coefficients take the most steps.
const MAX_STEPS: usize = 60;

/// Intrinsics and the pose `camera_from_board` in each image.
#[derive(Clone, Debug)]
pub(super) struct Bundle {
    pub(super) intrinsics: Intrinsics,
    pub(super) poses: Vec<Transform>,
}

impl Bundle {
    /// Distances between detected and projected points, pixels. A distance is infinite if the lens
    /// cannot image the point.
    pub(super) fn errors_px(&self, image_ix: usize, points: &[BoardPoint]) -> Vec<f64> {
        let error_px = |point: &BoardPoint| {
            let in_camera = self.poses[image_ix] * Point3::from(point.point_in_board);
            let [u, v] = self.intrinsics.project(&in_camera.coords)?;
            Some(Vector2::new(point.pixel[0] - u, point.pixel[1] - v).norm())
        };
        points
            .iter()
            .map(|point| error_px(point).unwrap_or(f64::INFINITY))
            .collect()
    }

    /// The images with these indices only.
    pub(super) fn with_images(&self, image_ixs: impl Iterator<Item = usize>) -> Self {
        Self {
            intrinsics: self.intrinsics.clone(),
            poses: image_ixs.map(|ix| self.poses[ix]).collect(),
        }
    }
}

/// Minimizes the reprojection error over the focal lengths, the principal point, the given
/// coefficients and all poses.
///
/// * `images`: points of each image, in the order of the poses.
/// * `tolerance`: see [`Options::tolerance`].
///
/// # Errors
/// Fails as [`least_squares::minimize`] does.
pub(super) fn refine(
    images: &[&[BoardPoint]],
    start: Bundle,
    coefficients: Coefficients,
    loss: Loss,
    tolerance: f64,
) -> Result<Fit<Bundle>, Error> {
    let problem = Reprojection {
        images,
        params: coefficients.params(),
        scales: coefficients.scales(&start.intrinsics),
    };
    let options = Options {
        loss,
        tolerance,
        max_steps: MAX_STEPS,
        min_noise: MIN_NOISE_PX,
    };
    least_squares::minimize(&problem, start, &options)
}

/// The least-squares problem. Each image is one block, whose local parameters are the pose of the
/// target.
struct Reprojection<'a> {
    images: &'a [&'a [BoardPoint]],
    /// Indices of the estimated parameters in [`Intrinsics::params`].
    params: Vec<usize>,
    scales: DVector<f64>,
}

impl Problem for Reprojection<'_> {
    type State = Bundle;

    fn scales(&self) -> DVector<f64> {
        self.scales.clone()
    }

    fn n_blocks(&self) -> usize {
        self.images.len()
    }

    fn n_local(&self, _block_ix: usize) -> usize {
        6
    }

    fn evaluate(&self, bundle: &Bundle, image_ix: usize, sums: &mut BlockSums) -> Option<()> {
        let pose = &bundle.poses[image_ix];
        let n_params = self.params.len();
        for point in self.images[image_ix] {
            let in_camera = (pose * Point3::from(point.point_in_board)).coords;
            let projection = bundle.intrinsics.project_with_derivatives(&in_camera)?;
            let by_rotation =
                projection.by_point * board_pose::by_rotation(pose, &point.point_in_board);
            // The arrays are on the stack, because this code runs for every corner in every step.
            let mut rows = [[0.0; MAX_INTRINSICS_PARAMS + 6]; 2];
            for (axis, row) in rows.iter_mut().enumerate() {
                for (derivative, param) in row.iter_mut().zip(&self.params) {
                    *derivative = projection.by_intrinsics[(axis, *param)];
                }
                for column in 0..3 {
                    row[n_params + column] = by_rotation[(axis, column)];
                    row[n_params + 3 + column] = projection.by_point[(axis, column)];
                }
            }
            let residual = [0, 1].map(|axis| projection.pixel[axis] - point.pixel[axis]);
            sums.add(
                residual,
                [&rows[0][..n_params + 6], &rows[1][..n_params + 6]],
            );
        }
        Some(())
    }

    fn moved(&self, bundle: &Bundle, shared: &DVector<f64>, local: &[DVector<f64>]) -> Bundle {
        let mut params = bundle.intrinsics.params();
        for (param, step) in self.params.iter().zip(shared.iter()) {
            params[*param] += step;
        }
        let step = |(pose, step): (&Transform, &DVector<f64>)| {
            board_pose::moved(pose, &Vector6::from_column_slice(step.as_slice()))
        };
        let poses = bundle.poses.iter().zip(local).map(step).collect();
        Bundle {
            intrinsics: bundle.intrinsics.with_params(&params),
            poses,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{
        board, brown_conrady_camera, fisheye_camera, observe, rational_camera,
    };
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn derivatives_match_central_differences() {
        const NUDGE: f64 = 1e-6;
        // The tolerance is relative to the norm of the gradient. Truncation and rounding errors are
        // 1e-9 of this norm.
        const REL: f64 = 1e-6;
        for (camera, coefficients) in [
            (brown_conrady_camera(), Coefficients::BROWN_CONRADY),
            (fisheye_camera(), Coefficients::KANNALA_BRANDT),
            (rational_camera(), Coefficients::RATIONAL),
        ] {
            let pose = Transform::new(
                Vector3::new(-0.05, -0.08, 0.5),
                Vector3::new(0.4, -0.3, 0.6),
            );
            let mut points = observe(&camera, &pose, &board());
            // The residuals are a few pixels, so that the gradient is not zero.
            points
                .iter_mut()
                .enumerate()
                .for_each(|(ix, point)| point.pixel[ix % 2] += ix as f64 * 0.1);
            let images = [&points[..]];
            let params = coefficients.params();
            let scales = coefficients.scales(&camera);
            let n_params = params.len();
            let problem = Reprojection {
                images: &images,
                params,
                scales,
            };
            let bundle = Bundle {
                intrinsics: camera,
                poses: vec![pose],
            };
            let cost = |step: &DVector<f64>| {
                let local = [step.rows(n_params, 6).into_owned()];
                let moved = problem.moved(&bundle, &step.rows(0, n_params).into_owned(), &local);
                let errors = moved.errors_px(0, &points);
                0.5 * errors.iter().map(|error| error * error).sum::<f64>()
            };
            let mut sums = BlockSums::new(Loss::Squared, n_params, 6);
            problem.evaluate(&bundle, 0, &mut sums).unwrap();
            for ix in 0..n_params + 6 {
                let mut step = DVector::zeros(n_params + 6);
                step[ix] = NUDGE;
                let numeric = (cost(&step) - cost(&-&step)) / (2.0 * NUDGE);
                let analytic = sums.gradient()[ix];
                let allowed = REL * (1.0 + analytic.abs().max(numeric.abs()));
                assert!(
                    (analytic - numeric).abs() < allowed,
                    "{coefficients:?} {ix}: {analytic} {numeric}"
                );
            }
        }
    }
}
