//! Statistics over runs, which are spreads, times to a PSNR level, and break points.

use numbers::quantile::median;

/// Smallest and largest value.
pub(crate) fn extent(values: &[f64]) -> Option<[f64; 2]> {
    let first = *values.first()?;
    Some(values.iter().fold([first; 2], |[low, high], value| {
        [low.min(*value), high.max(*value)]
    }))
}

/// Sample standard deviation (divided by n - 1). `None` for fewer than two values.
pub(crate) fn sample_std(values: &[f64]) -> Option<f64> {
    if values.len() < 2 {
        return None;
    }
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    Some(
        (values
            .iter()
            .map(|value| (value - mean).powi(2))
            .sum::<f64>()
            / (n - 1.0))
            .sqrt(),
    )
}

/// Time at which a curve of `(seconds, dB)` first reaches `target_db`, interpolated over the
/// logarithm of time.
///
/// For a curve that starts above the target, this is the time of its first point.
pub(crate) fn secs_to(curve: &[(f64, f64)], target_db: f64) -> Option<f64> {
    let at = curve.iter().position(|(_, psnr)| *psnr >= target_db)?;
    let (secs, psnr) = curve[at];
    // The gain per doubling of the time changes slowly. Over the logarithm of time, curves are
    // therefore nearly straight between two evaluations.
    let Some((previous_secs, earlier_psnr)) = at.checked_sub(1).map(|before| curve[before]) else {
        return Some(secs);
    };
    let frac = (target_db - earlier_psnr) / (psnr - earlier_psnr);
    Some(previous_secs * (secs / previous_secs).powf(frac))
}

/// Slope of a line through `(x, y)` by the Theil-Sen estimator. It is the median of the slopes
/// between all pairs of points, which is robust to outliers. `None` with fewer than two values of
/// x.
///
/// Source: Theil 1950, Sen 1968.
pub(crate) fn theil_sen(points: &[(f64, f64)]) -> Option<f64> {
    let pairs = points
        .iter()
        .enumerate()
        .flat_map(|(ix, from)| points[ix + 1..].iter().map(move |to| (from, to)));
    let rates: Vec<f64> = pairs
        .filter(|(from, to)| to.0 != from.0)
        .map(|(from, to)| (to.1 - from.1) / (to.0 - from.0))
        .collect();
    median(&rates)
}

/// Interpolation of values between two levels of a disturbance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Interpolation {
    /// Linear in the level.
    Linear,
    /// Linear in the logarithm of the level, which must be above 0.
    Log,
}

/// The level at which a curve of `(level, dB)` has first fallen by `drop_db` from its first point.
/// `None` if it never falls that far.
pub(crate) fn break_point(
    curve: &[(f64, f64)],
    drop_db: f64,
    interpolation: Interpolation,
) -> Option<f64> {
    let floor = curve.first()?.1 - drop_db;
    let at = curve.iter().position(|(_, psnr)| *psnr <= floor)?;
    let (before, psnr_before) = curve[at.checked_sub(1)?];
    let (level, psnr) = curve[at];
    // The previous point is above the floor, so the divisor is above 0.
    let frac = (psnr_before - floor) / (psnr_before - psnr);
    Some(match interpolation {
        Interpolation::Linear => before + frac * (level - before),
        Interpolation::Log => before * (level / before).powf(frac),
    })
}

/// Minimum growth of a count. For less growth, the gain per doubling would be mostly noise.
const MIN_GROWTH: f64 = 1.05;

/// Gain per doubling of the count between two points `(count, dB)`. `None` if the count grew by
/// less than [`MIN_GROWTH`].
pub(crate) fn db_per_doubling(fewer: (f64, f64), more: (f64, f64)) -> Option<f64> {
    let growth = more.0 / fewer.0;
    (growth >= MIN_GROWTH).then(|| (more.1 - fewer.1) / growth.log2())
}

#[cfg(test)]
mod tests {
    use super::*;

    const TOLERANCE: f64 = 1e-12; // Rounding errors of a few operations on numbers near 1.

    fn assert_close(got: Option<f64>, expected: f64) {
        assert!(
            got.is_some_and(|got| (got - expected).abs() < TOLERANCE * expected.abs().max(1.0)),
            "{got:?}, not {expected}"
        );
    }

    #[test]
    fn extent_of_nothing_is_none() {
        assert_eq!(extent(&[4.0, 1.0, 3.0]), Some([1.0, 4.0]));
        assert_eq!(extent(&[]), None);
    }

    #[test]
    fn sample_std_uses_n_minus_one() {
        assert_eq!(sample_std(&[1.0]), None);
        assert_close(
            sample_std(&[2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0]),
            (32.0_f64 / 7.0).sqrt(),
        );
    }

    #[test]
    fn time_to_quality_is_interpolated() {
        let curve = [(1.0, 20.0), (4.0, 24.0), (16.0, 23.0), (64.0, 30.0)];
        assert_close(secs_to(&curve, 22.0), 2.0);
        assert_close(secs_to(&curve, 24.0), 4.0);
        assert_eq!(
            secs_to(&curve, 19.0),
            Some(1.0),
            "the time of the first point"
        );
        assert_eq!(secs_to(&curve, 31.0), None);
    }

    #[test]
    fn break_point_is_interpolated() {
        let curve = [(0.0, 30.0), (2.0, 29.6), (4.0, 28.6), (8.0, 24.6)];
        assert_close(break_point(&curve, 1.0, Interpolation::Linear), 3.2);
        assert_close(break_point(&curve, 3.0, Interpolation::Linear), 5.6);
        assert_eq!(
            break_point(&curve, 6.0, Interpolation::Linear),
            None,
            "it never falls that far"
        );
        assert_eq!(break_point(&[], 1.0, Interpolation::Linear), None);
        let fewer = [(100.0, 30.0), (25.0, 28.0)];
        assert_close(break_point(&fewer, 1.0, Interpolation::Log), 50.0);
    }

    #[test]
    fn gain_per_doubling_needs_a_growing_count() {
        assert_close(db_per_doubling((1000.0, 20.0), (4000.0, 23.0)), 1.5);
        assert_close(db_per_doubling((1000.0, 20.0), (2000.0, 19.5)), -0.5);
        assert_eq!(db_per_doubling((1000.0, 20.0), (1000.0, 21.0)), None);
        assert_eq!(db_per_doubling((1000.0, 20.0), (900.0, 21.0)), None);
    }

    #[test]
    fn theil_sen_is_robust_to_outliers() {
        let mut points: Vec<(f64, f64)> = (0..50)
            .map(|x| (f64::from(x), 3.0 - 0.25 * f64::from(x)))
            .collect();
        points[20].1 = 1e6;
        points[21].1 = -1e6;
        assert!((theil_sen(&points).expect("many points") + 0.25).abs() < 1e-9);
        assert_eq!(theil_sen(&[(1.0, 2.0)]), None);
        assert_eq!(theil_sen(&[(1.0, 2.0), (1.0, 3.0)]), None);
    }
}
