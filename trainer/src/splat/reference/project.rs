//! Projection of one splat onto the image plane, and its gradient.
//!
//! Source: Zwicker et al. 2001 (EWA splatting). The Jacobian is clamped as in gsplat (Ye et al.
//! 2024). With a rolling shutter, a splat's position depends on the time at which its row is read.
//! The gradient treats this time as constant.

use super::{Projected, ProjectedGrad, Splat, SplatGrad, View, ViewGrad};
use model_files::spherical_harmonics as sh;
use nalgebra::{Matrix2, Matrix2x3, Matrix3, Matrix3x2, Vector2, Vector3};

/// Minimum alpha that is drawn.
pub const MIN_ALPHA: f64 = 1.0 / 255.0;
/// Number added to both variances on the image plane, in square pixels, so that no splat falls
/// between pixels.
pub const BLUR_PX2: f64 = 0.3;
/// Margin around the image beyond which the Jacobian is clamped, as a fraction of half the image
/// size. The value is from gsplat. Far outside the image, the linear approximation of the
/// projection would stretch splats across the whole image.
const MARGIN_FRAC: f64 = 0.3;

/// Projects a splat. Returns `None` if it is nearer than `near_m` or too transparent to draw.
///
/// Splats outside the image are also projected, but do not contribute to any pixel.
pub fn project(view: &View, splat: &Splat) -> Option<Projected> {
    let projected = project_at(view, splat, row_share(view, splat));
    // These comparisons are false for NaN, so a splat with a NaN is invisible.
    (projected.depth >= view.near_m && projected.opacity >= MIN_ALPHA).then_some(projected)
}

/// Time at which the splat's row is read, as a share of the readout. It is -0.5 for the first row
/// and 0.5 for the last row.
///
/// The row is determined with the camera's pose at the middle row, without motion. The share is 0
/// for splats that are nearer than `near_m` in that pose.
pub fn row_share(view: &View, splat: &Splat) -> f64 {
    // Behind the camera, the projection is meaningless. The motion during readout may still bring
    // the splat into view.
    let point_in_camera = view.camera_from_world * nalgebra::Point3::from(splat.mean);
    if point_in_camera.z < view.near_m {
        return 0.0;
    }
    let row_px = view.focal_px[1] * point_in_camera.y / point_in_camera.z + view.principal_px[1];
    (row_px / f64::from(view.size_px[1])).clamp(0.0, 1.0) - 0.5
}

/// Projects a splat whose row is read at `row_share`, whether or not it is visible.
pub fn project_at(view: &View, splat: &Splat, row_share: f64) -> Projected {
    let parts = Parts::new(view, splat, row_share);
    let [fx, fy] = view.focal_px;
    let [cx, cy] = view.principal_px;
    let point = parts.point_in_camera;
    let compensation = if view.is_antialiased {
        parts.compensation()
    } else {
        1.0
    };
    let opacity = sigmoid(splat.opacity_logit) * compensation;
    // This is the number of standard deviations at which alpha is `MIN_ALPHA`. It follows from
    // `opacity * exp(-reach^2 / 2) = MIN_ALPHA`. Along an axis of the image, the ellipse extends by
    // this number times the square root of the variance.
    let reach = (2.0 * (opacity / MIN_ALPHA).ln()).max(0.0).sqrt();
    Projected {
        mean_px: [fx * point.x / point.z + cx, fy * point.y / point.z + cy],
        conic: [
            parts.conic[(0, 0)],
            parts.conic[(0, 1)],
            parts.conic[(1, 1)],
        ],
        opacity,
        color: sh::color(&splat.sh, &offset_in_world(view, splat)),
        depth: point.z,
        extent_px: [
            reach * parts.cov_px2[(0, 0)].sqrt(),
            reach * parts.cov_px2[(1, 1)].sqrt(),
        ],
    }
}

/// Derivative of the splat's conditional mean in world coordinates with respect to the position of
/// a pixel, meters per pixel.
///
/// The mean of the splat given its projection is `mean + C J^T (J C J^T + B)^-1 offset_px` for the
/// covariance `C` in world, the Jacobian `J` and the low-pass `B`. Because of the low-pass, this
/// mean is always inside the ellipsoid within which the splat is drawn.
pub(super) fn mean_given_pixel(view: &View, splat: &Splat, row_share: f64) -> Matrix3x2<f64> {
    let parts = Parts::new(view, splat, row_share);
    parts.cov_in_world * parts.image_from_world.transpose() * parts.conic
}

/// Gradient with respect to the splat's raw values and the view, given the gradient with respect to
/// the projected splat.
pub fn project_backward(
    view: &View,
    splat: &Splat,
    row_share: f64,
    v: &ProjectedGrad,
) -> (SplatGrad, ViewGrad) {
    let parts = Parts::new(view, splat, row_share);
    let camera_from_world = view
        .camera_from_world
        .rotation
        .to_rotation_matrix()
        .into_inner();

    let (v_sh, v_offset) = sh::color_backward(&splat.sh, &offset_in_world(view, splat), &v.color);
    let opacity = sigmoid(splat.opacity_logit);

    // Gradients are propagated from the conic to the log scale and the rotation. `b` of the conic
    // represents two entries of the symmetric matrix, so each gets half of its gradient. For the
    // inverse M of a matrix, the derivative is `-M dC M`.
    let v_conic = Matrix2::new(v.conic[0], 0.5 * v.conic[1], 0.5 * v.conic[1], v.conic[2]);
    let v_cov = -parts.conic * v_conic * parts.conic;
    let v_image_from_world = 2.0 * v_cov * parts.image_from_world * parts.cov_in_world;
    let v_jacobian = v_image_from_world * parts.moved_from_world.transpose();
    let v_moved_from_world = parts.jacobian.transpose() * v_image_from_world;
    let v_cov_in_world = parts.image_from_world.transpose() * v_cov * parts.image_from_world;
    let (v_log_scale, v_rotation_wxyz) = shape_backward(splat, &v_cov_in_world);

    // Gradients are propagated from the image to the point in the camera frame, first at the
    // splat's row, then at the middle row.
    let mut v_point = pinhole_backward(view, &parts.point_in_camera, &v.mean_px)
        + jacobian_backward(view, &parts, &v_jacobian);
    v_point.z += v.depth;
    let v_still_point = parts.moved_from_still.transpose() * v_point;
    let v_camera_from_world = parts.moved_from_still.transpose() * v_moved_from_world;
    let v_moved_from_still = v_moved_from_world * camera_from_world.transpose()
        + v_point * parts.still_point.transpose();

    let by_splat = SplatGrad {
        mean: (camera_from_world.transpose() * v_still_point + v_offset).into(),
        log_scale: v_log_scale,
        rotation_wxyz: v_rotation_wxyz,
        opacity_logit: v.opacity * opacity * (1.0 - opacity),
        sh: v_sh,
    };
    // A motion of the camera changes the point in the camera frame and the direction from which the
    // color is evaluated.
    let v_translation = v_still_point + camera_from_world * v_offset;
    let v_rotation = parts.still_point.cross(&v_still_point)
        + by_rotation(&(v_camera_from_world * camera_from_world.transpose()));
    let by_view = ViewGrad {
        pose: [
            v_translation.x,
            v_translation.y,
            v_translation.z,
            v_rotation.x,
            v_rotation.y,
            v_rotation.z,
        ],
        linear_m: (-row_share * v_point).into(),
        angular_rad: (-row_share * by_rotation(&v_moved_from_still)).into(),
    };
    (by_splat, by_view)
}

/// Intermediate results of the projection of a splat.
struct Parts {
    /// Center in the camera frame at the middle row.
    still_point: Vector3<f64>,
    /// Center in the camera frame when the splat's row is read.
    point_in_camera: Vector3<f64>,
    /// Linear part of the transform from `still_point` to `point_in_camera`.
    moved_from_still: Matrix3<f64>,
    /// Linear part of the transform from the world to the moved camera.
    moved_from_world: Matrix3<f64>,
    cov_in_world: Matrix3<f64>,
    /// Ratios x/z and y/z as used by the Jacobian, and whether each was clamped.
    ratio: [(f64, bool); 2],
    /// Jacobian of pixels with respect to the point in the camera frame.
    jacobian: Matrix2x3<f64>,
    image_from_world: Matrix2x3<f64>,
    cov_px2: Matrix2<f64>,
    conic: Matrix2<f64>,
}

impl Parts {
    /// Opacity factor, which is the area of the ellipse without the blur divided by its area with
    /// the blur (Yu et al. 2024, equation 12).
    fn compensation(&self) -> f64 {
        let without = self.cov_px2 - Matrix2::from_diagonal_element(BLUR_PX2);
        (without.determinant().max(0.0) / self.cov_px2.determinant()).sqrt()
    }

    fn new(view: &View, splat: &Splat, row_share: f64) -> Self {
        let camera_from_world = view
            .camera_from_world
            .rotation
            .to_rotation_matrix()
            .into_inner();
        let linear_m = Vector3::from(view.linear_m);
        let angular_rad = Vector3::from(view.angular_rad);

        // With a rolling shutter, the point moves relative to the camera while the rows are read.
        // The computation is of first order in the motion. See docs/design/splats.md, section
        // "Rendering an image".
        let still_point = camera_from_world * Vector3::from(splat.mean)
            + view.camera_from_world.translation.vector;
        let point_in_camera =
            still_point - row_share * (linear_m + angular_rad.cross(&still_point));
        let moved_from_still = Matrix3::identity() - row_share * angular_rad.cross_matrix();
        let moved_from_world = moved_from_still * camera_from_world;

        // Covariance in the world: R S S^T R^T (Kerbl et al. 2023, equation 6).
        let axes = rotation_matrix(&unit(&splat.rotation_wxyz))
            * Matrix3::from_diagonal(&Vector3::from(splat.log_scale).map(f64::exp));
        let cov_in_world = axes * axes.transpose();

        // Covariance on the image plane, from C in the world: J R C R^T J^T plus the low-pass
        // (Zwicker et al. 2001).
        let z = point_in_camera.z;
        let ratio = [0, 1].map(|axis| clamped_ratio(view, axis, point_in_camera[axis] / z));
        let [fx, fy] = view.focal_px;
        let jacobian = Matrix2x3::new(
            fx / z,
            0.0,
            -fx * ratio[0].0 / z,
            0.0,
            fy / z,
            -fy * ratio[1].0 / z,
        );
        let image_from_world = jacobian * moved_from_world;
        let cov_px2 = image_from_world * cov_in_world * image_from_world.transpose()
            + Matrix2::from_diagonal_element(BLUR_PX2);
        let [a, b, c] = [cov_px2[(0, 0)], cov_px2[(0, 1)], cov_px2[(1, 1)]];
        let conic = Matrix2::new(c, -b, -b, a) / (a * c - b * b);
        Self {
            still_point,
            point_in_camera,
            moved_from_still,
            moved_from_world,
            cov_in_world,
            ratio,
            jacobian,
            image_from_world,
            cov_px2,
            conic,
        }
    }
}

/// Clamps the ratio x/z (axis 0) or y/z (axis 1) to the image plus a margin. Also returns whether
/// the ratio changed.
fn clamped_ratio(view: &View, axis: usize, ratio: f64) -> (f64, bool) {
    let focal_px = view.focal_px[axis];
    let principal_px = view.principal_px[axis];
    let size_px = f64::from(view.size_px[axis]);
    let margin = MARGIN_FRAC * 0.5 * size_px / focal_px;
    let lowest = -(principal_px / focal_px + margin);
    let highest = (size_px - principal_px) / focal_px + margin;
    (
        ratio.clamp(lowest, highest),
        ratio < lowest || ratio > highest,
    )
}

/// Propagates the gradient from the center in pixels to the point in the camera frame.
fn pinhole_backward(view: &View, point: &Vector3<f64>, v_mean_px: &[f64; 2]) -> Vector3<f64> {
    let per_z = Vector2::new(
        view.focal_px[0] * v_mean_px[0],
        view.focal_px[1] * v_mean_px[1],
    ) / point.z;
    Vector3::new(
        per_z.x,
        per_z.y,
        -(per_z.x * point.x + per_z.y * point.y) / point.z,
    )
}

/// Propagates the gradient from the Jacobian of the projection to the point in the camera frame.
///
/// Row `axis` of the Jacobian is `f / z` on the diagonal and `-f * ratio / z` in the last column.
/// `ratio` is `point / z`, or a constant if it is clamped.
fn jacobian_backward(view: &View, parts: &Parts, v_jacobian: &Matrix2x3<f64>) -> Vector3<f64> {
    let z = parts.point_in_camera.z;
    let mut v_point = Vector3::zeros();
    for axis in 0..2 {
        let (ratio, clamped) = parts.ratio[axis];
        let v_diagonal = v_jacobian[(axis, axis)];
        let v_last = v_jacobian[(axis, 2)];
        let f_per_z2 = view.focal_px[axis] / (z * z);
        // The first part is through the factors 1 / z, with a fixed ratio.
        v_point.z += f_per_z2 * (ratio * v_last - v_diagonal);
        // The second part of the gradient is through the ratio. A clamped ratio does not depend on
        // the point.
        if !clamped {
            v_point[axis] -= f_per_z2 * v_last;
            v_point.z += f_per_z2 * ratio * v_last;
        }
    }
    v_point
}

/// Propagates the gradient from the covariance in the world to the log scale and the raw
/// quaternion.
fn shape_backward(splat: &Splat, v_cov: &Matrix3<f64>) -> ([f64; 3], [f64; 4]) {
    let unit_wxyz = unit(&splat.rotation_wxyz);
    let rotation = rotation_matrix(&unit_wxyz);
    let scale = Vector3::from(splat.log_scale).map(f64::exp);
    let v_axes = 2.0 * v_cov * rotation * Matrix3::from_diagonal(&scale);
    let v_log_scale =
        std::array::from_fn(|axis| rotation.column(axis).dot(&v_axes.column(axis)) * scale[axis]);
    // Normalization removes the part of the gradient along the quaternion.
    let v_unit = rotation_matrix_backward(&unit_wxyz, &(v_axes * Matrix3::from_diagonal(&scale)));
    let along: f64 = unit_wxyz.iter().zip(v_unit).map(|(unit, v)| unit * v).sum();
    let length = length(&splat.rotation_wxyz);
    (
        v_log_scale,
        std::array::from_fn(|ix| (v_unit[ix] - unit_wxyz[ix] * along) / length),
    )
}

/// Rotation matrix of a unit quaternion.
fn rotation_matrix(&[w, x, y, z]: &[f64; 4]) -> Matrix3<f64> {
    Matrix3::new(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )
}

/// Propagates the gradient from [`rotation_matrix`] to the quaternion, whose components are treated
/// as independent.
fn rotation_matrix_backward(&[w, x, y, z]: &[f64; 4], v: &Matrix3<f64>) -> [f64; 4] {
    let even = |row, column| v[(row, column)] + v[(column, row)];
    let odd = |row, column| v[(row, column)] - v[(column, row)];
    [
        2.0 * (x * odd(2, 1) + y * odd(0, 2) + z * odd(1, 0)),
        2.0 * (y * even(0, 1) + z * even(0, 2) + w * odd(2, 1)) - 4.0 * x * (v[(1, 1)] + v[(2, 2)]),
        2.0 * (x * even(0, 1) + z * even(1, 2) + w * odd(0, 2)) - 4.0 * y * (v[(0, 0)] + v[(2, 2)]),
        2.0 * (x * even(0, 2) + y * even(1, 2) + w * odd(1, 0)) - 4.0 * z * (v[(0, 0)] + v[(1, 1)]),
    ]
}

/// Propagates the gradient from a cross-product matrix to its vector.
fn by_rotation(v: &Matrix3<f64>) -> Vector3<f64> {
    Vector3::new(
        v[(2, 1)] - v[(1, 2)],
        v[(0, 2)] - v[(2, 0)],
        v[(1, 0)] - v[(0, 1)],
    )
}

/// Vector from the camera to the splat, in the world frame.
fn offset_in_world(view: &View, splat: &Splat) -> Vector3<f64> {
    let world_from_camera = view.camera_from_world.inverse();
    Vector3::from(splat.mean) - world_from_camera.translation.vector
}

fn sigmoid(logit: f64) -> f64 {
    1.0 / (1.0 + (-logit).exp())
}

fn length(wxyz: &[f64; 4]) -> f64 {
    wxyz.iter().map(|part| part * part).sum::<f64>().sqrt()
}

fn unit(wxyz: &[f64; 4]) -> [f64; 4] {
    wxyz.map(|part| part / length(wxyz))
}
