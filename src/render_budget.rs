//! How much of the time may go into pictures while models learn.
//!
//! Training saves time up, pictures spend it, one for one: a picture is drawn at once while there is something left, and training keeps at
//! least half of the time however many pictures are asked for.

use std::time::Duration;

/// What training saves up at most, seconds, or as much as its last slice took: so long a burst of pictures is drawn at once.
const MAX_SAVED_SECS: f64 = 0.1;
/// What pictures owe at most, seconds: after one that takes longer, training catches up on this much.
const MAX_OWED_SECS: f64 = 1.0;

/// The time that is left for pictures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct RenderBudget {
    /// Saved if positive, owed if negative.
    balance_secs: f64,
}

impl Default for RenderBudget {
    fn default() -> Self {
        Self { balance_secs: MAX_SAVED_SECS }
    }
}

impl RenderBudget {
    /// Whether a picture may be drawn now.
    pub(crate) fn may_render(self) -> bool {
        self.balance_secs >= 0.0
    }

    /// Adds time that went into training.
    pub(crate) fn add_training(&mut self, spent: Duration) {
        let spent_secs = spent.as_secs_f64();
        self.balance_secs = (self.balance_secs + spent_secs).min(MAX_SAVED_SECS.max(spent_secs));
    }

    /// Takes off time that went into a picture.
    pub(crate) fn add_render(&mut self, spent: Duration) {
        self.balance_secs = (self.balance_secs - spent.as_secs_f64()).max(-MAX_OWED_SECS);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: Duration = Duration::from_millis(4);

    /// Shares of the time that pictures and training get, where pictures are asked for without end.
    fn render_frac(picture: Duration, step: Duration) -> f64 {
        let (mut budget, mut rendered, mut trained) = (RenderBudget::default(), Duration::ZERO, Duration::ZERO);
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
    fn training_keeps_half_of_the_time_whatever_pictures_take() {
        for millis in [1, 3, 40, 400] {
            let frac = render_frac(Duration::from_millis(millis), STEP);
            assert!((0.49..0.51).contains(&frac), "{millis} ms a picture: {frac}");
        }
        // A picture on a processor may take longer than anybody waits for the next one.
        assert!(render_frac(Duration::from_secs(10), STEP) > 0.8);
    }

    #[test]
    fn all_stages_of_a_picture_are_drawn_at_once_and_a_burst_ends() {
        let mut budget = RenderBudget::default();
        let mut n_drawn = 0;
        while budget.may_render() {
            budget.add_render(Duration::from_millis(3));
            n_drawn += 1;
        }
        assert_eq!(n_drawn, 34);
        budget.add_training(STEP);
        assert!(budget.may_render());
        // On a processor a step takes seconds: all stages of a picture are drawn between two of them.
        budget.add_training(Duration::from_secs(2));
        for stage_millis in [100, 500, 1300] {
            assert!(budget.may_render());
            budget.add_render(Duration::from_millis(stage_millis));
        }
    }
}
