//! Axes of `.spz` files, and the extension that names them.
//!
//! Source: "SPZ extensions", Niantic and Adobe, <https://github.com/nianticlabs/spz>.

/// Type of the extension that names the axes (`SPZ_ADOBE_coordinate_system`).
const COORDINATE_SYSTEM: u32 = 0xadbe_0003;
/// For each higher basis function of the spherical harmonics, the axes in which it is odd. The axes
/// are 0 for x, 1 for y and 2 for z.
const ODD_AXES: [&[usize]; 15] = [
    &[1],
    &[2],
    &[0],
    &[0, 1],
    &[1, 2],
    &[],
    &[0, 2],
    &[],
    &[1],
    &[0, 1, 2],
    &[1],
    &[2],
    &[0],
    &[2],
    &[0],
];

/// The axes of a file, as factors 1 or -1 of x, y and z that convert vectors between the file and a
/// `.ply`.
///
/// The axes of a `.ply`, which are also fieldrig's axes, are right, down, front.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Axes([f32; 3]);

impl Axes {
    /// The axes of files without the extension.
    pub(super) const RIGHT_UP_BACK: Self = Self([1.0, -1.0, -1.0]);

    /// The axes for a number in the extension.
    fn from_number(number: u32) -> Result<Self, String> {
        match number {
            // The file does not specify its axes.
            0 => Ok(Self::RIGHT_UP_BACK),
            // The bits stand for right instead of left, up instead of down, and front instead of
            // back.
            1..=8 => {
                let bits = number - 1;
                Ok(Self([
                    sign(bits, 0, 1.0),
                    sign(bits, 1, -1.0),
                    sign(bits, 2, 1.0),
                ]))
            }
            9..=16 => Err(format!(
                "its y axis points to the front or back (coordinate system {number}), which is not supported; save it \
                 with the axes right, up, back"
            )),
            _ => Err(format!("coordinate system {number}, expected 1 to 16")),
        }
    }

    /// Converts a vector between the axes of the file and fieldrig's axes.
    pub(super) fn vector(self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        let [x_sign, y_sign, z_sign] = self.0;
        [x_sign * x, y_sign * y, z_sign * z]
    }

    /// Converts x, y and z of a quaternion. A mirrored ellipsoid has the same scales.
    pub(super) fn rotation_xyz(self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        // The vector of a quaternion is along the axis of rotation. This axis is a pseudovector,
        // because a mirror also reverses the sense of rotation.
        let [x_sign, y_sign, z_sign] = self.0;
        [
            y_sign * z_sign * x,
            x_sign * z_sign * y,
            x_sign * y_sign * z,
        ]
    }

    /// Factors of the higher color coefficients. The factor is -1 for basis functions that change
    /// sign.
    pub(super) fn sh_signs(self) -> [f32; 15] {
        ODD_AXES.map(|odd| odd.iter().map(|axis| self.0[*axis]).product())
    }
}

/// `if_set` if a bit is set, otherwise its negative.
fn sign(bits: u32, bit: u32, if_set: f32) -> f32 {
    if bits >> bit & 1 == 1 {
        if_set
    } else {
        -if_set
    }
}

/// Reads the records of extensions. Returns the axes and the number of bytes that are used.
///
/// A record consists of a type, the size of its contents, and the contents. Other programs ignore
/// what follows an incomplete record.
pub(super) fn from_extensions(mut records: &[u8]) -> Result<(Axes, u64), String> {
    while let Some(([t0, t1, t2, t3, n0, n1, n2, n3], rest)) = records.split_first_chunk::<8>() {
        let n_bytes = u32::from_le_bytes([*n0, *n1, *n2, *n3]) as usize;
        // Incomplete.
        let Some((contents, after)) = rest.split_at_checked(n_bytes) else {
            break;
        };
        let extension = u32::from_le_bytes([*t0, *t1, *t2, *t3]);
        if extension == COORDINATE_SYSTEM
            && let Some(number) = contents.first_chunk::<4>()
        {
            return Ok((
                Axes::from_number(u32::from_le_bytes(*number))?,
                8 + n_bytes as u64,
            ));
        }
        records = after;
    }
    Ok((Axes::RIGHT_UP_BACK, 0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spherical_harmonics as sh;
    use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

    const LETTERS: [&str; 8] = ["LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"];

    /// The axes with numbers 1 to 8, and the flip of each axis that follows from its letter.
    fn all() -> impl Iterator<Item = (Axes, Vector3<f64>)> {
        (1..).zip(LETTERS).map(|(number, letters)| {
            let sign = |(letter, ours): (char, char)| if letter == ours { 1.0 } else { -1.0 };
            let signs: Vec<f64> = letters.chars().zip("RDF".chars()).map(sign).collect();
            (
                Axes::from_number(number).unwrap(),
                Vector3::from_column_slice(&signs),
            )
        })
    }

    #[test]
    fn numbers_stand_for_the_documented_axes() {
        for (axes, signs) in all() {
            assert_eq!(
                axes.vector([1.0, 2.0, 4.0]).map(f64::from),
                [signs.x, 2.0 * signs.y, 4.0 * signs.z]
            );
        }
        assert_eq!(Axes::from_number(4).unwrap(), Axes::RIGHT_UP_BACK);
        assert!(
            Axes::from_number(9)
                .unwrap_err()
                .starts_with("its y axis points to the front or back")
        );
        assert_eq!(
            Axes::from_number(17).unwrap_err(),
            "coordinate system 17, expected 1 to 16"
        );
    }

    /// The converted quaternion and the unchanged scales describe the flipped ellipsoid.
    #[test]
    fn ellipsoids_are_flipped() {
        let covariance = |[w, x, y, z]: [f32; 4]| {
            let rotation = Quaternion::new(w, x, y, z).cast::<f64>();
            let rotation = *UnitQuaternion::from_quaternion(rotation)
                .to_rotation_matrix()
                .matrix();
            rotation * Matrix3::from_diagonal(&Vector3::new(1.0, 4.0, 0.25)) * rotation.transpose()
        };
        let [w, x, y, z] = [0.5, -0.3, 0.7, 0.2];
        for (axes, signs) in all() {
            let flip = Matrix3::from_diagonal(&signs);
            let [flipped_x, flipped_y, flipped_z] = axes.rotation_xyz([x, y, z]);
            let difference = covariance([w, flipped_x, flipped_y, flipped_z])
                - flip * covariance([w, x, y, z]) * flip.transpose();
            assert!(difference.abs().max() < 1e-12, "{signs}: {difference}");
        }
    }

    /// The color in a direction equals the color of the flipped splat in the flipped direction.
    #[test]
    fn colors_follow_the_flip() {
        let mut random = numbers::random::Random::new(5);
        let mut coefficients: Vec<[f64; 3]> = (0..16)
            .map(|_| std::array::from_fn(|_| random.normal()))
            .collect();
        coefficients[0] = [20.0; 3]; // No color is clamped at 0.
        let offset = Vector3::new(0.3, -0.5, 0.8);
        for (axes, signs) in all() {
            let mut flipped = coefficients.clone();
            for (rgb, sign) in flipped[1..].iter_mut().zip(axes.sh_signs()) {
                *rgb = rgb.map(|value| f64::from(sign) * value);
            }
            let flipped_offset = offset.component_mul(&signs);
            for (here, there) in sh::color(&coefficients, &offset)
                .iter()
                .zip(sh::color(&flipped, &flipped_offset))
            {
                assert!((here - there).abs() < 1e-12, "{signs}: {here} and {there}");
            }
        }
    }

    #[test]
    fn axes_are_found_among_other_extensions() {
        let record = |extension: u32, contents: &[u8]| {
            let n_bytes = u32::try_from(contents.len()).unwrap();
            [
                &extension.to_le_bytes()[..],
                &n_bytes.to_le_bytes(),
                contents,
            ]
            .concat()
        };
        let other = record(0xadbe_0002, &[0; 12]);
        let axes = record(COORDINATE_SYSTEM, &[6, 0, 0, 0]);
        let of = |records: &[&[u8]]| from_extensions(&records.concat());
        assert_eq!(of(&[]), Ok((Axes::RIGHT_UP_BACK, 0)));
        assert_eq!(of(&[&other]), Ok((Axes::RIGHT_UP_BACK, 0)));
        assert_eq!(of(&[&other, &axes]), Ok((Axes([1.0; 3]), 12)));
        assert_eq!(of(&[&axes, &other]), Ok((Axes([1.0; 3]), 12)));
        assert_eq!(
            of(&[&axes[..11]]),
            Ok((Axes::RIGHT_UP_BACK, 0)),
            "incomplete"
        );
        assert_eq!(
            of(&[&record(COORDINATE_SYSTEM, &[6])]),
            Ok((Axes::RIGHT_UP_BACK, 0)),
            "too short"
        );
        assert_eq!(
            of(&[&record(COORDINATE_SYSTEM, &[0; 4])]),
            Ok((Axes::RIGHT_UP_BACK, 12)),
            "not specified"
        );
        assert!(of(&[&record(COORDINATE_SYSTEM, &[16, 0, 0, 0])]).is_err());
    }
}
