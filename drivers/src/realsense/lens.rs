//! Converts lens parameters between fieldrig and librealsense2.
//!
//! Source: `include/librealsense2/rsutil.h` of 2.56, functions `rs2_project_point_to_pixel` and
//! `rs2_deproject_pixel_to_point`. In the library, the center of the first pixel is (0, 0). In
//! fieldrig, it is (0.5, 0.5).

use super::Problem;
use kinematics::{Intrinsics, Lens, Transform};
use nalgebra::{Matrix3, Matrix5, Rotation3, Translation3, UnitQuaternion, Vector5};
use realsense_sys as sys;

/// Maximum error, in pixels, when a lens model of this crate is fitted to a lens model of the
/// library. The error for a D455 is 0.04 pixels.
const MAX_FIT_ERROR_PX: f64 = 0.5;
/// Number of fit points along each side of the image. Five coefficients of smooth polynomials need
/// far fewer points. With this density, the maximum error between the points is close to the
/// maximum error at the points.
const N_FIT_POINTS: u32 = 24;

/// Converts intrinsics of the library to intrinsics of fieldrig.
///
/// Brown-Conrady and Kannala-Brandt are the same models in both. "Modified" and "inverse"
/// Brown-Conrady are different polynomials, so the Brown-Conrady model of fieldrig is fitted to
/// them. All D4xx color cameras report the inverse model, usually with zero coefficients.
pub(super) fn intrinsics(
    raw: &sys::rs2_intrinsics,
    stream: &'static str,
) -> Result<Intrinsics, Problem> {
    let lens_problem = |model: &str| Problem::Lens {
        stream,
        model: model.to_owned(),
    };
    let size_px = [raw.width, raw.height].map(|side| u32::try_from(side).unwrap_or(0));
    let mut intrinsics = Intrinsics {
        size_px,
        focal_px: [raw.fx, raw.fy].map(f64::from),
        principal_px: [raw.ppx, raw.ppy].map(|center| f64::from(center) + 0.5),
        lens: Lens::Pinhole,
        rectified: false,
    };
    let k = raw.coeffs.map(f64::from);
    intrinsics.lens = match raw.model {
        sys::rs2_distortion_RS2_DISTORTION_KANNALA_BRANDT4 => {
            Lens::KannalaBrandt([k[0], k[1], k[2], k[3]])
        }
        // This case comes after Kannala-Brandt, because that model is not a pinhole model even with
        // zero coefficients.
        _ if k == [0.0; 5] => Lens::Pinhole,
        sys::rs2_distortion_RS2_DISTORTION_NONE => Lens::Pinhole,
        sys::rs2_distortion_RS2_DISTORTION_BROWN_CONRADY => Lens::BrownConrady(k),
        sys::rs2_distortion_RS2_DISTORTION_INVERSE_BROWN_CONRADY => {
            fit_brown_conrady(&intrinsics, |distorted| {
                (polynomial(&k, distorted), distorted)
            })
            .ok_or_else(|| lens_problem("inverse Brown-Conrady, too strong for a fit"))?
        }
        sys::rs2_distortion_RS2_DISTORTION_MODIFIED_BROWN_CONRADY => {
            fit_brown_conrady(&intrinsics, |ray| (ray, modified(&k, ray)))
                .ok_or_else(|| lens_problem("modified Brown-Conrady, too strong for a fit"))?
        }
        sys::rs2_distortion_RS2_DISTORTION_FTHETA => return Err(lens_problem("F-theta")),
        other => return Err(lens_problem(&format!("number {other}"))),
    };
    intrinsics.validate().map_err(|error| Problem::Library {
        what: "get intrinsics",
        reason: error.to_string(),
    })?;
    Ok(intrinsics)
}

/// Converts intrinsics of fieldrig to intrinsics of the library. The library has no rational model,
/// so the closest polynomial model replaces it. If no polynomial model is close enough, the result
/// has no distortion.
#[cfg(feature = "emulation")]
pub(super) fn raw(intrinsics: &Intrinsics) -> sys::rs2_intrinsics {
    let lens = if intrinsics.is_pinhole() {
        Lens::Pinhole
    } else {
        intrinsics.lens
    };
    let (model, k) = match lens {
        Lens::Pinhole => (sys::rs2_distortion_RS2_DISTORTION_NONE, [0.0; 5]),
        Lens::BrownConrady(k) => (sys::rs2_distortion_RS2_DISTORTION_BROWN_CONRADY, k),
        Lens::KannalaBrandt([k1, k2, k3, k4]) => (
            sys::rs2_distortion_RS2_DISTORTION_KANNALA_BRANDT4,
            [k1, k2, k3, k4, 0.0],
        ),
        Lens::RationalBrownConrady(_) => {
            let [fx, fy] = intrinsics.focal_px;
            let [cx, cy] = intrinsics.principal_px;
            let distort =
                |[x, y]: [f64; 2]| match intrinsics.project(&nalgebra::Vector3::new(x, y, 1.0)) {
                    Some([u, v]) => ([x, y], [(u - cx) / fx, (v - cy) / fy]),
                    None => ([x, y], [f64::NAN; 2]),
                };
            match fit_brown_conrady(&intrinsics.undistorted(), distort) {
                Some(Lens::BrownConrady(k)) => {
                    (sys::rs2_distortion_RS2_DISTORTION_BROWN_CONRADY, k)
                }
                _ => (sys::rs2_distortion_RS2_DISTORTION_NONE, [0.0; 5]),
            }
        }
    };
    let [width, height] = intrinsics
        .size_px
        .map(|side| i32::try_from(side).unwrap_or(i32::MAX));
    let [ppx, ppy] = intrinsics.principal_px.map(|center| narrow(center - 0.5));
    let [fx, fy] = intrinsics.focal_px.map(narrow);
    sys::rs2_intrinsics {
        width,
        height,
        ppx,
        ppy,
        fx,
        fy,
        model,
        coeffs: k.map(narrow),
    }
}

/// Converts extrinsics of the library, which map coordinates from the first stream to the second.
pub(super) fn transform(raw: &sys::rs2_extrinsics) -> Transform {
    let rotation = Matrix3::from_column_slice(&raw.rotation.map(f64::from));
    // Single precision leaves the matrix slightly non-orthogonal.
    let rotation = Rotation3::from_matrix_eps(&rotation, 1e-12, 100, Rotation3::identity());
    let [x, y, z] = raw.translation.map(f64::from);
    Transform::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_rotation_matrix(&rotation),
    )
}

/// Converts a transform to extrinsics of the library.
#[cfg(feature = "emulation")]
pub(super) fn extrinsics(transform: &Transform) -> sys::rs2_extrinsics {
    let rotation = transform.rotation.to_rotation_matrix();
    let mut columns = [0.0; 9];
    columns
        .iter_mut()
        .zip(rotation.matrix().iter())
        .for_each(|(to, from)| *to = narrow(*from));
    let translation: [f64; 3] = transform.translation.vector.into();
    sys::rs2_extrinsics {
        rotation: columns,
        translation: translation.map(narrow),
    }
}

#[cfg(feature = "emulation")]
#[expect(
    clippy::cast_possible_truncation,
    reason = "the library uses single precision"
)]
fn narrow(number: f64) -> f32 {
    number as f32
}

fn polynomial(k: &[f64; 5], [x, y]: [f64; 2]) -> [f64; 2] {
    let r2 = x * x + y * y;
    let radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]));
    [
        x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x),
        y * radial + 2.0 * k[3] * x * y + k[2] * (r2 + 2.0 * y * y),
    ]
}

/// The tangential part is applied to the result of the radial part.
fn modified(k: &[f64; 5], [x, y]: [f64; 2]) -> [f64; 2] {
    let r2 = x * x + y * y;
    let radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]));
    let [x, y] = [x * radial, y * radial];
    [
        x + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x),
        y + 2.0 * k[3] * x * y + k[2] * (r2 + 2.0 * y * y),
    ]
}

/// Fits the Brown-Conrady model of fieldrig to another model by least squares over the image.
/// Returns `None` if the fit is not accurate enough.
///
/// `pair` takes the position on the plane `z` = 1 that a pinhole camera observes at a pixel, and
/// returns a ray and its distorted position.
fn fit_brown_conrady(
    pinhole: &Intrinsics,
    pair: impl Fn([f64; 2]) -> ([f64; 2], [f64; 2]),
) -> Option<Lens> {
    let mut pairs = Vec::new();
    for row in 0..=N_FIT_POINTS {
        for column in 0..=N_FIT_POINTS {
            let side = |axis: usize, step: u32| {
                f64::from(pinhole.size_px[axis] * step) / f64::from(N_FIT_POINTS)
            };
            // The borders are included, because distortion is strongest in the corners and the
            // polynomial must not be extrapolated there.
            let ray_at = pinhole.unproject([side(0, column), side(1, row)])?;
            pairs.push(pair([ray_at.x, ray_at.y]));
        }
    }
    // The displacement caused by the lens is linear in its coefficients.
    let mut normal_matrix = Matrix5::zeros();
    let mut rhs = Vector5::zeros();
    for ([x, y], distorted_point) in &pairs {
        let r2 = x * x + y * y;
        let powers = [r2, r2 * r2, r2 * r2 * r2];
        let equations = [
            (
                Vector5::new(
                    x * powers[0],
                    x * powers[1],
                    2.0 * x * y,
                    r2 + 2.0 * x * x,
                    x * powers[2],
                ),
                distorted_point[0] - x,
            ),
            (
                Vector5::new(
                    y * powers[0],
                    y * powers[1],
                    r2 + 2.0 * y * y,
                    2.0 * x * y,
                    y * powers[2],
                ),
                distorted_point[1] - y,
            ),
        ];
        for (row, displacement) in equations {
            normal_matrix += row * row.transpose();
            rhs += row * displacement;
        }
    }

    let [k1, k2, p1, p2, k3] = normal_matrix.cholesky()?.solve(&rhs).into();
    let k = [k1, k2, p1, p2, k3];
    let fit_error_px = pairs.iter().map(|(ray, distorted_point)| {
        let ours = polynomial(&k, *ray);
        (0..2)
            .map(|axis| ((ours[axis] - distorted_point[axis]) * pinhole.focal_px[axis]).abs())
            .fold(0.0, f64::max)
    });
    let fit_error_px = fit_error_px.fold(0.0, f64::max);
    log::debug!("fitted a lens model of the library with a maximum error of {fit_error_px:.4} px");
    (fit_error_px < MAX_FIT_ERROR_PX).then_some(Lens::BrownConrady(k))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Color camera of a D455, as printed by `rs-enumerate-devices -c`.
    const D455: sys::rs2_intrinsics = sys::rs2_intrinsics {
        width: 1280,
        height: 720,
        ppx: 643.2,
        ppy: 361.7,
        fx: 636.1,
        fy: 635.4,
        model: sys::rs2_distortion_RS2_DISTORTION_INVERSE_BROWN_CONRADY,
        coeffs: [-0.0555, 0.0657, -0.0006, 0.0004, -0.0213],
    };

    /// Maximum error of the fit of this lens.
    const FIT_TOLERANCE_PX: f64 = 0.05;

    #[test]
    fn every_lens_model_matches_library() {
        let models = [
            sys::rs2_distortion_RS2_DISTORTION_NONE,
            sys::rs2_distortion_RS2_DISTORTION_BROWN_CONRADY,
            sys::rs2_distortion_RS2_DISTORTION_MODIFIED_BROWN_CONRADY,
            sys::rs2_distortion_RS2_DISTORTION_INVERSE_BROWN_CONRADY,
        ];
        for model in models {
            let raw = sys::rs2_intrinsics { model, ..D455 };
            let ours = intrinsics(&raw, "color").expect("a supported lens");
            let k = raw.coeffs.map(f64::from);
            for row in (0..=720).step_by(90) {
                for column in (0..=1280).step_by(80) {
                    // The pixel is in the convention of the library, with integer centers.
                    let pixel = [f64::from(column), f64::from(row)];
                    let plane = [
                        (pixel[0] - f64::from(raw.ppx)) / f64::from(raw.fx),
                        (pixel[1] - f64::from(raw.ppy)) / f64::from(raw.fy),
                    ];
                    let (ray, distorted_point) = match model {
                        sys::rs2_distortion_RS2_DISTORTION_NONE => (plane, plane),
                        sys::rs2_distortion_RS2_DISTORTION_BROWN_CONRADY => {
                            (plane, polynomial(&k, plane))
                        }
                        sys::rs2_distortion_RS2_DISTORTION_MODIFIED_BROWN_CONRADY => {
                            (plane, modified(&k, plane))
                        }
                        _ => (polynomial(&k, plane), plane),
                    };
                    let got = ours
                        .project(&nalgebra::Vector3::new(ray[0], ray[1], 1.0))
                        .expect("in front of the camera");
                    let expected = [
                        distorted_point[0] * f64::from(raw.fx) + f64::from(raw.ppx) + 0.5,
                        distorted_point[1] * f64::from(raw.fy) + f64::from(raw.ppy) + 0.5,
                    ];
                    for axis in 0..2 {
                        assert!(
                            (got[axis] - expected[axis]).abs() < FIT_TOLERANCE_PX,
                            "{model}: {got:?}, expected {expected:?}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn lenses_and_poses_round_trip_and_unknown_models_fail() {
        for lens in [
            Lens::Pinhole,
            Lens::BrownConrady([0.125, -0.25, 0.001953125, -0.0009765625, 0.0625]),
            Lens::KannalaBrandt([0.25, 0.125, -0.0625, 0.03125]),
        ] {
            let ours = Intrinsics {
                size_px: [640, 480],
                focal_px: [606.5, 605.25],
                principal_px: [321.75, 241.125],
                lens,
                rectified: false,
            };
            assert_eq!(
                intrinsics(&raw(&ours), "color").expect("a supported lens"),
                ours
            );
        }
        let fisheye = sys::rs2_intrinsics {
            model: sys::rs2_distortion_RS2_DISTORTION_FTHETA,
            ..D455
        };
        assert!(
            intrinsics(&fisheye, "color")
                .expect_err("an unsupported model")
                .to_string()
                .contains("F-theta")
        );
        let pose = Transform::from_parts(
            Translation3::new(0.0148, 0.0002, -0.0003),
            UnitQuaternion::from_euler_angles(0.01, -0.02, 0.03),
        );
        let error = transform(&extrinsics(&pose)).inverse() * pose;
        assert!(
            error.translation.vector.norm() < 1e-8 && error.rotation.angle() < 1e-6,
            "{error}"
        );
    }
}
