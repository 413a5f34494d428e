//! Rigid motions and velocities.

use crate::Error;
use nalgebra::{Isometry3, Matrix3, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3};

/// A rigid motion, in meters. `a_from_b` maps coordinates in frame b to coordinates in frame a.
pub type Transform = Isometry3<f64>;

/// Velocity of a frame relative to the world, expressed in that frame.
///
/// In this frame, a point at rest in the world moves by `-(linear_m_s + angular_rad_s x
/// point_in_frame)` per second.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Twist {
    /// Velocity of the frame's origin, meters per second.
    pub linear_m_s: Vector3<f64>,
    /// Angular velocity, radians per second.
    pub angular_rad_s: Vector3<f64>,
}

/// Largest element of `|RᵀR - 1|` that is accepted as a rounding error in a file. Quaternions with
/// three decimals deviate by less than this tolerance. A scale error of 0.1 % exceeds it.
pub const RIGID_TOLERANCE: f64 = 1e-3;
/// Like [`RIGID_TOLERANCE`], but for matrices with three decimals. Such matrices deviate by up to
/// `2 * sqrt(3) * 0.0005`.
pub const ROUNDED_TOLERANCE: f64 = 2e-3;

/// Below this angle, in radians, [`exp`] and [`log`] use series instead of quotients. At this
/// angle, series and quotients agree to 1e-16.
const SMALL_ANGLE_RAD: f64 = 1e-4;

/// Parses a row-major 4x4 matrix.
///
/// The rotation part is replaced by the nearest rotation in the least-squares sense, which removes
/// rounding errors.
///
/// # Errors
///
/// Rejects non-finite elements, a last row other than `0 0 0 1`, and a rotation part that is
/// mirrored or deviates by more than [`RIGID_TOLERANCE`].
pub fn from_rows(rows: &[f64; 16]) -> Result<Transform, Error> {
    from_rows_within(rows, RIGID_TOLERANCE)
}

/// Like [`from_rows`], for numbers that may be rounded to three decimals. Also returns whether the
/// numbers deviate by more than [`from_rows`] accepts. If so, the rotation is wrong by up to 0.1
/// degrees.
///
/// # Errors
///
/// As [`from_rows`], with [`ROUNDED_TOLERANCE`].
pub fn from_rounded_rows(rows: &[f64; 16]) -> Result<(Transform, bool), Error> {
    match from_rows(rows) {
        // Only a deviation from a rotation may come from rounding. All other errors remain errors.
        Err(Error::NotRigid { .. }) => Ok((from_rows_within(rows, ROUNDED_TOLERANCE)?, true)),
        exact => Ok((exact?, false)),
    }
}

fn from_rows_within(rows: &[f64; 16], tolerance: f64) -> Result<Transform, Error> {
    if let Some(at) = rows.iter().position(|value| !value.is_finite()) {
        return Err(Error::TransformNotFinite {
            row: at / 4,
            column: at % 4,
            value: rows[at],
        });
    }
    let last = [rows[12], rows[13], rows[14], rows[15]];
    if last
        .iter()
        .zip([0.0, 0.0, 0.0, 1.0])
        .any(|(got, expected)| (got - expected).abs() > RIGID_TOLERANCE)
    {
        return Err(Error::LastRow { row: last });
    }
    let given = Matrix3::from_fn(|row, column| rows[4 * row + column]);
    // The orthogonality check comes before the projection to a rotation. The projection would turn
    // any matrix into a plausible pose, even a matrix that is scaled to millimeters.
    let off = (given.transpose() * given - Matrix3::identity())
        .abs()
        .max();
    let determinant = given.determinant();
    // A mirrored matrix is also orthogonal, but its determinant is negative. Files with left-handed
    // axes contain such matrices.
    if off > tolerance || determinant < 0.0 {
        return Err(Error::NotRigid {
            off,
            allowed: tolerance,
            determinant,
        });
    }
    let translation = Translation3::new(rows[3], rows[7], rows[11]);
    Ok(Transform::from_parts(
        translation,
        UnitQuaternion::from_rotation_matrix(&nearest_rotation(given)),
    ))
}

/// The orthogonal polar factor, by Newton's iteration (Higham 1986), which converges quadratically
/// for matrices that are close to a rotation.
fn nearest_rotation(mut matrix: Matrix3<f64>) -> Rotation3<f64> {
    // Errors decrease from 1e-3 to 1e-6 and 1e-12, and then below rounding. One extra step takes
    // little time, and a fixed number of steps gives the same bits for the same file.
    const STEPS: usize = 4;
    for _ in 0..STEPS {
        let inverse_transpose = matrix
            .try_inverse()
            .expect("a matrix near a rotation has an inverse")
            .transpose();
        matrix = (matrix + inverse_transpose) * 0.5;
    }
    Rotation3::from_matrix_unchecked(matrix)
}

/// Returns the row-major 4x4 matrix.
pub fn to_rows(transform: &Transform) -> [f64; 16] {
    let matrix = transform.to_homogeneous();
    std::array::from_fn(|at| matrix[(at / 4, at % 4)])
}

/// The seven numbers of a pose in files. They are the position x, y, z in meters, then the
/// quaternion x, y, z, w.
pub fn to_xyz_xyzw(transform: &Transform) -> [f64; 7] {
    let [x, y, z] = transform.translation.vector.into();
    let [i, j, k, w] = transform.rotation.coords.into();
    [x, y, z, i, j, k, w]
}

/// The bit-exact inverse of [`to_xyz_xyzw`].
///
/// The quaternion must have unit length. It is not normalized again, because a normalization would
/// change its last bits.
pub fn from_xyz_xyzw([x, y, z, i, j, k, w]: [f64; 7]) -> Transform {
    Transform::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::new_unchecked(Quaternion::new(w, i, j, k)),
    )
}

/// A motion of a camera below these two bounds is noticeable neither in a picture nor in a map of
/// the scene. At a focal length of 600 pixels, each of the two bounds moves a point at a distance
/// of 1 m by 0.3 pixels.
const NOTICEABLE_M: f64 = 5e-4;
const NOTICEABLE_RAD: f64 = 5e-4;

/// Whether a camera has moved noticeably, that is, by more than 0.5 mm or 0.5 mrad (0.03 degrees).
///
/// * `motion`: pose of the camera after the motion, in the frame of the camera before the motion.
pub fn is_noticeable(motion: &Transform) -> bool {
    motion.translation.vector.norm() > NOTICEABLE_M || motion.rotation.angle() > NOTICEABLE_RAD
}

/// Whether all elements of a pose are finite.
pub fn is_finite(transform: &Transform) -> bool {
    to_xyz_xyzw(transform)
        .iter()
        .all(|number| number.is_finite())
}

/// Interpolates from `a` (`frac` 0) to `b` (`frac` 1). The translation is interpolated linearly.
/// The rotation has a constant rate along the shorter arc.
pub fn interpolate(a: &Transform, b: &Transform, frac: f64) -> Transform {
    let translation = a.translation.vector.lerp(&b.translation.vector, frac);
    // The scaled axis of a unit quaternion has an angle of at most pi, so this is the shorter arc.
    let rotation_vector = (a.rotation.inverse() * b.rotation).scaled_axis();
    Transform::from_parts(
        translation.into(),
        a.rotation * UnitQuaternion::from_scaled_axis(rotation_vector * frac),
    )
}

/// Motion of a frame that moves with a constant `twist` for `secs` seconds. The new
/// `world_from_frame` is the old `world_from_frame` times this motion.
///
/// Source: Murray, Li and Sastry 1994, section 2.3.2 (exponential of se(3)).
///
/// ```
/// use kinematics::{Twist, transform};
/// use nalgebra::Vector3;
///
/// let twist = Twist { linear_m_s: Vector3::new(0.1, 0.0, 0.0), angular_rad_s: Vector3::new(0.0, 0.0, 0.5) };
/// let moved = transform::exp(&twist, 2.0);
/// let again = transform::log(&moved, 2.0);
/// assert!((again.linear_m_s - twist.linear_m_s).norm() < 1e-12);
/// ```
pub fn exp(twist: &Twist, secs: f64) -> Transform {
    let rotation_vector = twist.angular_rad_s * secs;
    let translation_part = twist.linear_m_s * secs;
    let angle = rotation_vector.norm();
    // (1 - cos a) / a² and (a - sin a) / a³.
    let (first, second) = if angle < SMALL_ANGLE_RAD {
        (
            0.5 - angle * angle / 24.0,
            1.0 / 6.0 - angle * angle / 120.0,
        )
    } else {
        // `1 - cos a = 2 sin²(a / 2)` avoids the cancellation of `1 - cos a` at small angles.
        let half = (0.5 * angle).sin() / angle;
        (2.0 * half * half, (angle - angle.sin()) / angle.powi(3))
    };
    // `v + first (w x v) + second (w x (w x v))` is the sum of the series of powers of the cross
    // product (Rodrigues).
    let first_cross = rotation_vector.cross(&translation_part);
    let translation =
        translation_part + first_cross * first + rotation_vector.cross(&first_cross) * second;
    Transform::from_parts(
        translation.into(),
        UnitQuaternion::from_scaled_axis(rotation_vector),
    )
}

/// The constant twist that produces `transform` in `secs` seconds. This is the inverse of [`exp`]
/// for rotations below 180 degrees.
pub fn log(transform: &Transform, secs: f64) -> Twist {
    let rotation_vector = transform.rotation.scaled_axis();
    let angle = rotation_vector.norm();
    // (1 - (a / 2) cot(a / 2)) / a².
    let second = if angle < SMALL_ANGLE_RAD {
        1.0 / 12.0 + angle * angle / 720.0
    } else {
        (1.0 - 0.5 * angle / (0.5 * angle).tan()) / (angle * angle)
    };
    let translation = transform.translation.vector;
    // The inverse of the map in `exp` is a sum of the same two cross products.
    let first_cross = rotation_vector.cross(&translation);
    let translation_part =
        translation - first_cross * 0.5 + rotation_vector.cross(&first_cross) * second;
    Twist {
        linear_m_s: translation_part / secs,
        angular_rad_s: rotation_vector / secs,
    }
}

impl Twist {
    /// The twist of a frame at rest.
    pub fn zero() -> Self {
        Self {
            linear_m_s: Vector3::zeros(),
            angular_rad_s: Vector3::zeros(),
        }
    }

    /// Twist of another frame that is rigidly attached to this one, expressed in the other frame
    /// (adjoint transform).
    pub fn of_attached(&self, this_from_other: &Transform) -> Self {
        let other_from_this = this_from_other.rotation.inverse();
        // The origin of the other frame also moves because this frame rotates. Its velocity is `v +
        // w x r`.
        let linear_m_s = self.linear_m_s
            + self
                .angular_rad_s
                .cross(&this_from_other.translation.vector);
        Self {
            linear_m_s: other_from_this * linear_m_s,
            angular_rad_s: other_from_this * self.angular_rad_s,
        }
    }

    /// Velocity, in this frame, of a point at rest in the world, meters per second.
    pub fn apparent_velocity(&self, point_in_frame: &Vector3<f64>) -> Vector3<f64> {
        -(self.linear_m_s + self.angular_rad_s.cross(point_in_frame))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    const CLOSE: f64 = 1e-12; // Rounding of a few products of numbers near 1.

    fn pose(x: f64, rotation_vector: [f64; 3]) -> Transform {
        Transform::new(Vector3::new(x, -0.4, 1.3), rotation_vector.into())
    }

    fn distance(a: &Transform, b: &Transform) -> f64 {
        (a.to_homogeneous() - b.to_homogeneous()).abs().max()
    }

    #[test]
    fn rows_round_trip_and_are_row_major() {
        let a = pose(0.7, [0.3, -1.2, 2.0]);
        let rows = to_rows(&a);
        assert_eq!(rows[3], 0.7);
        assert_eq!(&rows[12..], &[0.0, 0.0, 0.0, 1.0]);
        assert!(distance(&from_rows(&rows).unwrap(), &a) < CLOSE);
        let other = pose(0.7, [0.3, -1.2, 2.0 + 1e-6]);
        assert!(distance(&from_rows(&rows).unwrap(), &other) > CLOSE);
    }

    #[test]
    fn seven_numbers_are_a_pose_bit_for_bit() {
        let rotation = UnitQuaternion::new_unchecked(Quaternion::new(0.5, -0.5, 0.5, 0.5 + 1e-9));
        let a = Transform::from_parts(Translation3::new(0.1 + 0.2, -0.0, 5e-324), rotation);
        let numbers = to_xyz_xyzw(&a);
        let expected = [0.1 + 0.2, -0.0, 5e-324, -0.5, 0.5, 0.5 + 1e-9, 0.5];
        assert_eq!(
            numbers.map(f64::to_bits),
            expected.map(f64::to_bits),
            "x y z, then the quaternion with w last"
        );
        let back = from_xyz_xyzw(numbers);
        assert_eq!(
            to_xyz_xyzw(&back).map(f64::to_bits),
            expected.map(f64::to_bits),
            "not normalized"
        );
        assert!(is_finite(&back));
        for ix in 0..7 {
            let mut broken = numbers;
            broken[ix] = f64::NAN;
            assert!(!is_finite(&from_xyz_xyzw(broken)), "{ix}");
        }
    }

    #[test]
    fn rounded_rotations_are_orthonormalized() {
        let rows = to_rows(&pose(0.7, [0.3, -1.2, 2.0])).map(|value| (value * 1e4).round() / 1e4);
        let read = from_rows(&rows).unwrap();
        let matrix = read.rotation.to_rotation_matrix().into_inner();
        assert!(
            (matrix.transpose() * matrix - Matrix3::identity())
                .abs()
                .max()
                < 1e-15
        );
        assert!(distance(&read, &pose(0.7, [0.3, -1.2, 2.0])) < 1e-4);
    }

    #[test]
    fn non_rigid_matrices_are_rejected() {
        let rows = to_rows(&pose(0.7, [0.3, -1.2, 2.0]));
        let with = |at: usize, value: f64| {
            let mut changed = rows;
            changed[at] = value;
            from_rows(&changed)
        };
        assert!(matches!(
            with(6, f64::NAN),
            Err(Error::TransformNotFinite {
                row: 1,
                column: 2,
                ..
            })
        ));
        assert!(matches!(
            with(3, f64::INFINITY),
            Err(Error::TransformNotFinite {
                row: 0,
                column: 3,
                ..
            })
        ));
        assert!(matches!(with(12, 0.1), Err(Error::LastRow { .. })));
        assert!(matches!(with(15, 0.0), Err(Error::LastRow { .. })));
        let scaled = |factor: f64| {
            let mut scaled = rows;
            (0..11)
                .filter(|at| at % 4 < 3)
                .for_each(|at| scaled[at] *= factor);
            scaled
        };
        let mut mirrored = rows;
        (0..3).for_each(|row| mirrored[4 * row] *= -1.0);
        let refused = [
            (scaled(1.001), "write at least four decimals"),
            (scaled(2.0), "without scale and shear"),
            (mirrored, "check the sign of each axis"),
        ];
        for (rows, advice) in refused {
            let error = from_rows(&rows).unwrap_err();
            assert!(
                matches!(error, Error::NotRigid { .. }) && error.to_string().ends_with(advice),
                "{error}"
            );
        }
        assert!(matches!(from_rows(&[0.0; 16]), Err(Error::LastRow { .. })));
    }

    #[test]
    fn interpolation_hits_both_ends_and_is_shortest() {
        let a = pose(0.0, [0.0, 0.0, 0.0]);
        let b = pose(1.0, [0.0, 0.0, 1.0]);
        assert!(distance(&interpolate(&a, &b, 0.0), &a) < CLOSE);
        assert!(distance(&interpolate(&a, &b, 1.0), &b) < CLOSE);
        assert!(distance(&interpolate(&a, &b, 0.25), &pose(0.25, [0.0, 0.0, 0.25])) < CLOSE);
        // The shorter arc from 170 to 190 degrees is 20 degrees long, although the quaternions of
        // these rotations may have opposite signs.
        let c = pose(0.0, [0.0, 0.0, 170.0 / 180.0 * PI]);
        let d = pose(0.0, [0.0, 0.0, 190.0 / 180.0 * PI]);
        let flipped = Transform::from_parts(
            d.translation,
            UnitQuaternion::new_unchecked(-d.rotation.into_inner()),
        );
        for end in [d, flipped] {
            assert!(distance(&interpolate(&c, &end, 0.5), &pose(0.0, [0.0, 0.0, PI])) < CLOSE);
        }
    }

    #[test]
    fn exp_matches_rotation_about_point_and_log_inverts_it() {
        // A quarter circle of radius 2 about the point (0, 2, 0).
        let quarter = Twist {
            linear_m_s: Vector3::new(PI, 0.0, 0.0),
            angular_rad_s: Vector3::new(0.0, 0.0, 0.5 * PI),
        };
        let moved = exp(&quarter, 1.0);
        assert!((moved.translation.vector - Vector3::new(2.0, 2.0, 0.0)).norm() < CLOSE);
        for scale in [0.0, 1e-9, 0.99e-4, 1.01e-4, 1e-2, 1.0, 2.4] {
            let twist = Twist {
                linear_m_s: Vector3::new(0.3, -0.2, 0.5),
                angular_rad_s: Vector3::new(0.6, -0.7, 0.5) * scale,
            };
            let back = log(&exp(&twist, 0.5), 0.5);
            assert!(
                (back.linear_m_s - twist.linear_m_s).norm() < CLOSE,
                "{scale}"
            );
            assert!(
                (back.angular_rad_s - twist.angular_rad_s).norm() < CLOSE,
                "{scale}"
            );
            let halves = exp(&twist, 0.25) * exp(&twist, 0.25);
            assert!(distance(&halves, &exp(&twist, 0.5)) < CLOSE, "{scale}");
        }
    }

    #[test]
    fn attached_frame_has_same_motion() {
        let twist = Twist {
            linear_m_s: Vector3::new(0.3, -0.2, 0.5),
            angular_rad_s: Vector3::new(1.0, 0.4, -0.3),
        };
        let this_from_other = pose(0.2, [0.5, 0.1, -0.9]);
        let moved = this_from_other.inverse() * exp(&twist, 0.7) * this_from_other;
        assert!(distance(&exp(&twist.of_attached(&this_from_other), 0.7), &moved) < CLOSE);
    }

    #[test]
    fn resting_point_moves_against_the_frame() {
        const STEP_SECS: f64 = 1e-6;
        let twist = Twist {
            linear_m_s: Vector3::new(0.3, -0.2, 0.5),
            angular_rad_s: Vector3::new(1.0, 0.4, -0.3),
        };
        let point_in_frame = Vector3::new(0.1, 0.5, 0.9);
        let at = |secs: f64| {
            (exp(&twist, secs).inverse() * nalgebra::Point3::from(point_in_frame)).coords
        };
        let numeric = (at(STEP_SECS) - at(-STEP_SECS)) / (2.0 * STEP_SECS);
        assert!((numeric - twist.apparent_velocity(&point_in_frame)).norm() < 1e-9);
    }
}
