//! Distortion of the plane `z = 1` by a lens, its derivative and its inverse.

use crate::polynomial::{CONVERGED, evaluate, positive_on, solve_rising};
use nalgebra::{Matrix2, Vector2};

/// A distorted point of the plane `z = 1` and its derivative with respect to the undistorted point.
pub(crate) struct Distorted {
    pub(crate) value: Vector2<f64>,
    pub(crate) jacobian: Matrix2<f64>,
}

impl Distorted {
    pub(crate) fn none(plane: Vector2<f64>) -> Self {
        Self {
            value: plane,
            jacobian: Matrix2::identity(),
        }
    }
}

/// Radial part of Brown-Conrady distortion: the factor `numerator(r2) / denominator(r2)` of the
/// radius `r`.
trait Radial {
    /// The factor and its derivative with respect to `r2`.
    fn factor(&self, r2: f64) -> (f64, f64);
    /// Whether `r` times the factor is finite and rises from 0 to the radius with this square.
    fn is_rising_to(&self, r2: f64) -> bool;
}

/// `1 + k1 r2 + k2 r4 + k3 r6`.
struct PolynomialRadial([f64; 3]);

impl Radial for PolynomialRadial {
    fn factor(&self, r2: f64) -> (f64, f64) {
        let [k1, k2, k3] = self.0;
        (
            1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)),
            k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3),
        )
    }

    fn is_rising_to(&self, r2: f64) -> bool {
        let [k1, k2, k3] = self.0;
        positive_on(&[1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3], r2)
    }
}

/// `(1 + k1 r2 + k2 r4 + k3 r6) / (1 + k4 r2 + k5 r4 + k6 r6)`.
struct RationalRadial {
    numerator: [f64; 4],
    denominator: [f64; 4],
}

impl Radial for RationalRadial {
    fn factor(&self, r2: f64) -> (f64, f64) {
        let numerator = evaluate(&self.numerator, r2);
        let denominator = evaluate(&self.denominator, r2);
        // The quotient rule.
        let by_r2 = evaluate(&derivative(&self.numerator), r2) * denominator
            - numerator * evaluate(&derivative(&self.denominator), r2);
        (numerator / denominator, by_r2 / (denominator * denominator))
    }

    /// With numerator N and denominator D, the derivative of `r N / D` is `(N D + 2 r2 (N' D - N
    /// D')) / D²`.
    fn is_rising_to(&self, r2: f64) -> bool {
        let mut rise = [0.0; 7];
        for (i, n) in self.numerator.iter().enumerate() {
            for (j, d) in self.denominator.iter().enumerate() {
                // These are the products of `r2^i` and `r2^j`. With `N' = i n r2^(i - 1)`, the
                // three products have the same power.
                rise[i + j] += n * d * (1.0 + 2.0 * (i as f64 - j as f64));
            }
        }
        // A zero of the denominator is a pole. The quotient jumps from one infinity to the other
        // there, and may rise on both sides of it.
        positive_on(&self.denominator, r2) && positive_on(&rise, r2)
    }
}

fn derivative(&[_, a, b, c]: &[f64; 4]) -> [f64; 3] {
    [a, 2.0 * b, 3.0 * c]
}

/// Applies Brown-Conrady distortion (Brown 1966, Conrady 1919) in OpenCV's form. `None` beyond the
/// radius up to which the radial part is monotonic.
pub(crate) fn brown_conrady(k: &[f64; 5], plane: Vector2<f64>) -> Option<Distorted> {
    distort(&PolynomialRadial([k[0], k[1], k[4]]), [k[2], k[3]], plane)
}

/// The point that [`brown_conrady`] maps to `distorted`.
pub(crate) fn undistort_brown_conrady(
    k: &[f64; 5],
    distorted: Vector2<f64>,
) -> Option<Vector2<f64>> {
    undistort(
        &PolynomialRadial([k[0], k[1], k[4]]),
        [k[2], k[3]],
        distorted,
    )
}

/// Applies Brown-Conrady distortion with a rational radial part. This is OpenCV's rational model
/// (Claus and Fitzgibbon 2005). `None` beyond the radius up to which the radial part is monotonic.
pub(crate) fn rational(k: &[f64; 8], plane: Vector2<f64>) -> Option<Distorted> {
    distort(&rational_radial(k), [k[2], k[3]], plane)
}

/// The point that [`rational`] maps to `distorted`.
pub(crate) fn undistort_rational(k: &[f64; 8], distorted: Vector2<f64>) -> Option<Vector2<f64>> {
    undistort(&rational_radial(k), [k[2], k[3]], distorted)
}

fn rational_radial(&[k1, k2, _, _, k3, k4, k5, k6]: &[f64; 8]) -> RationalRadial {
    RationalRadial {
        numerator: [1.0, k1, k2, k3],
        denominator: [1.0, k4, k5, k6],
    }
}

/// Distorts a point. `None` where the map is not invertible.
fn distort(radial: &impl Radial, tangential: [f64; 2], plane: Vector2<f64>) -> Option<Distorted> {
    let distorted = distort_unchecked(radial, tangential, plane);
    // Beyond the radius at which the curve turns back, two points have the same image. A point far
    // outside the field of view would then appear in the image, so it must not be projected. The
    // determinant covers folds that the tangential part causes.
    let monotonic =
        radial.is_rising_to(plane.norm_squared()) && distorted.jacobian.determinant() > 0.0;
    monotonic.then_some(distorted)
}

/// Distorts a point, even where several points have the same image.
fn distort_unchecked(radial: &impl Radial, [p1, p2]: [f64; 2], plane: Vector2<f64>) -> Distorted {
    let x = plane.x;
    let y = plane.y;
    let r2 = plane.norm_squared();
    let (factor, factor_by_r2) = radial.factor(r2);
    let value = Vector2::new(
        x * factor + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * factor + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    );
    // Both mixed derivatives are equal, because the distortion is the gradient of a potential.
    let across = 2.0 * (x * y * factor_by_r2 + p1 * x + p2 * y);
    let jacobian = Matrix2::new(
        factor + 2.0 * (x * x * factor_by_r2 + p1 * y + 3.0 * p2 * x),
        across,
        across,
        factor + 2.0 * (y * y * factor_by_r2 + 3.0 * p1 * y + p2 * x),
    );
    Distorted { value, jacobian }
}

/// The point that [`distort`] maps to `distorted`.
fn undistort(
    radial: &impl Radial,
    tangential: [f64; 2],
    distorted: Vector2<f64>,
) -> Option<Vector2<f64>> {
    // Newton's method converges in a few steps from the radial solution. More steps are needed only
    // for points near the edge of the invertible region.
    const MAX_STEPS: usize = 50;
    let length = distorted.norm();
    if length == 0.0 && tangential == [0.0; 2] {
        return Some(distorted);
    }
    // Without a tangential part, it is sufficient to solve for the radius. With a tangential part,
    // the solution for the radius is the initial value of Newton's method in the plane.
    let is_rising_to = |radius: f64| radial.is_rising_to(radius * radius);
    let radius = solve_rising(
        |radius| distorted_radius(radial, radius),
        is_rising_to,
        length,
        f64::INFINITY,
    );
    let mut plane = match radius {
        Some(radius) if length > 0.0 => distorted * (radius / length),
        Some(_) => distorted,
        // Just outside the radial limit, the tangential part may still move the point inside.
        None if tangential != [0.0; 2] => distorted,
        None => return None,
    };
    for _ in 0..MAX_STEPS {
        let guess = distort_unchecked(radial, tangential, plane);
        // The radial solution is already close, because tangential coefficients are small. A
        // singular Jacobian means that the point is on the edge of the invertible region.
        let step = guess.jacobian.try_inverse()? * (guess.value - distorted);
        plane -= step;
        if step.norm() <= CONVERGED * (1.0 + plane.norm()) {
            break;
        }
    }
    // The steps may have left the invertible region, or may not have converged. The solution is
    // therefore distorted again and compared with the input, so that no wrong ray is returned.
    let check = distort(radial, tangential, plane)?;
    const CLOSE: f64 = 1e-12;
    ((check.value - distorted).norm() <= CLOSE * (1.0 + length)).then_some(plane)
}

/// The distorted radius without the tangential part, and its derivative with respect to the radius.
fn distorted_radius(radial: &impl Radial, radius: f64) -> (f64, f64) {
    let r2 = radius * radius;
    let (factor, factor_by_r2) = radial.factor(r2);
    (radius * factor, factor + 2.0 * r2 * factor_by_r2)
}

/// Derivatives of [`brown_conrady`] with respect to its coefficients.
pub(crate) fn brown_conrady_by_coefficients(plane: Vector2<f64>) -> [Vector2<f64>; 5] {
    let r2 = plane.norm_squared();
    let [by_p1, by_p2] = tangential_by_coefficients(plane);
    [
        plane * r2,
        plane * (r2 * r2),
        by_p1,
        by_p2,
        plane * (r2 * r2 * r2),
    ]
}

/// Derivatives of [`rational`] with respect to its coefficients.
pub(crate) fn rational_by_coefficients(k: &[f64; 8], plane: Vector2<f64>) -> [Vector2<f64>; 8] {
    let r2 = plane.norm_squared();
    let [by_p1, by_p2] = tangential_by_coefficients(plane);
    let radial = rational_radial(k);
    let by_numerator = plane / evaluate(&radial.denominator, r2);
    // The derivative of `N / D` by a coefficient of D is `-N / D²` times the power.
    let by_denominator = by_numerator * -radial.factor(r2).0;
    let [first, second] =
        [by_numerator, by_denominator].map(|by| [by * r2, by * (r2 * r2), by * (r2 * r2 * r2)]);
    [
        first[0], first[1], by_p1, by_p2, first[2], second[0], second[1], second[2],
    ]
}

/// Derivatives of the tangential part with respect to p1 and p2.
fn tangential_by_coefficients(plane: Vector2<f64>) -> [Vector2<f64>; 2] {
    let xy = 2.0 * plane.x * plane.y;
    let r2 = plane.norm_squared();
    [
        Vector2::new(xy, r2 + 2.0 * plane.y * plane.y),
        Vector2::new(r2 + 2.0 * plane.x * plane.x, xy),
    ]
}

/// Applies Kannala-Brandt distortion (Kannala and Brandt 2006, equation 6, radial terms only), as
/// in OpenCV's fisheye model.
pub(crate) fn kannala_brandt(k: &[f64; 4], plane: Vector2<f64>) -> Option<Distorted> {
    let radius = plane.norm();
    let angle = radius.atan();
    let angle2 = angle * angle;
    if !positive_on(&angle_derivative(k), angle2) {
        return None;
    }
    let series = 1.0 + angle2 * (k[0] + angle2 * (k[1] + angle2 * (k[2] + angle2 * k[3])));
    let length = angle * series;
    // The derivative of `atan r` is `1 / (1 + r²)`.
    let length_by_radius = evaluate(&angle_derivative(k), angle2) / (1.0 + radius * radius);
    // Computes length / radius, and its derivative divided by radius. Near the axis, both quotients
    // lose all digits. The map is the identity there, up to third order.
    const NEAR_AXIS: f64 = 1e-6;
    let (share, share_by_radius2) = if radius < NEAR_AXIS {
        (
            1.0 + (k[0] - 1.0 / 3.0) * radius * radius,
            2.0 * (k[0] - 1.0 / 3.0),
        )
    } else {
        (
            length / radius,
            (length_by_radius - length / radius) / (radius * radius),
        )
    };
    let jacobian = Matrix2::identity() * share + plane * plane.transpose() * share_by_radius2;
    Some(Distorted {
        value: plane * share,
        jacobian,
    })
}

/// Derivative of `angle (1 + k1 angle2 + ...)` with respect to the angle, as a polynomial in
/// angle2.
fn angle_derivative(&[k1, k2, k3, k4]: &[f64; 4]) -> [f64; 5] {
    [1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4]
}

/// The point that [`kannala_brandt`] maps to `distorted`. `None` at 90 degrees from the axis or
/// more.
pub(crate) fn undistort_kannala_brandt(
    k: &[f64; 4],
    distorted: Vector2<f64>,
) -> Option<Vector2<f64>> {
    let length = distorted.norm();
    if length == 0.0 {
        return Some(distorted);
    }
    let series = [1.0, k[0], k[1], k[2], k[3]];
    let derivative = angle_derivative(k);
    // The model is a polynomial in the angle from the axis. The equation is solved for this angle,
    // and the direction is kept.
    let is_rising_to = |angle: f64| positive_on(&derivative, angle * angle);
    let angle = solve_rising(
        |angle| {
            let angle2 = angle * angle;
            let length = angle * evaluate(&series, angle2);
            (length, evaluate(&derivative, angle2))
        },
        is_rising_to,
        length,
        std::f64::consts::FRAC_PI_2,
    )?;
    // At 90 degrees the ray does not meet the plane `z = 1`, and its tangent is a huge number
    // instead of infinity.
    (angle < std::f64::consts::FRAC_PI_2).then(|| distorted * (angle.tan() / length))
}

/// Derivatives of [`kannala_brandt`] with respect to its coefficients.
pub(crate) fn kannala_brandt_by_coefficients(plane: Vector2<f64>) -> [Vector2<f64>; 4] {
    let radius = plane.norm();
    let angle = radius.atan();
    // The quotient tends to 1 on the axis.
    let direction = if radius > 0.0 {
        plane * (angle / radius)
    } else {
        plane
    };
    let angle2 = angle * angle;
    [
        direction * angle2,
        direction * angle2.powi(2),
        direction * angle2.powi(3),
        direction * angle2.powi(4),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undistortion_inverts_strong_lenses() {
        for k in [
            [-0.3, 0.1, 0.0, 0.0, 0.0],
            [-0.4, 0.0, 0.003, -0.002, 0.0],
            [0.5, -0.9, 0.0, 0.0, 0.3],
            [0.9; 5],
        ] {
            let mut n_checked = 0;
            for step in 0..400 {
                let radius = f64::from(step) * 0.005;
                let plane = Vector2::new(radius * 0.6, radius * -0.8);
                let Some(distorted) = brown_conrady(&k, plane) else {
                    continue;
                };
                // Very close to the limit the inverse is not accurate to 1e-12 because its
                // derivative grows without bound.
                if distorted.jacobian.determinant() < 1e-3 {
                    continue;
                }
                n_checked += 1;
                let back = undistort_brown_conrady(&k, distorted.value)
                    .unwrap_or_else(|| panic!("{k:?} at {radius}"));
                assert!(
                    (back - plane).norm() < 1e-11,
                    "{k:?} at {radius}: off by {:e}",
                    (back - plane).norm()
                );
            }
            assert!(
                n_checked > 100,
                "{k:?}: only {n_checked} points inside the limit"
            );
        }
    }

    #[test]
    fn undistortion_inverts_rational_lenses() {
        // The second lens has a pole at radius 2, and the third lens reaches its maximum below
        // radius 1.4.
        for k in [
            [0.2, -0.05, 0.001, -0.0005, 0.01, 0.5, -0.02, 0.02],
            [0.1, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0],
            [-0.1, -0.05, 0.002, 0.001, 0.0, 0.1, 0.05, 0.01],
        ] {
            let mut n_checked = 0;
            for step in 0..600 {
                let radius = f64::from(step) * 0.005;
                let plane = Vector2::new(radius * 0.6, radius * -0.8);
                let Some(distorted) = rational(&k, plane) else {
                    continue;
                };
                assert!(k[5] != -0.25 || radius < 2.0, "beyond the pole");
                if distorted.jacobian.determinant() < 1e-3 || distorted.value.norm() > 10.0 {
                    continue;
                }
                n_checked += 1;
                let back = undistort_rational(&k, distorted.value)
                    .unwrap_or_else(|| panic!("{k:?} at {radius}"));
                assert!(
                    (back - plane).norm() < 1e-11,
                    "{k:?} at {radius}: off by {:e}",
                    (back - plane).norm()
                );
            }
            assert!(
                n_checked > 200,
                "{k:?}: only {n_checked} points inside the limit"
            );
        }
    }

    #[test]
    fn rational_lens_without_denominator_is_brown_conrady() {
        let k = [-0.28, 0.07, 0.001, -0.0005, 0.02];
        let plane = Vector2::new(0.3, -0.4);
        let [expected, actual] = [
            brown_conrady(&k, plane),
            rational(&[k[0], k[1], k[2], k[3], k[4], 0.0, 0.0, 0.0], plane),
        ]
        .map(Option::unwrap);
        assert!((expected.value - actual.value).norm() < 1e-15);
        assert!((expected.jacobian - actual.jacobian).norm() < 1e-14);
    }
}
