//! Medians and quantiles of finite numbers.
//!
//! Except for [`median`], every result is one of the given values. [`Rank`] selects this value.

/// Selects the value that is returned if the quantile falls between two of `n` sorted values.
/// Indices start at 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rank {
    /// The smallest value that at least the fraction `frac` of the values do not exceed. Its index
    /// is `ceil(frac n) - 1`.
    ///
    /// This is the inverse of the empirical distribution function, which is type 1 of Hyndman and
    /// Fan 1996.
    Lower,
    /// The value at index `round(frac (n - 1))`.
    Nearest,
    /// The value above the first `floor(frac n)` values.
    Upper,
}

/// The median. For an even number of values, it is the mean of the two middle values. `None`
/// without values.
pub fn median(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let middle_ix = sorted.len() / 2;
    // The middle is one value or lies between two.
    match sorted.len() {
        0 => None,
        n if n % 2 == 1 => Some(sorted[middle_ix]),
        _ => Some(0.5 * (sorted[middle_ix - 1] + sorted[middle_ix])),
    }
}

/// The quantile at `frac`, from 0 to 1. `None` if there are no values. Reorders the values.
///
/// ```
/// use numbers::quantile::{Rank, quantile};
///
/// let mut values = [4.0, 1.0, 3.0, 2.0];
/// assert_eq!(quantile(&mut values, 0.5, Rank::Lower), Some(2.0));
/// assert_eq!(quantile(&mut values, 0.5, Rank::Upper), Some(3.0));
/// assert_eq!(quantile(&mut values, 1.0, Rank::Lower), Some(4.0));
/// ```
pub fn quantile(values: &mut [f64], frac: f64, rank: Rank) -> Option<f64> {
    let last_ix = values.len().checked_sub(1)?;
    let n = values.len() as f64;
    let ix = match rank {
        // At a fraction of zero, this index is below the first index, so it is clamped below.
        Rank::Lower => (frac * n).ceil() - 1.0,
        Rank::Nearest => (frac * (n - 1.0)).round(),
        Rank::Upper => (frac * n).floor(),
    };
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "limited to the indices"
    )]
    let ix = (ix.max(0.0) as usize).min(last_ix);
    Some(*values.select_nth_unstable_by(ix, f64::total_cmp).1)
}

/// The range without the lowest and the highest `floor(outside_frac n)` values, for fractions below
/// one half. `None` without values. Reorders the values.
pub fn trimmed_range(values: &mut [f64], outside_frac: f64) -> Option<[f64; 2]> {
    let last_ix = values.len().checked_sub(1)?;
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a fraction of a length"
    )]
    // Both ends lose the same number, and at least one value remains.
    let n_outside = ((outside_frac * values.len() as f64) as usize).min(last_ix / 2);
    let low = *values.select_nth_unstable_by(n_outside, f64::total_cmp).1;
    let high = *values
        .select_nth_unstable_by(last_ix - n_outside, f64::total_cmp)
        .1;
    Some([low, high])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    #[test]
    fn medians_of_odd_and_even_numbers() {
        assert_eq!(median(&[]), None);
        assert_eq!(median(&[3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&[4.0, 1.0, 3.0, 2.0]), Some(2.5));
    }

    #[test]
    fn quantiles_match_their_definitions_in_sorted_values() {
        let mut random = Random::new(1);
        for n in 1..200_usize {
            let mut values: Vec<f64> = (0..n).map(|_| random.unit()).collect();
            let mut sorted = values.clone();
            sorted.sort_by(f64::total_cmp);
            for eighths in 0..=8 {
                let frac = eighths as f64 / 8.0;
                let expected = [
                    (Rank::Lower, (n * eighths).div_ceil(8).saturating_sub(1)),
                    (Rank::Nearest, (2 * (n - 1) * eighths + 8) / 16),
                    (Rank::Upper, (n * eighths / 8).min(n - 1)),
                ];
                for (rank, ix) in expected {
                    assert_eq!(
                        quantile(&mut values, frac, rank),
                        Some(sorted[ix]),
                        "{rank:?}, {eighths} eighths of {n}"
                    );
                }
            }
            let n_outside = n / 50;
            assert_eq!(
                trimmed_range(&mut values, 0.02),
                Some([sorted[n_outside], sorted[n - 1 - n_outside]]),
                "{n}"
            );
        }
        for rank in [Rank::Lower, Rank::Nearest, Rank::Upper] {
            assert_eq!(quantile(&mut [], 0.5, rank), None);
        }
        assert_eq!(trimmed_range(&mut [], 0.02), None);
    }
}
