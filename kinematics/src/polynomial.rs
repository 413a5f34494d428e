//! Polynomials that must be positive on an interval, and inverses of rising functions.

/// A root search stops when its step is below this fraction of the value. The fraction is just
/// above rounding errors.
pub(crate) const CONVERGED: f64 = 1e-15;

/// The smallest `x` from 0 to `limit` at which a function reaches `target`. The function is 0 at 0
/// and must rise up to `x`. If it does not, the result is `None`.
///
/// Uses Newton's method inside a bracket that shrinks with every step.
///
/// * `function`: value and derivative at `x`.
/// * `is_rising_to`: whether the derivative is positive from 0 to `x`.
pub(crate) fn solve_rising(
    function: impl Fn(f64) -> (f64, f64),
    is_rising_to: impl Fn(f64) -> bool,
    target: f64,
    limit: f64,
) -> Option<f64> {
    // Bisection alone needs about 60 steps, because each step gains one of the 53 bits of an f64.
    // The higher limit only guards against a bracket that stops shrinking.
    const MAX_STEPS: usize = 200;
    let value = |x: f64| function(x).0 - target;
    // First, a bracket is found. At `low`, the value is below the target. At `high`, the value is
    // above the target, or the derivative has changed sign. Doubling reaches any magnitude in a few
    // steps, so callers need not know how strongly their lens distorts.
    let mut low = 0.0;
    let mut high = target.min(limit);
    while is_rising_to(high) && value(high) < 0.0 {
        // The functions of callers compute squares of `high`. These squares would overflow after
        // the next doubling.
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
        let (reached, derivative) = function(x);
        if rising && reached - target < 0.0 {
            low = x;
        } else {
            high = x;
        }
        // Newton's method converges quadratically near the root. Beyond the maximum of the
        // function, it could converge to another root, and where the derivative is small, it jumps
        // far away. Bisection is slower but always halves the bracket.
        let newton = x - (reached - target) / derivative;
        let next = if rising && newton > low && newton < high {
            newton
        } else {
            0.5 * (low + high)
        };
        let step = (next - x).abs();
        x = next;
        if step <= CONVERGED * x || high - low <= CONVERGED * high {
            break;
        }
    }
    // The search may also end at a point where the function stops rising below the target, or after
    // the last step. This check rejects both cases, so that no wrong root is returned. The
    // tolerance is far above the rounding errors of a few operations, and far below any error that
    // a pixel could show.
    const CLOSE: f64 = 1e-12;
    (is_rising_to(x) && value(x).abs() <= CLOSE * target.max(1.0)).then_some(x)
}

/// Value of the polynomial with these coefficients. The constant coefficient comes first.
pub(crate) fn evaluate<const N: usize>(p: &[f64; N], s: f64) -> f64 {
    p.iter()
        .rev()
        .fold(0.0, |sum, coefficient| sum * s + coefficient)
}

/// Whether a polynomial with `p[0] > 0` is positive from 0 to `end`.
///
/// The Bernstein coefficients on the interval bound the polynomial from below. If they are not
/// conclusive, the interval is halved (Lane and Riesenfeld 1981). For a point well inside the range
/// of the lens, the first test is conclusive.
pub(crate) fn positive_on<const N: usize>(p: &[f64; N], end: f64) -> bool {
    // Each halving divides the distance between the coefficients and the polynomial by four. Only a
    // polynomial that nearly touches zero therefore needs many halvings. It is then rejected, which
    // is the safe answer. The bound also ends the recursion for NaN.
    const MAX_HALVINGS: u32 = 30;
    let mut power = *p;
    let mut scale = 1.0;
    for coefficient in &mut power {
        // A coefficient of zero is skipped, because zero times an overflowed scale would be NaN.
        if *coefficient != 0.0 {
            *coefficient *= scale;
        }
        scale *= end;
    }
    let weights = const { bernstein_weights::<N>() };
    let bernstein = weights.map(|row| {
        row.iter()
            .zip(&power)
            .map(|(weight, term)| weight * term)
            .sum()
    });
    all_positive(&bernstein, MAX_HALVINGS)
}

/// Matrix from power to Bernstein coefficients of a polynomial with `N` coefficients: `choose(j, i)
/// / choose(N - 1, i)` in row `j` and column `i`.
const fn bernstein_weights<const N: usize>() -> [[f64; N]; N] {
    let mut weights = [[0.0; N]; N];
    let mut row = 0;
    while row < N {
        weights[row][0] = 1.0;
        let mut column = 1;
        while column <= row {
            let previous = weights[row][column - 1];
            // From `choose(j, i) / choose(j, i - 1) = (j - i + 1) / i`, where the `i` cancels.
            weights[row][column] = previous * (row + 1 - column) as f64 / (N - column) as f64;
            column += 1;
        }
        row += 1;
    }
    weights
}

/// Whether the polynomial with these Bernstein coefficients is positive on its interval.
fn all_positive<const N: usize>(bernstein: &[f64; N], halvings_left: u32) -> bool {
    if bernstein.iter().all(|&coefficient| coefficient > 0.0) {
        return true;
    }
    // The first and last coefficients are values of the polynomial itself. The comparison is
    // written so that NaN is not positive.
    if !(bernstein[0] > 0.0 && bernstein[N - 1] > 0.0) || halvings_left == 0 {
        return false;
    }
    let mut left = [0.0; N];
    let mut right = *bernstein;
    // This is De Casteljau's algorithm at the middle. The first value of each level is a
    // coefficient of the left half.
    for (level, first) in left.iter_mut().enumerate() {
        *first = right[0];
        for at in 0..N - 1 - level {
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
        // (s - 1)² (s + 1)⁴ + dip has one minimum.
        let sextic = |dip: f64| [1.0 + dip, 2.0, -1.0, -4.0, -1.0, 2.0, 1.0];
        assert!(positive_on(&sextic(1e-3), 5.0));
        assert!(!positive_on(&sextic(-1e-3), 5.0));
        assert!(positive_on(&sextic(-1e-3), 0.9));
    }
}
