//! Compares many numbers in a test and reports all mismatches.

use std::fmt::Display;

/// Collects the numbers that differ by more than their tolerance.
#[derive(Debug, Default)]
pub(crate) struct Mismatches {
    n_checked: usize,
    mismatches: Vec<String>,
    /// Largest difference as a multiple of its tolerance.
    max_ratio: f64,
}

impl Mismatches {
    /// Records a mismatch unless `|got - expected| <= abs + rel * max(|got|, |expected|)`. NaN is
    /// always a mismatch.
    pub(crate) fn check(
        &mut self,
        name: impl Display,
        got: f64,
        expected: f64,
        abs: f64,
        rel: f64,
    ) {
        let ratio = (got - expected).abs() / (abs + rel * got.abs().max(expected.abs()));
        self.n_checked += 1;
        self.max_ratio = self.max_ratio.max(ratio);
        let passes = ratio <= 1.0; // This comparison is false for NaN.
        if !passes {
            self.mismatches.push(format!(
                "{name}: got {got:.9e}, expected {expected:.9e} ({ratio:.1} x tolerance)"
            ));
        }
    }

    /// Number of mismatches.
    pub(crate) fn n_mismatches(&self) -> usize {
        self.mismatches.len()
    }

    /// Panics with all mismatches, or if nothing was compared.
    #[track_caller]
    pub(crate) fn assert_none(&self) {
        assert!(self.n_checked > 0, "nothing was compared");
        let Self {
            n_checked,
            mismatches,
            max_ratio,
        } = self;
        assert!(
            mismatches.is_empty(),
            "{} of {n_checked} values differ, worst {max_ratio:.1} x tolerance:\n{}",
            mismatches.len(),
            mismatches.join("\n")
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mismatches_are_counted_and_named() {
        let mut mismatches = Mismatches::default();
        mismatches.check("right", 1.0, 1.0 + 1e-9, 1e-8, 0.0);
        mismatches.check("wrong", 1.0, 1.001, 1e-8, 1e-6);
        mismatches.check("negated", 1e-3, -1e-3, 1e-8, 1e-6);
        mismatches.check("missing", 0.0, 1e-3, 1e-8, 1e-6);
        mismatches.check("not a number", f64::NAN, 1.0, 1.0, 1.0);
        mismatches.check("endless", f64::INFINITY, 1.0, 1.0, 0.0);
        assert_eq!(mismatches.n_mismatches(), 5);
        assert!(
            mismatches.mismatches[0].starts_with("wrong: got"),
            "{}",
            mismatches.mismatches[0]
        );
    }

    #[test]
    #[should_panic(expected = "1 of 1 values differ")]
    fn mismatch_panics() {
        let mut mismatches = Mismatches::default();
        mismatches.check("x", 2.0, 1.0, 1e-9, 1e-9);
        mismatches.assert_none();
    }

    #[test]
    #[should_panic(expected = "nothing was compared")]
    fn empty_comparison_panics() {
        Mismatches::default().assert_none();
    }
}
