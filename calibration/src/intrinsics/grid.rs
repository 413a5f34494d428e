//! Values on a regular grid over the image, such as the coverage by corners and the projection
//! uncertainty.

use kinematics::{Intrinsics, Projection};
use nalgebra::{DMatrix, Matrix2, Matrix2x3, Matrix3, Matrix3xX, SMatrix, Vector3};

/// Values in equal cells of the image.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageGrid<T> {
    /// Number of cells along x.
    pub n_columns: usize,
    /// Number of cells along y.
    pub n_rows: usize,
    /// One value per cell, row by row from the upper left.
    pub values: Vec<T>,
}

/// The grid has the aspect ratio of common images, 16:9. With more cells, more images are needed to
/// cover them.
const N_COLUMNS: usize = 16;
const N_ROWS: usize = 9;

impl ImageGrid<usize> {
    /// Number of corners in each part of an image.
    pub fn coverage(size_px: [u32; 2], pixels: impl Iterator<Item = [f64; 2]>) -> Self {
        coverage(size_px, pixels)
    }
}

/// See [`ImageGrid::coverage`].
fn coverage(size_px: [u32; 2], pixels: impl Iterator<Item = [f64; 2]>) -> ImageGrid<usize> {
    let mut values = vec![0; N_COLUMNS * N_ROWS];
    for [x, y] in pixels {
        let [width, height] = size_px.map(f64::from);
        let column = x / width * N_COLUMNS as f64;
        let row = y / height * N_ROWS as f64;
        if (0.0..N_COLUMNS as f64).contains(&column) && (0.0..N_ROWS as f64).contains(&row) {
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "a cell of the grid"
            )]
            let cell = row as usize * N_COLUMNS + column as usize;
            values[cell] += 1;
        }
    }
    ImageGrid {
        n_columns: N_COLUMNS,
        n_rows: N_ROWS,
        values,
    }
}

/// Centers of the cells, pixels.
fn centers(size_px: [u32; 2]) -> impl Iterator<Item = [f64; 2]> + Clone {
    let [width, height] = size_px.map(f64::from);
    (0..N_ROWS).flat_map(move |row| {
        (0..N_COLUMNS).map(move |column| {
            [
                (column as f64 + 0.5) / N_COLUMNS as f64 * width,
                (row as f64 + 0.5) / N_ROWS as f64 * height,
            ]
        })
    })
}

/// Standard deviation of a pixel in the worst direction, from its derivatives with respect to
/// parameters with this covariance.
fn sigma_px(derivatives: &DMatrix<f64>, covariance: &DMatrix<f64>) -> f64 {
    let product = derivatives * covariance * derivatives.transpose();
    let [a, b, c] = [product[(0, 0)], product[(0, 1)], product[(1, 1)]];
    let eigenvalues = Matrix2::new(a, b, b, c).symmetric_eigenvalues();
    eigenvalues.max().max(0.0).sqrt()
}

/// Derivatives of the projection of distant points with respect to the intrinsics, at the centers
/// of the cells.
///
/// A change of the intrinsics has a similar effect as a rotation of the camera frame, and the poses
/// of the target absorb such a rotation. Each change is therefore compensated by the rotation that
/// minimizes the sum of the squared displacements over the grid.
#[derive(Clone, Debug)]
pub(super) struct ProjectionDerivatives {
    /// One matrix per cell, `[2, n_params]`, pixels. `None` where the lens model ends.
    cells: Vec<Option<DMatrix<f64>>>,
}

impl ProjectionDerivatives {
    /// * `params`: indices of the estimated parameters in [`Intrinsics::params`].
    pub(super) fn new(intrinsics: &Intrinsics, params: &[usize]) -> Self {
        let uncompensated: Vec<Option<(DMatrix<f64>, Matrix2x3<f64>)>> =
            centers(intrinsics.size_px)
                .map(|pixel| {
                    let direction = intrinsics.unproject(pixel)?.normalize();
                    let Projection {
                        by_point,
                        by_intrinsics,
                        ..
                    } = intrinsics.project_with_derivatives(&direction)?;
                    let by_params = DMatrix::from_fn(2, params.len(), |row, column| {
                        by_intrinsics[(row, params[column])]
                    });
                    Some((by_params, by_point * -direction.cross_matrix()))
                })
                .collect();
        // One least-squares problem per parameter, all with the same normal matrix.
        let mut normal_matrix = Matrix3::zeros();
        let mut rhs = Matrix3xX::zeros(params.len());
        for (by_params, by_rotation) in uncompensated.iter().flatten() {
            normal_matrix += by_rotation.tr_mul(by_rotation);
            rhs += by_rotation.transpose() * by_params;
        }
        // The inverse does not exist if the lens images no cell. In that case, no rotation is
        // needed.
        let inverse = normal_matrix.try_inverse().unwrap_or_else(Matrix3::zeros);
        let rotation_by_params = -(inverse * rhs);
        let mut cells = Vec::with_capacity(uncompensated.len());
        for cell in uncompensated {
            cells.push(cell.map(|(by_params, by_rotation)| {
                let by_rotation = by_rotation * &rotation_by_params;
                DMatrix::from_fn(2, params.len(), |row, column| {
                    by_params[(row, column)] + by_rotation[(row, column)]
                })
            }));
        }
        Self { cells }
    }

    /// Standard deviation in the worst direction of the image, pixels.
    pub(super) fn sigmas_px(&self, covariance: &DMatrix<f64>) -> ImageGrid<Option<f64>> {
        let values = self
            .cells
            .iter()
            .map(|cell| Some(sigma_px(cell.as_ref()?, covariance)))
            .collect();
        ImageGrid {
            n_columns: N_COLUMNS,
            n_rows: N_ROWS,
            values,
        }
    }

    /// Matrix `W` so that the variance along one axis of the image, averaged over both axes and all
    /// cells, is the trace of `W` times the covariance.
    pub(super) fn mean_square(&self) -> Option<DMatrix<f64>> {
        let n_cells = self.cells.iter().flatten().count();
        let sum = self
            .cells
            .iter()
            .flatten()
            .map(|cell| cell.tr_mul(cell))
            .reduce(|sum, product| sum + product)?;
        Some(sum / (2 * n_cells) as f64)
    }

    #[cfg(test)]
    pub(super) fn displacements_px(
        &self,
        change: &nalgebra::DVector<f64>,
    ) -> Vec<Option<nalgebra::DVector<f64>>> {
        self.cells
            .iter()
            .map(|cell| cell.as_ref().map(|cell| cell * change))
            .collect()
    }
}

/// Distances between the projections of distant points by two calibrations, pixels. The camera
/// frame of one calibration is first rotated such that these distances are smallest. `None` where
/// one of the lens models ends.
#[cfg(test)]
pub(super) fn displacements_px(
    from: &Intrinsics,
    to: &Intrinsics,
) -> Vec<Option<nalgebra::Vector2<f64>>> {
    use nalgebra::{Rotation3, Vector2};
    let directions: Vec<_> = centers(from.size_px)
        .map(|pixel| from.unproject(pixel))
        .collect();
    let mut rotation = Rotation3::identity();
    let displacement = |rotation: &Rotation3<f64>, direction: &Option<Vector3<f64>>| {
        let direction = (*direction)?;
        let ([x, y], by_point) = to.project_with_jacobian(&(rotation * direction))?;
        let [u, v] = from.project(&direction)?;
        Some((
            Vector2::new(x - u, y - v),
            by_point * -(rotation * direction).cross_matrix(),
        ))
    };
    for _ in 0..5 {
        let (mut normal_matrix, mut rhs) = (Matrix3::zeros(), Vector3::zeros());
        for (residual, by_rotation) in directions
            .iter()
            .filter_map(|direction| displacement(&rotation, direction))
        {
            normal_matrix += by_rotation.tr_mul(&by_rotation);
            rhs += by_rotation.tr_mul(&residual);
        }
        rotation = Rotation3::new(-(normal_matrix.try_inverse().unwrap() * rhs)) * rotation;
    }
    directions
        .iter()
        .map(|direction| displacement(&rotation, direction).map(|(residual, _)| residual))
        .collect()
}

/// Information of one image about the estimated intrinsics when its pose is free, for residuals of
/// unit variance. `None` if a point is outside the image.
pub(super) fn information(
    intrinsics: &Intrinsics,
    params: &[usize],
    camera_from_board: &kinematics::Transform,
    points_in_board: &[Vector3<f64>],
) -> Option<DMatrix<f64>> {
    let n = params.len();
    let mut shared = DMatrix::zeros(n, n);
    let mut cross = DMatrix::zeros(6, n);
    let mut local = SMatrix::<f64, 6, 6>::zeros();
    for point in points_in_board {
        let in_camera = (camera_from_board * nalgebra::Point3::from(*point)).coords;
        let projection = intrinsics
            .project_with_derivatives(&in_camera)
            .filter(|p| intrinsics.contains(p.pixel))?;
        let by_rotation =
            projection.by_point * super::board_pose::by_rotation(camera_from_board, point);
        let by_params = DMatrix::from_fn(2, n, |row, column| {
            projection.by_intrinsics[(row, params[column])]
        });
        let mut by_pose = SMatrix::<f64, 2, 6>::zeros();
        by_pose.fixed_columns_mut::<3>(0).copy_from(&by_rotation);
        by_pose
            .fixed_columns_mut::<3>(3)
            .copy_from(&projection.by_point);
        shared.gemm_tr(1.0, &by_params, &by_params, 1.0);
        cross.gemm_tr(1.0, &by_pose, &by_params, 1.0);
        local += by_pose.tr_mul(&by_pose);
    }
    // The Schur complement is the information about the intrinsics that remains after the pose of
    // the image is estimated.
    let eliminated = local.cholesky()?.solve(&cross);
    Some(shared - cross.transpose() * eliminated)
}

#[cfg(test)]
mod tests {
    use super::super::tests::brown_conrady_camera;
    use super::*;
    use nalgebra::DVector;

    #[test]
    fn coverage_counts_corners_in_cells() {
        let pixels = [
            [0.0, 0.0],
            [39.9, 53.0],
            [40.1, 0.0],
            [639.9, 479.9],
            [640.0, 0.0],
            [-0.1, 5.0],
            [f64::NAN, 1.0],
        ];
        let grid = coverage([640, 480], pixels.into_iter());
        assert_eq!(grid.values.iter().sum::<usize>(), 4);
        assert_eq!(
            (grid.values[0], grid.values[1], grid.values[143]),
            (2, 1, 1)
        );
    }

    #[test]
    fn linear_displacements_match_the_difference_of_two_cameras() {
        // Displacements are up to 0.2 px. The changes of the parameters are about 1e-3, so the
        // relative errors due to second-order terms are also about 1e-3.
        const CLOSE_PX: f64 = 1e-3;
        let camera = brown_conrady_camera();
        let params: Vec<usize> = (0..9).collect();
        let change =
            DVector::from_column_slice(&[0.2, -0.1, 0.3, -0.2, 3e-4, -1e-3, 1e-5, -1e-5, 1e-3]);
        let moved: Vec<f64> = camera
            .params()
            .iter()
            .zip(&change)
            .map(|(value, change)| value + change)
            .collect();
        let exact = displacements_px(&camera, &camera.with_params(&moved));
        let linear = ProjectionDerivatives::new(&camera, &params).displacements_px(&change);
        let mut largest: f64 = 0.0;
        for (exact, linear) in exact.iter().zip(&linear) {
            let (exact, linear) = (exact.unwrap(), linear.as_ref().unwrap());
            assert!(
                (exact[0] - linear[0]).hypot(exact[1] - linear[1]) < CLOSE_PX,
                "{exact} {linear}"
            );
            largest = largest.max(exact.norm());
        }
        assert!(largest > 0.1, "{largest}");
    }

    #[test]
    fn rotations_of_the_camera_are_not_uncertainty() {
        // For a long focal length, moving the principal point by 1 px has almost the same effect as
        // a rotation.
        let camera = Intrinsics {
            focal_px: [6000.0; 2],
            lens: kinematics::Lens::Pinhole,
            ..brown_conrady_camera()
        };
        let derivatives = ProjectionDerivatives::new(&camera, &[2, 3]);
        let sigmas = derivatives.sigmas_px(&DMatrix::identity(2, 2));
        assert!(
            sigmas.values.iter().flatten().all(|sigma| *sigma < 0.01),
            "{:?}",
            sigmas.values
        );
    }
}
