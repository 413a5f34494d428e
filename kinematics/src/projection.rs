//! Derivatives of a projection with respect to the point and to the intrinsics.

use crate::camera::{Intrinsics, Lens};
use crate::lens;
use nalgebra::{Matrix2x3, SMatrix, Vector2, Vector3};

/// Maximum number of parameters of a camera, which are two focal lengths, the principal point, and
/// eight coefficients.
pub const MAX_INTRINSICS_PARAMS: usize = 12;

/// A projected point and the derivatives of its pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Projection {
    /// Position in the image, pixels.
    pub pixel: [f64; 2],
    /// Derivative with respect to the point in the camera frame, pixels per meter.
    pub by_point: Matrix2x3<f64>,
    /// Derivative with respect to the intrinsics, in the order of [`Intrinsics::params`]. Columns
    /// beyond the number of parameters are zero.
    pub by_intrinsics: SMatrix<f64, 2, MAX_INTRINSICS_PARAMS>,
}

impl Intrinsics {
    /// The parameters as a vector: focal length x and y, principal point x and y, then the
    /// coefficients of the lens. The coefficients are left out if the image is rectified.
    pub fn params(&self) -> Vec<f64> {
        let lens = self.lens_in_use();
        self.focal_px
            .iter()
            .chain(&self.principal_px)
            .chain(lens.coefficients())
            .copied()
            .collect()
    }

    /// These intrinsics with other parameters, in the order of [`Intrinsics::params`].
    ///
    /// # Panics
    /// Panics if `params` has another length than [`Intrinsics::params`].
    #[must_use]
    pub fn with_params(&self, params: &[f64]) -> Self {
        assert_eq!(params.len(), self.params().len(), "one value per parameter");
        let (plane, coefficients) = params.split_at(4);
        let mut lens = self.lens;
        match &mut lens {
            // The coefficients of a rectified image are not parameters, and stay as they are.
            _ if self.rectified => (),
            Lens::Pinhole => (),
            Lens::BrownConrady(k) => k.copy_from_slice(coefficients),
            Lens::KannalaBrandt(k) => k.copy_from_slice(coefficients),
            Lens::RationalBrownConrady(k) => k.copy_from_slice(coefficients),
        }
        Self {
            focal_px: [plane[0], plane[1]],
            principal_px: [plane[2], plane[3]],
            lens,
            ..*self
        }
    }

    /// Like [`Intrinsics::project_with_jacobian`], and also returns the derivative of the pixel
    /// with respect to the intrinsics.
    pub fn project_with_derivatives(&self, point_in_camera: &Vector3<f64>) -> Option<Projection> {
        let &[x, y, z] = point_in_camera.as_ref();
        // NaN is checked explicitly, because every comparison with NaN is false.
        if z.is_nan() || z <= 0.0 {
            return None;
        }
        let plane = Vector2::new(x / z, y / z);
        let lens = self.lens_in_use();
        let distorted = lens.distort(plane)?;
        let pixel = self.pixel_at(distorted.value)?;
        let plane_by_point = Matrix2x3::new(1.0, 0.0, -plane.x, 0.0, 1.0, -plane.y) / z;
        // The chain rule multiplies three derivatives. The first is the derivative of the pixel by
        // the distorted point. The second is the derivative of the distorted point by the point of
        // the plane `z = 1`. The third is the derivative of the point of the plane by the point in
        // space.
        let mut by_point = distorted.jacobian * plane_by_point;
        let mut by_intrinsics = SMatrix::<f64, 2, MAX_INTRINSICS_PARAMS>::zeros();
        // First, compute the derivatives of the distorted point, which do not depend on focal
        // lengths and principal point.
        match &lens {
            Lens::Pinhole => (),
            Lens::BrownConrady(_) => set_coefficients(
                &mut by_intrinsics,
                &lens::brown_conrady_by_coefficients(plane),
            ),
            Lens::KannalaBrandt(_) => set_coefficients(
                &mut by_intrinsics,
                &lens::kannala_brandt_by_coefficients(plane),
            ),
            Lens::RationalBrownConrady(k) => set_coefficients(
                &mut by_intrinsics,
                &lens::rational_by_coefficients(k, plane),
            ),
        }
        // Then compute the derivatives of `pixel = focal_px * distorted + principal_px` by the
        // chain rule.
        for axis in 0..2 {
            by_point.row_mut(axis).scale_mut(self.focal_px[axis]);
            by_intrinsics.row_mut(axis).scale_mut(self.focal_px[axis]);
            by_intrinsics[(axis, axis)] = distorted.value[axis];
            by_intrinsics[(axis, 2 + axis)] = 1.0;
        }
        Some(Projection {
            pixel,
            by_point,
            by_intrinsics,
        })
    }
}

/// Sets the columns of the lens coefficients, which follow the four columns of focal lengths and
/// principal point.
fn set_coefficients(
    by_intrinsics: &mut SMatrix<f64, 2, MAX_INTRINSICS_PARAMS>,
    derivatives: &[Vector2<f64>],
) {
    for (ix, derivative) in derivatives.iter().enumerate() {
        by_intrinsics.set_column(4 + ix, derivative);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cameras() -> Vec<Intrinsics> {
        let lenses = [
            Lens::Pinhole,
            Lens::BrownConrady([-0.28, 0.07, 0.001, -0.0005, 0.02]),
            Lens::KannalaBrandt([-0.01, 0.02, -0.015, 0.003]),
            Lens::RationalBrownConrady([0.4, -0.1, 0.001, -0.0005, 0.01, 0.7, -0.02, 0.03]),
        ];
        let camera = |lens| Intrinsics {
            size_px: [640, 480],
            focal_px: [600.0, 580.0],
            principal_px: [321.5, 238.25],
            lens,
            rectified: false,
        };
        lenses.map(camera).into()
    }

    #[test]
    fn derivatives_with_respect_to_intrinsics_match_central_differences() {
        const NUDGE: f64 = 1e-6;
        // The projection is linear in all parameters except the parameters of the denominator.
        // Rounding errors of 1e-13 / 1e-6 remain. For the denominator, there are also truncation
        // errors of 1e-12 times the focal length.
        const CLOSE: f64 = 1e-6;
        for camera in cameras() {
            let params = camera.params();
            for point in [
                [0.3, -0.2, 1.5],
                [0.0, 0.0, 0.7],
                [-0.4, 0.35, 1.1],
                [1e-9, 0.0, 1.0],
            ] {
                let point = Vector3::from(point);
                let projection = camera.project_with_derivatives(&point).unwrap();
                let (pixel, by_point) = camera.project_with_jacobian(&point).unwrap();
                assert_eq!((projection.pixel, projection.by_point), (pixel, by_point));
                for (ix, column) in projection.by_intrinsics.column_iter().enumerate() {
                    let at = |nudge: f64| {
                        let mut params = params.clone();
                        params
                            .iter_mut()
                            .skip(ix)
                            .take(1)
                            .for_each(|value| *value += nudge);
                        Vector2::from(camera.with_params(&params).project(&point).unwrap())
                    };
                    let numeric = (at(NUDGE) - at(-NUDGE)) / (2.0 * NUDGE);
                    let off = (column - numeric).norm();
                    assert!(
                        off < CLOSE,
                        "{:?} {point:?} parameter {ix} is off by {off}",
                        camera.lens
                    );
                }
            }
        }
    }

    #[test]
    fn parameters_round_trip() {
        for camera in cameras() {
            let params = camera.params();
            assert_eq!(params.len(), 4 + camera.lens.coefficients().len());
            assert_eq!(camera.with_params(&params), camera);
            let rectified = camera.undistorted();
            assert_eq!(rectified.params().len(), 4);
            let point = Vector3::new(0.1, 0.2, 1.0);
            assert_eq!(
                rectified
                    .project_with_derivatives(&point)
                    .unwrap()
                    .by_intrinsics
                    .column(4)
                    .norm(),
                0.0
            );
        }
    }
}
