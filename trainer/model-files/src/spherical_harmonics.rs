//! Color of a splat as a function of the viewing direction, given by real spherical harmonics up to
//! degree 3.
//!
//! Source: Kerbl et al. 2023 for constants, order and signs. The polynomials agree with Sloan 2013
//! on the unit sphere.

use nalgebra::Vector3;

/// Number of coefficients of the highest degree.
pub const MAX_N_COEFFS: usize = 16;

// Normalization constants of the real spherical harmonics, with the signs of the Condon-Shortley
// phase. C0 is 1/2 sqrt(1/pi) and C1 is 1/2 sqrt(3/pi).
const C0: f64 = 0.282_094_791_773_878_14;
const C1: f64 = 0.488_602_511_902_919_9;
// The constants of degree 2, for m from -2 to 2, are 1/2 sqrt(15/pi) for m = -2, -1 and 1, 1/4
// sqrt(5/pi) for m = 0, and 1/4 sqrt(15/pi) for m = 2.
const C2: [f64; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];
// The constants of degree 3, for m from -3 to 3, are 1/4 sqrt(35/(2 pi)) for m = -3 and 3, 1/2
// sqrt(105/pi) for m = -2, 1/4 sqrt(21/(2 pi)) for m = -1 and 1, 1/4 sqrt(7/pi) for m = 0, and 1/4
// sqrt(105/pi) for m = 2.
const C3: [f64; 7] = [
    -0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    -0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
    -0.457_045_799_464_465_8,
    1.445_305_721_320_277,
    -0.590_043_589_926_643_5,
];

/// Color in the direction `offset`, which is the vector from the camera to the splat in the world
/// frame. The color is clamped below at 0.
///
/// `sh` holds 1, 4, 9 or 16 coefficients.
pub fn color(sh: &[[f64; 3]], offset: &Vector3<f64>) -> [f64; 3] {
    unclamped_color(sh, offset).map(|channel| channel.max(0.0))
}

/// Gradient with respect to `sh` and `offset`, from the gradient with respect to the color. It is
/// zero for clamped channels.
pub fn color_backward(
    sh: &[[f64; 3]],
    offset: &Vector3<f64>,
    v_color: &[f64; 3],
) -> (Vec<[f64; 3]>, Vector3<f64>) {
    let direction = offset.normalize();
    let basis = basis(&direction);
    let by_direction = basis_gradient(&direction);
    // This is the gradient of max(color, 0). A channel below 0 does not depend on its coefficients.
    let unclamped = unclamped_color(sh, offset);
    let v_color: [f64; 3] = std::array::from_fn(|channel| {
        if unclamped[channel] > 0.0 {
            v_color[channel]
        } else {
            0.0
        }
    });
    let mut v_direction = Vector3::zeros();
    let mut v_sh = Vec::with_capacity(sh.len());
    for (coeff_ix, coeff) in sh.iter().enumerate() {
        v_sh.push(v_color.map(|v| v * basis[coeff_ix]));
        let v_basis: f64 = (0..3)
            .map(|channel| v_color[channel] * coeff[channel])
            .sum();
        v_direction += by_direction[coeff_ix] * v_basis;
    }
    // The color does not depend on the length of the offset, so the component along the direction
    // is removed.
    let v_offset = (v_direction - direction * direction.dot(&v_direction)) / offset.norm();
    (v_sh, v_offset)
}

/// Values of the basis functions at a unit direction.
pub fn basis(direction: &Vector3<f64>) -> [f64; MAX_N_COEFFS] {
    let (x, y, z) = (direction.x, direction.y, direction.z);
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        C0,
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2[0] * x * y,
        C2[1] * y * z,
        C2[2] * (2.0 * zz - xx - yy),
        C2[3] * x * z,
        C2[4] * (xx - yy),
        C3[0] * y * (3.0 * xx - yy),
        C3[1] * x * y * z,
        C3[2] * y * (4.0 * zz - xx - yy),
        C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        C3[4] * x * (4.0 * zz - xx - yy),
        C3[5] * z * (xx - yy),
        C3[6] * x * (xx - 3.0 * yy),
    ]
}

/// Gradients of the basis polynomials with respect to x, y and z as free variables.
fn basis_gradient(direction: &Vector3<f64>) -> [Vector3<f64>; MAX_N_COEFFS] {
    let (x, y, z) = (direction.x, direction.y, direction.z);
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        Vector3::zeros(),
        Vector3::new(0.0, -C1, 0.0),
        Vector3::new(0.0, 0.0, C1),
        Vector3::new(-C1, 0.0, 0.0),
        C2[0] * Vector3::new(y, x, 0.0),
        C2[1] * Vector3::new(0.0, z, y),
        C2[2] * Vector3::new(-2.0 * x, -2.0 * y, 4.0 * z),
        C2[3] * Vector3::new(z, 0.0, x),
        C2[4] * Vector3::new(2.0 * x, -2.0 * y, 0.0),
        C3[0] * Vector3::new(6.0 * x * y, 3.0 * (xx - yy), 0.0),
        C3[1] * Vector3::new(y * z, x * z, x * y),
        C3[2] * Vector3::new(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z),
        C3[3] * Vector3::new(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy),
        C3[4] * Vector3::new(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z),
        C3[5] * Vector3::new(2.0 * x * z, -2.0 * y * z, xx - yy),
        C3[6] * Vector3::new(3.0 * (xx - yy), -6.0 * x * y, 0.0),
    ]
}

fn unclamped_color(sh: &[[f64; 3]], offset: &Vector3<f64>) -> [f64; 3] {
    let basis = basis(&offset.normalize());
    // The offset 0.5 is part of the format of splat files, in which coefficients of zero are gray
    // (Kerbl et al. 2023).
    std::array::from_fn(|channel| {
        0.5 + sh
            .iter()
            .zip(basis)
            .map(|(coeff, value)| coeff[channel] * value)
            .sum::<f64>()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn basis_is_orthonormal_on_the_sphere() {
        const N_AZIMUTHS: u32 = 16; // Makes the sum over azimuths exact for products of degree 6.
        // Gauss-Legendre with 4 points is exact to degree 7 in z (Abramowitz and Stegun 1964, table
        // 25.4).
        const HEIGHTS: [(f64, f64); 4] = [
            (-0.861_136_311_594_052_6, 0.347_854_845_137_453_9),
            (-0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
            (0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
            (0.861_136_311_594_052_6, 0.347_854_845_137_453_9),
        ];
        let mut products = [[0.0_f64; MAX_N_COEFFS]; MAX_N_COEFFS];
        for azimuth_ix in 0..N_AZIMUTHS {
            let azimuth_rad = std::f64::consts::TAU * f64::from(azimuth_ix) / f64::from(N_AZIMUTHS);
            for (z, weight) in HEIGHTS {
                let radius = (1.0 - z * z).sqrt();
                let values = basis(&Vector3::new(
                    radius * azimuth_rad.cos(),
                    radius * azimuth_rad.sin(),
                    z,
                ));
                let area = weight * std::f64::consts::TAU / f64::from(N_AZIMUTHS);
                for (row, a) in products.iter_mut().zip(values) {
                    row.iter_mut()
                        .zip(values)
                        .for_each(|(product, b)| *product += area * a * b);
                }
            }
        }
        for (i, row) in products.iter().enumerate() {
            for (j, product) in row.iter().enumerate() {
                let expected = if i == j { 1.0 } else { 0.0 };
                assert!((product - expected).abs() <= 1e-12, "<{i}, {j}>: {product}");
            }
        }
    }

    #[test]
    fn basis_has_the_signs_of_published_splat_files() {
        // In this direction (x > sqrt(3) y > 0, z large), all polynomials without their constants
        // are positive, so the constants determine the signs.
        let signs = basis(&Vector3::new(0.36, 0.2, 0.9).normalize()).map(f64::signum);
        let published = [1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1].map(f64::from);
        assert_eq!(signs, published);
    }
}
