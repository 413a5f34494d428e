//! Limits the share of time that is spent on drawing pictures during training.
//!
//! Each second of training adds credit for pictures. The credit is one second on a software
//! adapter, and 0.66 seconds on a GPU. Pictures are drawn immediately while credit is left.
//! Training therefore keeps at least 1/2 of the time on a software adapter and 3/5 on a GPU, unless
//! a single picture takes longer than the maximum debt.

use std::time::Duration;
use viz::Hub;

/// Maximum credit, seconds, which is the maximum length of a burst of pictures. After a longer
/// slice of training, the maximum is the length of that slice. With a larger credit, a viewer that
/// connects later would delay new keyframes by a longer burst.
const MAX_CREDIT_SECS: f64 = 0.1;
/// Maximum debt, seconds. After a picture that takes longer, training makes up for only this much
/// time.
const MAX_DEBT_SECS: f64 = 1.0;

/// Credit per second of training on a CPU. Pictures take seconds there and viewers wait long, so
/// pictures get half of the time.
const CREDIT_ON_SOFTWARE: f64 = 1.0;
/// Credit per second of training on a GPU. Pictures get `0.66 / 1.66` of the time, which is 40 %.
/// With eight viewers that request pictures back to back, training keeps about 70 % of its rate,
/// because part of the work overlaps (`docs/benchmarks/2026-11-26-live.md`). More credit would
/// shorten the wait for pictures at the cost of training steps.
const CREDIT_ON_GPU: f64 = 0.66;

/// The time available for pictures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct RenderBudget {
    /// Credit if positive, debt if negative.
    balance_secs: f64,
    /// Credit per second of training.
    rate: f64,
}

impl RenderBudget {
    /// Full credit.
    pub(crate) fn new(is_software: bool) -> Self {
        Self {
            balance_secs: MAX_CREDIT_SECS,
            rate: if is_software {
                CREDIT_ON_SOFTWARE
            } else {
                CREDIT_ON_GPU
            },
        }
    }

    /// Restores the full credit.
    pub(crate) fn refill(&mut self) {
        self.balance_secs = self.balance_secs.max(MAX_CREDIT_SECS);
    }

    /// Whether a picture is requested and may be drawn now.
    pub(crate) fn is_picture_due(self, hub: &Hub) -> bool {
        self.may_render() && hub.pictures().wait_for_request(Duration::ZERO)
    }

    /// Whether a picture may be drawn now.
    pub(crate) fn may_render(self) -> bool {
        self.balance_secs >= 0.0
    }

    /// Adds time spent on training.
    pub(crate) fn add_training(&mut self, spent: Duration) {
        let spent_secs = self.rate * spent.as_secs_f64();
        // Credit does not accumulate over several slices without pictures. A single long slice, as
        // on a CPU, still gives enough credit for a picture that takes the same time.
        self.balance_secs = (self.balance_secs + spent_secs).min(MAX_CREDIT_SECS.max(spent_secs));
    }

    /// Subtracts time spent on a picture.
    pub(crate) fn add_render(&mut self, spent: Duration) {
        // The debt is limited, so that one picture of 10 s does not stop all pictures for 10 s.
        self.balance_secs = (self.balance_secs - spent.as_secs_f64()).max(-MAX_DEBT_SECS);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: Duration = Duration::from_millis(4);

    /// Fraction of the time that pictures get if they are requested back to back.
    fn render_frac(is_software: bool, picture: Duration, step: Duration) -> f64 {
        let (mut budget, mut rendered, mut trained) = (
            RenderBudget::new(is_software),
            Duration::ZERO,
            Duration::ZERO,
        );
        for _ in 0..10_000 {
            while budget.may_render() {
                budget.add_render(picture);
                rendered += picture;
            }
            budget.add_training(step);
            trained += step;
        }
        rendered.as_secs_f64() / (rendered + trained).as_secs_f64()
    }

    #[test]
    fn training_keeps_its_share_of_the_time() {
        for (is_software, share) in [(true, 1.0 / 2.0), (false, 2.0 / 5.0)] {
            for millis in [1, 3, 40, 400] {
                let frac = render_frac(is_software, Duration::from_millis(millis), STEP);
                assert!(
                    (frac - share).abs() < 0.01,
                    "{millis} ms per picture: {frac}"
                );
            }
        }
        // On a CPU a picture may take so long that its debt is capped.
        assert!(render_frac(true, Duration::from_secs(10), STEP) > 0.8);
    }

    #[test]
    fn bursts_of_pictures_are_bounded() {
        let mut budget = RenderBudget::new(true);
        let mut n_drawn = 0;
        while budget.may_render() {
            budget.add_render(Duration::from_millis(3));
            n_drawn += 1;
        }
        assert_eq!(n_drawn, 34);
        budget.add_training(STEP);
        assert!(budget.may_render());
        // On a CPU a step takes seconds, so all stages of a picture are drawn between two steps.
        budget.add_training(Duration::from_secs(2));
        for stage_millis in [100, 500, 1300] {
            assert!(budget.may_render());
            budget.add_render(Duration::from_millis(stage_millis));
        }
    }
}
