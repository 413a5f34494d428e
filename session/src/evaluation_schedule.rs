//! The evaluation schedule: 0.25, 0.5, 1, 2, 4, 8, 16, 32, 60, 120, 240 seconds of training and so
//! on.

/// The evaluation schedule of a session.
#[derive(Clone, Debug)]
pub struct EvaluationSchedule {
    next_secs: f64,
}

impl Default for EvaluationSchedule {
    fn default() -> Self {
        Self { next_secs: 0.25 }
    }
}

impl EvaluationSchedule {
    /// Whether an evaluation time was reached since the last call. Several times reached at once
    /// count as one.
    pub fn reached(&mut self, secs: f64) -> bool {
        let mut reached = false;
        while secs >= self.next_secs {
            self.next_secs = next_after(self.next_secs);
            reached = true;
        }
        reached
    }
}

/// The latest evaluation time at `secs`; `None` before the first.
pub fn latest(secs: f64) -> Option<f64> {
    up_to(secs).last()
}

/// The evaluation times up to `secs`.
pub fn up_to(secs: f64) -> impl Iterator<Item = f64> {
    let first = EvaluationSchedule::default().next_secs;
    std::iter::successors(Some(first), |evaluation_secs| {
        Some(next_after(*evaluation_secs))
    })
    .take_while(move |evaluation_secs| *evaluation_secs <= secs)
}

/// Returns twice the time, except that 60 s follows 32 s, so that later times are whole minutes.
/// Models improve more and more slowly. With a constant factor, the curve shows both the first
/// second and the last minutes.
fn next_after(evaluation_secs: f64) -> f64 {
    if evaluation_secs == 32.0 {
        60.0
    } else {
        2.0 * evaluation_secs
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_evaluation_time_is_reached_once() {
        let mut schedule = EvaluationSchedule::default();
        let reached: Vec<f64> = (0..=4000)
            .map(|n| f64::from(n) * 0.125)
            .filter(|secs| schedule.reached(*secs))
            .collect();
        assert_eq!(
            reached,
            [
                0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 120.0, 240.0, 480.0
            ]
        );
    }

    #[test]
    fn latest_is_the_last_time_reached() {
        assert_eq!(
            [0.2, 0.25, 0.3, 59.0, 61.0].map(latest),
            [None, Some(0.25), Some(0.25), Some(32.0), Some(60.0)]
        );
        assert_eq!(up_to(4.5).collect::<Vec<_>>(), [0.25, 0.5, 1.0, 2.0, 4.0]);
    }

    #[test]
    fn skipped_times_count_once() {
        let mut schedule = EvaluationSchedule::default();
        assert!(schedule.reached(50.0));
        assert!(!schedule.reached(59.0));
        assert!(schedule.reached(60.0));
    }
}
