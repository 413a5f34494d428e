//! Camera models. Pixel `(0, 0)` covers `[0,1) x [0,1)`. Camera axes are x right, y down, z
//! forward.

use crate::Error;
use crate::lens;
use nalgebra::{Matrix2x3, Vector2, Vector3};

/// Lens parameters of one camera at one image size.
#[derive(Clone, Debug, PartialEq)]
pub struct Intrinsics {
    /// Width and height in pixels.
    pub size_px: [u32; 2],
    /// Focal length along x and y, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels. The center of pixel `(0, 0)` is `(0.5, 0.5)`.
    pub principal_px: [f64; 2],
    /// Lens distortion.
    pub lens: Lens,
    /// Whether the image is already undistorted. If so, the lens coefficients are ignored.
    pub rectified: bool,
}

/// Lens distortion.
///
/// ```
/// use kinematics::{Intrinsics, Lens};
///
/// let fisheye = Intrinsics {
///     size_px: [640, 480],
///     focal_px: [300.0, 300.0],
///     principal_px: [320.0, 240.0],
///     lens: Lens::KannalaBrandt([-0.01, 0.002, 0.0, 0.0]),
///     rectified: false,
/// };
/// let ray = fisheye.unproject([500.0, 100.0]).expect("the pixel is within the lens");
/// let pixel = fisheye.project(&ray).expect("the ray is in front of the camera");
/// assert!((pixel[0] - 500.0).abs() < 1e-6 && (pixel[1] - 100.0).abs() < 1e-6);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lens {
    /// No distortion.
    Pinhole,
    /// Radial (k1, k2, k3) and tangential (p1, p2) coefficients in the order of OpenCV: k1, k2, p1,
    /// p2, k3.
    BrownConrady([f64; 5]),
    /// Fisheye lens with the coefficients k1, k2, k3, k4 of the equidistant polynomial (Kannala and
    /// Brandt 2006, as in OpenCV's fisheye model).
    KannalaBrandt([f64; 4]),
    /// Brown-Conrady with a rational radial part, in the order of OpenCV's rational model: k1, k2,
    /// p1, p2, k3, k4, k5, k6. The radial factor is `(1 + k1 r2 + k2 r4 + k3 r6) / (1 + k4 r2 + k5
    /// r4 + k6 r6)`.
    RationalBrownConrady([f64; 8]),
}

impl Lens {
    /// The distortion coefficients. A pinhole has none.
    pub fn coefficients(&self) -> &[f64] {
        match self {
            Self::Pinhole => &[],
            Self::BrownConrady(k) => k,
            Self::KannalaBrandt(k) => k,
            Self::RationalBrownConrady(k) => k,
        }
    }

    /// The distorted position of a point of the plane `z = 1`. `None` outside the range of the
    /// lens.
    pub(crate) fn distort(&self, plane: Vector2<f64>) -> Option<lens::Distorted> {
        match self {
            Self::Pinhole => Some(lens::Distorted::none(plane)),
            Self::BrownConrady(k) => lens::brown_conrady(k, plane),
            Self::KannalaBrandt(k) => lens::kannala_brandt(k, plane),
            Self::RationalBrownConrady(k) => lens::rational(k, plane),
        }
    }

    fn undistort(&self, distorted: Vector2<f64>) -> Option<Vector2<f64>> {
        match self {
            Self::Pinhole => Some(distorted),
            Self::BrownConrady(k) => lens::undistort_brown_conrady(k, distorted),
            Self::KannalaBrandt(k) => lens::undistort_kannala_brandt(k, distorted),
            Self::RationalBrownConrady(k) => lens::undistort_rational(k, distorted),
        }
    }
}

impl Intrinsics {
    /// Projects a point in camera coordinates to a pixel, which may lie outside the image.
    ///
    /// Returns `None` if the lens cannot image the point. This is the case if the point lies behind
    /// or next to the camera (`z <= 0`), or if it is not finite. It is also the case if the point
    /// lies beyond the radius up to which the distortion polynomial is monotonic.
    pub fn project(&self, point_in_camera: &Vector3<f64>) -> Option<[f64; 2]> {
        // NaN is checked explicitly, because every comparison with NaN is false. The test `z <= 0`
        // alone would accept it.
        if point_in_camera.z.is_nan() || point_in_camera.z <= 0.0 {
            return None;
        }
        let plane = point_in_camera.xy() / point_in_camera.z;
        self.pixel_at(self.lens_in_use().distort(plane)?.value)
    }

    /// Like [`Intrinsics::project`], and also returns the derivative of the pixel with respect to
    /// the point, pixels per meter.
    pub fn project_with_jacobian(
        &self,
        point_in_camera: &Vector3<f64>,
    ) -> Option<([f64; 2], Matrix2x3<f64>)> {
        let &[x, y, z] = point_in_camera.as_ref();
        if z.is_nan() || z <= 0.0 {
            return None;
        }
        let plane = Vector2::new(x / z, y / z);
        let distorted = self.lens_in_use().distort(plane)?;
        // The derivative of `(x / z, y / z)`.
        let plane_by_point = Matrix2x3::new(1.0, 0.0, -plane.x, 0.0, 1.0, -plane.y) / z;
        let mut pixel_by_point = distorted.jacobian * plane_by_point;
        pixel_by_point.row_mut(0).scale_mut(self.focal_px[0]);
        pixel_by_point.row_mut(1).scale_mut(self.focal_px[1]);
        Some((self.pixel_at(distorted.value)?, pixel_by_point))
    }

    /// Back-projects a pixel to the point on its ray with `z = 1`. This is the inverse of
    /// [`Intrinsics::project`]. The result is accurate to 1e-12.
    ///
    /// Returns `None` if the pixel is not finite or if no direction in front of the camera projects
    /// to it.
    pub fn unproject(&self, pixel: [f64; 2]) -> Option<Vector3<f64>> {
        let distorted = self.distorted_at(pixel);
        if !distorted.iter().all(|value| value.is_finite()) {
            return None;
        }
        let plane = self.lens_in_use().undistort(distorted)?;
        Some(Vector3::new(plane.x, plane.y, 1.0))
    }

    /// The distorted point of the plane `z = 1` at a pixel.
    fn distorted_at(&self, pixel: [f64; 2]) -> Vector2<f64> {
        Vector2::new(
            (pixel[0] - self.principal_px[0]) / self.focal_px[0],
            (pixel[1] - self.principal_px[1]) / self.focal_px[1],
        )
    }

    /// Fraction of the image, 0 to 1, in which the lens coefficients are implausible. They are
    /// implausible at a pixel if no direction projects to it, because the model is not monotonic
    /// there. They are also implausible if the distortion moves points outwards to more than 1.5
    /// times their distance from the principal point.
    pub fn implausible_lens_frac(&self) -> f64 {
        /// Number of pixels that are examined in each row and column of a grid.
        const N_PER_SIDE: u32 = 8;
        if self.is_pinhole() {
            return 0.0;
        }
        let at = |axis: usize, ix: u32| {
            f64::from(self.size_px[axis]) * (f64::from(ix) + 0.5) / f64::from(N_PER_SIDE)
        };
        let mut n_implausible = 0;
        for row in 0..N_PER_SIDE {
            for column in 0..N_PER_SIDE {
                if !self.is_lens_plausible_at([at(0, column), at(1, row)]) {
                    n_implausible += 1;
                }
            }
        }
        f64::from(n_implausible) / f64::from(N_PER_SIDE * N_PER_SIDE)
    }

    /// Whether the lens coefficients are plausible at a pixel.
    fn is_lens_plausible_at(&self, pixel: [f64; 2]) -> bool {
        // Pincushion distortion of real lenses stays below 1.2. Barrel distortion has no such
        // limit, because wide lenses compress the edge of the image.
        const MAX_STRETCH: f64 = 1.5;
        // Position of a point at almost 90 degrees from the axis.
        const SIDEWAYS: Vector2<f64> = Vector2::new(1e9, 0.0);
        let lens = self.lens_in_use();
        let is_fisheye = matches!(lens, Lens::KannalaBrandt(_));
        let Some(ray) = self.unproject(pixel) else {
            // A fisheye lens may also image directions behind the camera. Its model must then be
            // monotonic up to 90 degrees.
            return is_fisheye && lens.distort(SIDEWAYS).is_some();
        };
        // Without distortion, the radius in a fisheye image is linear in the angle from the axis.
        let radius = ray.xy().norm();
        let undistorted_radius = if is_fisheye { radius.atan() } else { radius };
        self.distorted_at(pixel).norm() <= MAX_STRETCH * undistorted_radius
    }

    /// Returns the intrinsics for the image scaled by `frac`. Its size is rounded to whole pixels,
    /// at least one.
    ///
    /// Focal length and principal point follow the rounded size, so image corners map to image
    /// corners.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "the cast saturates, as intended"
    )]
    pub fn scaled(&self, frac: f64) -> Self {
        let size_px = self
            .size_px
            .map(|size| ((f64::from(size) * frac).round() as u32).max(1));
        self.resized(size_px)
    }

    /// Returns the intrinsics for the image resized to `size_px`.
    pub fn resized(&self, size_px: [u32; 2]) -> Self {
        // Pixel edges are at integers, so scaling maps edges to edges. With integer pixel centers,
        // an additional offset of half a pixel would be needed.
        let ratio = |axis: usize| f64::from(size_px[axis]) / f64::from(self.size_px[axis]);
        Self {
            size_px,
            focal_px: [self.focal_px[0] * ratio(0), self.focal_px[1] * ratio(1)],
            principal_px: [
                self.principal_px[0] * ratio(0),
                self.principal_px[1] * ratio(1),
            ],
            ..*self
        }
    }

    /// Pinhole camera with the same size, focal length and principal point. This is the camera of
    /// the images that [`crate::Undistortion`] returns.
    pub fn undistorted(&self) -> Self {
        Self {
            lens: Lens::Pinhole,
            rectified: true,
            ..*self
        }
    }

    /// Whether the pinhole model describes the image. This is the case if the image is rectified,
    /// if the lens is a pinhole, or if all coefficients of a Brown-Conrady lens are zero.
    pub fn is_pinhole(&self) -> bool {
        match self.lens_in_use() {
            Lens::Pinhole => true,
            Lens::BrownConrady(k) => k == [0.0; 5],
            Lens::RationalBrownConrady(k) => k == [0.0; 8],
            // The projection is equidistant even if all coefficients are zero.
            Lens::KannalaBrandt(_) => false,
        }
    }

    /// Whether a pixel position lies inside the image.
    pub fn contains(&self, pixel: [f64; 2]) -> bool {
        (0..2).all(|axis| pixel[axis] >= 0.0 && pixel[axis] < f64::from(self.size_px[axis]))
    }

    /// Rejects zero sizes, focal lengths that are not positive, and non-finite values.
    pub fn validate(&self) -> Result<(), Error> {
        const NAMES: [[&str; 3]; 2] = [
            ["width", "focal length x", "principal point x"],
            ["height", "focal length y", "principal point y"],
        ];
        for (axis, [size_name, focal_name, principal_name]) in NAMES.into_iter().enumerate() {
            let size = self.size_px[axis];
            let focal = self.focal_px[axis];
            let principal = self.principal_px[axis];
            check(size_name, f64::from(size), size > 0, "at least 1 px")?;
            check(
                focal_name,
                focal,
                focal.is_finite() && focal > 0.0,
                "a positive number of pixels",
            )?;
            check(
                principal_name,
                principal,
                principal.is_finite(),
                "a finite number of pixels",
            )?;
        }
        // Coefficients of a rectified image are also checked, because a file that contains NaN is
        // damaged.
        for &k in self.lens.coefficients() {
            let what = "a distortion coefficient";
            check(what, k, k.is_finite(), "a finite number")?;
        }
        Ok(())
    }

    pub(crate) fn lens_in_use(&self) -> Lens {
        if self.rectified {
            Lens::Pinhole
        } else {
            self.lens
        }
    }

    pub(crate) fn pixel_at(&self, distorted: Vector2<f64>) -> Option<[f64; 2]> {
        let pixel =
            [0, 1].map(|axis| self.focal_px[axis] * distorted[axis] + self.principal_px[axis]);
        // Extreme coefficients overflow to infinity or NaN even for finite points.
        (pixel[0].is_finite() && pixel[1].is_finite()).then_some(pixel)
    }
}

/// Returns an error that names the parameter if its value is out of range.
fn check(
    what: &'static str,
    value: f64,
    is_fine: bool,
    allowed: &'static str,
) -> Result<(), Error> {
    if is_fine {
        return Ok(());
    }
    Err(Error::Intrinsics {
        what,
        value,
        allowed,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROUND_TRIP: f64 = 1e-12; // This is a distance on the plane z = 1.

    fn camera(lens: Lens) -> Intrinsics {
        Intrinsics {
            size_px: [640, 480],
            focal_px: [600.0, 580.0],
            principal_px: [321.5, 238.25],
            lens,
            rectified: false,
        }
    }

    fn lenses() -> Vec<Lens> {
        vec![
            Lens::Pinhole,
            Lens::BrownConrady([0.0578421, -0.0805099, -0.000980296, 0.00015575, 0.0]),
            Lens::BrownConrady([-0.28, 0.07, 0.001, -0.0005, 0.02]),
            Lens::BrownConrady([0.12, -0.31, 0.002, 0.001, 0.19]),
            Lens::KannalaBrandt([0.0; 4]),
            Lens::KannalaBrandt([-0.01, 0.02, -0.015, 0.003]),
            Lens::RationalBrownConrady([0.4, -0.1, 0.001, -0.0005, 0.01, 0.7, -0.02, 0.03]),
        ]
    }

    fn pixels() -> impl Iterator<Item = [f64; 2]> {
        (0..=16).flat_map(|row| {
            (0..=16).map(move |column| [f64::from(column) * 40.0, f64::from(row) * 30.0])
        })
    }

    #[test]
    fn project_inverts_unproject_for_every_lens() {
        for lens in lenses() {
            let camera = camera(lens);
            for pixel in pixels() {
                let ray = camera
                    .unproject(pixel)
                    .unwrap_or_else(|| panic!("{lens:?} shows nothing at {pixel:?}"));
                assert_eq!(ray.z, 1.0);
                for depth_m in [0.01, 1.0, 30.0] {
                    let back = camera.project(&(ray * depth_m)).unwrap();
                    for axis in 0..2 {
                        let off = (back[axis] - pixel[axis]).abs() / camera.focal_px[axis];
                        assert!(off < ROUND_TRIP, "{lens:?} {pixel:?} off by {off}");
                    }
                }
            }
        }
    }

    #[test]
    fn brown_conrady_matches_formula() {
        // x = 0.5, y = 0.25: r2 = 0.3125, r4 = 0.09765625, r6 = 0.030517578125.
        let camera = camera(Lens::BrownConrady([0.1, 0.2, 0.01, 0.02, 0.4]));
        let radial = 1.0 + 0.03125 + 0.01953125 + 0.01220703125;
        let x = 0.5 * radial + 2.0 * 0.01 * 0.125 + 0.02 * (0.3125 + 0.5);
        let y = 0.25 * radial + 0.01 * (0.3125 + 0.125) + 2.0 * 0.02 * 0.125;
        let [u, v] = camera.project(&Vector3::new(1.0, 0.5, 2.0)).unwrap();
        assert!((u - (600.0 * x + 321.5)).abs() < 1e-10);
        assert!((v - (580.0 * y + 238.25)).abs() < 1e-10);
    }

    #[test]
    fn coefficients_of_no_real_lens_are_implausible() {
        for lens in lenses() {
            assert_eq!(camera(lens).implausible_lens_frac(), 0.0, "{lens:?}");
        }
        // More than 180 degrees.
        let wide = Intrinsics {
            focal_px: [150.0, 150.0],
            ..camera(Lens::KannalaBrandt([0.0; 4]))
        };
        assert_eq!(wide.implausible_lens_frac(), 0.0);
        for lens in [
            // These lenses are monotonic, but the edge of the image shows directions near the
            // optical axis.
            Lens::BrownConrady([10.0, 0.0, 0.0, 0.0, 0.0]),
            // These lenses are monotonic only within a circle that is smaller than the image.
            Lens::BrownConrady([-3.0, 0.0, 0.0, 0.0, 0.0]),
            Lens::RationalBrownConrady([0.0, 0.0, 0.0, 0.0, 0.0, 10.0, 0.0, 0.0]),
            Lens::KannalaBrandt([-10.0, 0.0, 0.0, 0.0]),
            // Overflows.
            Lens::BrownConrady([1e308; 5]),
        ] {
            let implausible_frac = camera(lens).implausible_lens_frac();
            assert!(implausible_frac > 0.5, "{lens:?}: {implausible_frac}");
            let rectified = Intrinsics {
                rectified: true,
                ..camera(lens)
            };
            assert_eq!(rectified.implausible_lens_frac(), 0.0);
        }
        // In the small field of view of a long lens, the same coefficient has little effect.
        let narrow = Intrinsics {
            focal_px: [6000.0, 5800.0],
            ..camera(Lens::BrownConrady([10.0, 0.0, 0.0, 0.0, 0.0]))
        };
        assert_eq!(narrow.implausible_lens_frac(), 0.0);
    }

    #[test]
    fn equidistant_fisheye_is_linear_in_angle() {
        let camera = camera(Lens::KannalaBrandt([0.0; 4]));
        let angle = 0.9_f64;
        let [u, v] = camera
            .project(&Vector3::new(3.0 * angle.sin(), 0.0, 3.0 * angle.cos()))
            .unwrap();
        assert!((u - (600.0 * angle + 321.5)).abs() < 1e-10);
        assert!((v - 238.25).abs() < 1e-10);
        let distorted_camera = Intrinsics {
            lens: Lens::KannalaBrandt([0.1, 0.0, 0.0, 0.01]),
            ..camera
        };
        let [_, v] = distorted_camera
            .project(&Vector3::new(0.0, angle.sin(), angle.cos()))
            .unwrap();
        let by_hand = angle * (1.0 + 0.1 * 0.81 + 0.01 * 0.43046721);
        assert!((v - (580.0 * by_hand + 238.25)).abs() < 1e-10);
    }

    #[test]
    fn derivatives_match_central_differences() {
        const NUDGE_M: f64 = 1e-6;
        // Derivatives are hundreds of pixels per meter, with relative errors of 1e-12 (truncation)
        // and 1e-13 / 1e-6 (rounding).
        const CLOSE: f64 = 1e-6;
        for lens in lenses() {
            let camera = camera(lens);
            for point in [
                [0.3, -0.2, 1.5],
                [0.0, 0.0, 0.7],
                [-0.4, 0.35, 1.1],
                [1e-9, 0.0, 1.0],
            ] {
                let point = Vector3::from(point);
                let (pixel, jacobian) = camera.project_with_jacobian(&point).unwrap();
                assert_eq!(Some(pixel), camera.project(&point));
                for axis in 0..3 {
                    let mut nudge = Vector3::zeros();
                    nudge[axis] = NUDGE_M;
                    let ahead = camera.project(&(point + nudge)).unwrap();
                    let behind = camera.project(&(point - nudge)).unwrap();
                    for row in 0..2 {
                        let numeric = (ahead[row] - behind[row]) / (2.0 * NUDGE_M);
                        let off = (jacobian[(row, axis)] - numeric).abs();
                        assert!(
                            off < CLOSE,
                            "{lens:?} {point:?} row {row} axis {axis} off by {off}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn invisible_points_project_to_none() {
        for lens in lenses() {
            let camera = camera(lens);
            for point in [
                [0.0, 0.0, 0.0],
                [0.1, 0.0, -1.0],
                [1.0, 1.0, f64::NAN],
                [f64::NAN, 0.0, 1.0],
            ] {
                assert_eq!(
                    camera.project(&Vector3::from(point)),
                    None,
                    "{lens:?} {point:?}"
                );
                assert!(
                    camera
                        .project_with_jacobian(&Vector3::from(point))
                        .is_none(),
                    "{lens:?} {point:?}"
                );
            }
            assert_eq!(camera.unproject([f64::NAN, 0.0]), None);
            assert_eq!(camera.unproject([f64::INFINITY, 0.0]), None);
        }
    }

    #[test]
    fn barrel_distortion_stops_at_its_limit() {
        // r (1 - 0.3 r2) has its maximum, 2 / 3 of r, at r = 1 / sqrt(0.9).
        let camera = camera(Lens::BrownConrady([-0.3, 0.0, 0.0, 0.0, 0.0]));
        let turning_radius = 1.0 / 0.9_f64.sqrt();
        let at = |radius: f64| camera.project(&Vector3::new(radius * 0.6, radius * 0.8, 1.0));
        assert!(at(turning_radius * 0.999).is_some());
        assert_eq!(at(turning_radius * 1.001), None);
        assert_eq!(at(1.8), None); // Evaluated without the limit, the formula gives 0.03 of the focal length.
        let unproject_at = |radius: f64| {
            camera.unproject([321.5 + 600.0 * radius * 0.6, 238.25 + 580.0 * radius * 0.8])
        };
        assert!(unproject_at(turning_radius * 2.0 / 3.0 * 0.999).is_some());
        assert_eq!(unproject_at(turning_radius * 2.0 / 3.0 * 1.001), None);
    }

    #[test]
    fn fisheye_stops_at_90_degrees() {
        let camera = camera(Lens::KannalaBrandt([0.0; 4]));
        assert!(camera.unproject([321.5 + 600.0 * 1.57, 238.25]).is_some());
        assert_eq!(camera.unproject([321.5 + 600.0 * 1.58, 238.25]), None);
    }

    #[test]
    fn rectified_images_ignore_the_lens() {
        let point = Vector3::new(0.4, -0.3, 1.2);
        let pinhole = camera(Lens::Pinhole);
        for lens in lenses().into_iter().skip(1) {
            let rectified = Intrinsics {
                rectified: true,
                ..camera(lens)
            };
            assert_ne!(camera(lens).project(&point), pinhole.project(&point));
            assert_eq!(rectified.project(&point), pinhole.project(&point));
            assert_eq!(
                camera(lens).undistorted().project(&point),
                pinhole.project(&point)
            );
            assert!(rectified.is_pinhole() && !camera(lens).is_pinhole());
        }
    }

    #[test]
    fn scaling_keeps_corners_and_field_of_view() {
        let half = camera(lenses()[1]).scaled(0.5);
        assert_eq!((half.size_px, half.focal_px), ([320, 240], [300.0, 290.0]));
        let odd = camera(lenses()[1]).scaled(0.3333);
        assert_eq!(odd.size_px, [213, 160]);
        let point = Vector3::new(0.2, 0.1, 1.0);
        let [u, v] = camera(lenses()[1]).project(&point).unwrap();
        let [small_u, small_v] = odd.project(&point).unwrap();
        assert!(
            (small_u / 213.0 - u / 640.0).abs() < 1e-12
                && (small_v / 160.0 - v / 480.0).abs() < 1e-12
        );
        assert_eq!(camera(Lens::Pinhole).scaled(0.0).size_px, [1, 1]);
    }

    #[test]
    fn invalid_intrinsics_are_rejected() {
        let good = camera(lenses()[1]);
        good.validate().unwrap();
        for bad in [
            Intrinsics {
                size_px: [0, 480],
                ..good.clone()
            },
            Intrinsics {
                focal_px: [600.0, -1.0],
                ..good.clone()
            },
            Intrinsics {
                focal_px: [f64::NAN, 1.0],
                ..good.clone()
            },
            Intrinsics {
                principal_px: [0.0, f64::INFINITY],
                ..good.clone()
            },
            Intrinsics {
                lens: Lens::KannalaBrandt([0.0, f64::NAN, 0.0, 0.0]),
                ..good
            },
        ] {
            assert!(bad.validate().is_err(), "{bad:?}");
        }
        let message = camera(Lens::Pinhole);
        let message = Intrinsics {
            size_px: [640, 0],
            ..message
        }
        .validate()
        .unwrap_err()
        .to_string();
        assert_eq!(
            message,
            "camera intrinsics: height is 0, must be at least 1 px"
        );
    }
}
