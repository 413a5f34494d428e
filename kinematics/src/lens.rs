//! Distortion of the plane `z = 1` by a lens, its derivative and its inverse.

use nalgebra::{Matrix2, Vector2};

/// A distorted point of the plane `z = 1` and its derivative with respect to the undistorted point.
pub(crate) struct Distorted {
    pub(crate) value: Vector2<f64>,
    pub(crate) jacobian: Matrix2<f64>,
}

impl Distorted {
    pub(crate) fn none(plane: Vector2<f64>) -> Self {
        Self { value: plane, jacobian: Matrix2::identity() }
    }
}

/// Newton's method stops when the step is below this fraction of the value, just above rounding errors.
const CONVERGED: f64 = 1e-15;

/// Applies Brown-Conrady distortion (Brown 1966, Conrady 1919) in OpenCV's form. `None` beyond the radius up to which
/// the radial part is monotonic.
pub(crate) fn brown_conrady(k: &[f64; 5], plane: Vector2<f64>) -> Option<Distorted> {
    let distorted = brown_conrady_unchecked(k, plane);
    let monotonic = positive_on(&radial_derivative(k), plane.norm_squared()) && distorted.jacobian.determinant() > 0.0;
    monotonic.then_some(distorted)
}

fn brown_conrady_unchecked(&[k1, k2, p1, p2, k3]: &[f64; 5], plane: Vector2<f64>) -> Distorted {
    let (x, y) = (plane.x, plane.y);
    let r2 = plane.norm_squared();
    let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let radial_by_r2 = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
    let value = Vector2::new(
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    );
    let across = 2.0 * (x * y * radial_by_r2 + p1 * x + p2 * y);
    let jacobian = Matrix2::new(
        radial + 2.0 * (x * x * radial_by_r2 + p1 * y + 3.0 * p2 * x),
        across,
        across,
        radial + 2.0 * (y * y * radial_by_r2 + 3.0 * p1 * y + p2 * x),
    );
    Distorted { value, jacobian }
}

/// Derivative of `r (1 + k1 r2 + k2 r4 + k3 r6)` with respect to r, as a polynomial in r2.
fn radial_derivative(&[k1, k2, _, _, k3]: &[f64; 5]) -> [f64; 5] {
    [1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 0.0]
}

/// The point that [`brown_conrady`] maps to `distorted`.
pub(crate) fn undistort_brown_conrady(k: &[f64; 5], distorted: Vector2<f64>) -> Option<Vector2<f64>> {
    const MAX_STEPS: usize = 50;
    let length = distorted.norm();
    if length == 0.0 && k[2] == 0.0 && k[3] == 0.0 {
        return Some(distorted);
    }
    // Without the tangential part, solving for the radius suffices. With it, that solution is the initial value of
    // Newton's method in the plane.
    let radial = [1.0, k[0], k[1], k[4], 0.0];
    let mut plane = match solve_odd_polynomial(&radial, &radial_derivative(k), length, f64::INFINITY) {
        Some(radius) if length > 0.0 => distorted * (radius / length),
        Some(_) => distorted,
        // Just outside the radial limit, the tangential part may still move the point inside.
        None if k[2] != 0.0 || k[3] != 0.0 => distorted,
        None => return None,
    };
    for _ in 0..MAX_STEPS {
        let guess = brown_conrady_unchecked(k, plane);
        let step = guess.jacobian.try_inverse()? * (guess.value - distorted);
        plane -= step;
        if step.norm() <= CONVERGED * (1.0 + plane.norm()) {
            break;
        }
    }
    let check = brown_conrady(k, plane)?;
    const CLOSE: f64 = 1e-12;
    ((check.value - distorted).norm() <= CLOSE * (1.0 + length)).then_some(plane)
}

/// Applies Kannala-Brandt distortion (Kannala and Brandt 2006, equation 6, radial terms only), as in OpenCV's fisheye
/// model.
pub(crate) fn kannala_brandt(k: &[f64; 4], plane: Vector2<f64>) -> Option<Distorted> {
    let radius = plane.norm();
    let angle = radius.atan();
    let angle2 = angle * angle;
    if !positive_on(&angle_derivative(k), angle2) {
        return None;
    }
    let series = 1.0 + angle2 * (k[0] + angle2 * (k[1] + angle2 * (k[2] + angle2 * k[3])));
    let length = angle * series;
    let length_by_radius = evaluate(&angle_derivative(k), angle2) / (1.0 + radius * radius);
    // Computes length / radius, and its derivative divided by radius. Near the axis both quotients lose all digits, but
    // the map is the identity up to third order.
    const NEAR_AXIS: f64 = 1e-6;
    let (share, share_by_radius2) = if radius < NEAR_AXIS {
        (1.0 + (k[0] - 1.0 / 3.0) * radius * radius, 2.0 * (k[0] - 1.0 / 3.0))
    } else {
        (length / radius, (length_by_radius - length / radius) / (radius * radius))
    };
    let jacobian = Matrix2::identity() * share + plane * plane.transpose() * share_by_radius2;
    Some(Distorted { value: plane * share, jacobian })
}

/// Derivative of `angle (1 + k1 angle2 + ...)` with respect to the angle, as a polynomial in angle2.
fn angle_derivative(&[k1, k2, k3, k4]: &[f64; 4]) -> [f64; 5] {
    [1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4]
}

/// The point that [`kannala_brandt`] maps to `distorted`. `None` at 90 degrees from the axis or more.
pub(crate) fn undistort_kannala_brandt(k: &[f64; 4], distorted: Vector2<f64>) -> Option<Vector2<f64>> {
    let length = distorted.norm();
    if length == 0.0 {
        return Some(distorted);
    }
    let series = [1.0, k[0], k[1], k[2], k[3]];
    let angle = solve_odd_polynomial(&series, &angle_derivative(k), length, std::f64::consts::FRAC_PI_2)?;
    (angle < std::f64::consts::FRAC_PI_2).then(|| distorted * (angle.tan() / length))
}

/// The smallest `x` from 0 to `limit` with `x p(x²) = target`, if the derivative is positive from 0 up to it.
///
/// Uses Newton's method inside a bracket that shrinks with every step.
fn solve_odd_polynomial(p: &[f64; 5], derivative: &[f64; 5], target: f64, limit: f64) -> Option<f64> {
    const MAX_STEPS: usize = 200; // Bisection alone needs about 60 steps.
    let value = |x: f64| x * evaluate(p, x * x) - target;
    // Find a bracket: x from `low`, where the value is below the target, to `high`, where it is above or the
    // derivative has changed sign.
    let (mut low, mut high) = (0.0, target.min(limit));
    let is_rising_to = |x: f64| positive_on(derivative, x * x);
    while is_rising_to(high) && value(high) < 0.0 {
        if high >= limit || high > f64::MAX.sqrt() * 0.25 {
            return None;
        }
        low = high;
        high = (2.0 * high).min(limit);
    }
    // Narrow the bracket.
    let mut x = 0.5 * (low + high);
    for _ in 0..MAX_STEPS {
        let rising = is_rising_to(x);
        if rising && value(x) < 0.0 {
            low = x;
        } else {
            high = x;
        }
        // Beyond the maximum, Newton's method could converge to another root.
        let newton = x - value(x) / evaluate(derivative, x * x);
        let next = if rising && newton > low && newton < high { newton } else { 0.5 * (low + high) };
        let step = (next - x).abs();
        x = next;
        if step <= CONVERGED * x || high - low <= CONVERGED * high {
            break;
        }
    }
    const CLOSE: f64 = 1e-12;
    (is_rising_to(x) && value(x).abs() <= CLOSE * target.max(1.0)).then_some(x)
}

fn evaluate(p: &[f64; 5], s: f64) -> f64 {
    p[0] + s * (p[1] + s * (p[2] + s * (p[3] + s * p[4])))
}

/// Whether a polynomial of degree 4 with `p[0] > 0` is positive from 0 to `end`.
///
/// The Bernstein coefficients on the interval bound the polynomial from below. If they are not conclusive, the interval
/// is halved (Lane and Riesenfeld 1981). For a point well inside the range of the lens, the first test is conclusive.
fn positive_on(p: &[f64; 5], end: f64) -> bool {
    const MAX_HALVINGS: u32 = 30;
    let mut power = [p[0], p[1] * end, 0.0, 0.0, 0.0];
    let mut scale = end;
    for degree in 2..5 {
        scale *= end;
        power[degree] = p[degree] * scale;
    }
    // Coefficient j is the sum over i <= j of choose(j, i) / choose(4, i) * power[i].
    let [c0, c1, c2, c3, c4] = power;
    let bernstein =
        [c0, c0 + c1 / 4.0, c0 + c1 / 2.0 + c2 / 6.0, c0 + 0.75 * c1 + c2 / 2.0 + c3 / 4.0, c0 + c1 + c2 + c3 + c4];
    all_positive(&bernstein, MAX_HALVINGS)
}

fn all_positive(bernstein: &[f64; 5], halvings_left: u32) -> bool {
    if bernstein.iter().all(|&coefficient| coefficient > 0.0) {
        return true;
    }
    // The first and last coefficients are values of the polynomial itself. The comparison is written so that NaN is
    // not positive.
    if !(bernstein[0] > 0.0 && bernstein[4] > 0.0) || halvings_left == 0 {
        return false;
    }
    let (mut left, mut right) = ([0.0; 5], *bernstein);
    for (level, first) in left.iter_mut().enumerate() {
        *first = right[0];
        for at in 0..4 - level {
            right[at] = 0.5 * (right[at] + right[at + 1]);
        }
    }
    // After de Casteljau's steps, `right` holds the coefficients of the right half.
    all_positive(&left, halvings_left - 1) && all_positive(&right, halvings_left - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positive_polynomials_are_recognized() {
        // (s - 1)² + dip has its minimum, dip, at 1.
        let parabola = |dip: f64| [1.0 + dip, -2.0, 1.0, 0.0, 0.0];
        assert!(positive_on(&parabola(1e-3), 5.0));
        assert!(!positive_on(&parabola(-1e-3), 5.0));
        assert!(positive_on(&parabola(-1e-3), 0.9));
        // (s - 0.5)² (s - 2)² + dip has two minima.
        let quartic = |dip: f64| [1.0 + dip, -5.0, 8.25, -5.0, 1.0];
        assert!(positive_on(&quartic(1e-3), 3.0));
        assert!(!positive_on(&quartic(-1e-3), 3.0));
        assert!(!positive_on(&quartic(-1e-3), 1.0));
        assert!(positive_on(&quartic(-1e-3), 0.4));
        assert!(!positive_on(&[1.0, f64::NAN, 0.0, 0.0, 0.0], 1.0));
        assert!(positive_on(&[1.0, 0.0, 0.0, 0.0, 0.0], 1e60));
    }

    #[test]
    fn undistortion_inverts_strong_lenses() {
        for k in [[-0.3, 0.1, 0.0, 0.0, 0.0], [-0.4, 0.0, 0.003, -0.002, 0.0], [0.5, -0.9, 0.0, 0.0, 0.3], [0.9; 5]] {
            let mut n_checked = 0;
            for step in 0..400 {
                let radius = f64::from(step) * 0.005;
                let plane = Vector2::new(radius * 0.6, radius * -0.8);
                let Some(distorted) = brown_conrady(&k, plane) else { continue };
                // Very close to the limit the inverse is not accurate to 1e-12 because its derivative grows without
                // bound.
                if distorted.jacobian.determinant() < 1e-3 {
                    continue;
                }
                n_checked += 1;
                let back = undistort_brown_conrady(&k, distorted.value).unwrap_or_else(|| panic!("{k:?} at {radius}"));
                assert!((back - plane).norm() < 1e-11, "{k:?} at {radius}: off by {:e}", (back - plane).norm());
            }
            assert!(n_checked > 100, "{k:?}: only {n_checked} points inside the limit");
        }
    }
}
