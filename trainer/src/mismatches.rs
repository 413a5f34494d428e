//! Comparing many numbers in a test and reporting every one that is off.

use std::fmt::Display;

/// Collects the numbers that differ by more than their tolerance.
#[derive(Debug, Default)]
pub(crate) struct Mismatches {
    n_checked: usize,
    wrong: Vec<String>,
    /// Largest difference as a multiple of its tolerance.
    worst: f64,
}

impl Mismatches {
    /// Notes the pair unless `|got - expected| <= abs + rel * max(|got|, |expected|)`; a NaN never passes.
    pub(crate) fn check(&mut self, name: impl Display, got: f64, expected: f64, abs: f64, rel: f64) {
        let share = (got - expected).abs() / (abs + rel * got.abs().max(expected.abs()));
        self.n_checked += 1;
        self.worst = self.worst.max(share);
        let passes = share <= 1.0; // False for NaN.
        if !passes {
            self.wrong.push(format!("{name}: got {got:.9e}, expected {expected:.9e} ({share:.1} x tolerance)"));
        }
    }

    /// How many numbers were off.
    pub(crate) fn n_wrong(&self) -> usize {
        self.wrong.len()
    }

    /// Panics with every mismatch, or where nothing was compared at all.
    #[track_caller]
    pub(crate) fn assert_none(&self) {
        assert!(self.n_checked > 0, "nothing was compared");
        let Self { n_checked, wrong, worst } = self;
        assert!(
            wrong.is_empty(),
            "{} of {n_checked} are off, worst {worst:.1} x tolerance:\n{}",
            wrong.len(),
            wrong.join("\n")
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_numbers_are_counted_and_named() {
        let mut wrong = Mismatches::default();
        wrong.check("right", 1.0, 1.0 + 1e-9, 1e-8, 0.0);
        wrong.check("wrong", 1.0, 1.001, 1e-8, 1e-6);
        wrong.check("negated", 1e-3, -1e-3, 1e-8, 1e-6);
        wrong.check("missing", 0.0, 1e-3, 1e-8, 1e-6);
        wrong.check("not a number", f64::NAN, 1.0, 1.0, 1.0);
        wrong.check("endless", f64::INFINITY, 1.0, 1.0, 0.0);
        assert_eq!(wrong.n_wrong(), 5);
        assert!(wrong.wrong[0].starts_with("wrong: got"), "{}", wrong.wrong[0]);
    }

    #[test]
    #[should_panic(expected = "1 of 1 are off")]
    fn a_wrong_number_fails_the_test() {
        let mut wrong = Mismatches::default();
        wrong.check("x", 2.0, 1.0, 1e-9, 1e-9);
        wrong.assert_none();
    }

    #[test]
    #[should_panic(expected = "nothing was compared")]
    fn comparing_nothing_fails_the_test() {
        Mismatches::default().assert_none();
    }
}
