//! Logs pauses of the growth of a model. The first pause is logged when it begins. All other pauses
//! are logged in one line at the end, because growth pauses and continues many times on a busy
//! computer.

use super::MAX_LIVE_STEP_MILLIS;
use std::time::{Duration, Instant};

/// The pauses of growth so far.
#[derive(Debug, Default)]
pub(super) struct GrowthLog {
    n_pauses: u32,
    /// Time of all pauses that have ended.
    paused: Duration,
    /// When the pause in progress began.
    since: Option<Instant>,
}

impl GrowthLog {
    /// Logs a change at `now`, when the model has this size and step time.
    pub(super) fn changed(
        &mut self,
        is_paused: bool,
        primitives: u64,
        step_millis: f64,
        now: Instant,
    ) {
        self.record(is_paused, now);
        let text = if is_paused {
            format!(
                "growth is paused at {primitives} splats: a step takes {step_millis:.0} ms, limit {MAX_LIVE_STEP_MILLIS} ms"
            )
        } else {
            format!("growth continues at {primitives} splats: a step takes {step_millis:.0} ms")
        };
        if is_paused && self.n_pauses == 1 {
            log::info!("{text}");
        } else {
            log::debug!("{text}");
        }
    }

    fn record(&mut self, is_paused: bool, now: Instant) {
        if is_paused {
            self.n_pauses += 1;
            self.since = Some(now);
        } else if let Some(since) = self.since.take() {
            self.paused += now.duration_since(since);
        }
    }

    /// The pauses up to `now` in one sentence; `None` if there were none.
    pub(super) fn summary(&self, now: Instant) -> Option<String> {
        let in_progress = self.since.map(|since| now.duration_since(since));
        let secs = (self.paused + in_progress.unwrap_or_default()).as_secs_f64();
        let times = match self.n_pauses {
            0 => return None,
            1 => "once".to_owned(),
            n => format!("{n} times"),
        };
        Some(format!(
            "growth was paused {times}, for {secs:.0} s in total, because steps took more than {MAX_LIVE_STEP_MILLIS} ms"
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_are_summarized() {
        let start = Instant::now();
        let at = |secs: u64| start + Duration::from_secs(secs);
        let mut log = GrowthLog::default();
        assert_eq!(log.summary(at(9)), None);
        log.changed(true, 1000, 400.0, at(10));
        assert!(
            log.summary(at(12))
                .is_some_and(|text| text.contains("paused once, for 2 s"))
        );
        log.changed(false, 1000, 100.0, at(15));
        log.changed(true, 2000, 400.0, at(20));
        log.changed(false, 2000, 100.0, at(24));
        assert!(
            log.summary(at(99))
                .is_some_and(|text| text.contains("paused 2 times, for 9 s"))
        );
    }
}
