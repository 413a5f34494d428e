//! How well the states of an arm came through, and the commands of its motions.

use std::time::Duration;

/// Width of a bin of delays.
const BIN_WIDTH: Duration = Duration::from_micros(20);
/// Bins; longer delays count in the last.
const N_BINS: usize = 2000;

/// What became of the states of one arm since it was opened.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StateStatistics {
    /// That came, and were told.
    pub n_received: u64,
    /// Whose numbers were passed over.
    pub n_lost: u64,
    /// That came twice, or after a later one.
    pub n_late: u64,
    /// Datagrams that are no state of this robot, or at an impossible time.
    pub n_rejected: u64,
    /// That gave way to newer ones because nobody took them.
    pub n_dropped: u64,
    /// How often the robot's clock began anew.
    pub n_restarts: u64,
    delays: Delays,
}

impl StateStatistics {
    /// Share of the robot's states that were received in order, 0 to 1; 1 before the first.
    pub fn success_frac(&self) -> f64 {
        match self.n_received + self.n_lost {
            0 => 1.0,
            n => self.n_received as f64 / n as f64,
        }
    }

    /// How late states came against the quickest ones: no later than this did a share of them.
    ///
    /// Told to 20 us, and up to 40 ms; the latest of all is [`StateStatistics::max_delay`].
    pub fn delay(&self, frac: f64) -> Duration {
        self.delays.at(frac)
    }

    /// How late the latest state came against the quickest ones.
    pub fn max_delay(&self) -> Duration {
        self.delays.max_delay
    }

    /// Counts a state that came so late.
    pub(super) fn count(&mut self, delay: Duration) {
        self.n_received += 1;
        self.delays.count(delay);
    }
}

impl std::fmt::Display for StateStatistics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { n_received, n_lost, n_late, n_rejected, n_dropped, n_restarts, .. } = self;
        let [median, p99, max] = self.delays.summary();
        write!(
            f,
            "{n_received} states, {:.2} % of those sent ({n_lost} lost, {n_late} late or twice, {n_rejected} refused); half of them \
             came at most {median} us after the quickest, 99 % at most {p99} us, all at most {max} us",
            100.0 * self.success_frac()
        )?;
        if *n_dropped + *n_restarts > 0 {
            write!(f, "; {n_dropped} gave way to newer ones, the robot's clock began anew {n_restarts} times")?;
        }
        Ok(())
    }
}

/// What became of the commands of all motions of one arm.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MotionStatistics {
    /// Motions that the robot let begin.
    pub n_motions: u64,
    /// States that came while one ran.
    pub n_cycles: u64,
    /// Of these, that were answered with a command.
    pub n_answered: u64,
    /// That came too late to be answered: the robot had gone on without.
    pub n_stale: u64,
    /// States that never came, or together with a newer one.
    pub n_lost: u64,
    /// Commands that the robot was seen to go on without, by where it is wanted next; where the jerk is small that is not seen.
    pub n_missed: u64,
    /// Commands that were held back so that the robot's own limits were kept.
    pub n_limited: u64,
    delays: Delays,
    summary: ReportedSuccess,
}

/// What the robot told of commands that reached it in time.
#[derive(Clone, Debug, Default, PartialEq)]
struct ReportedSuccess {
    n: u64,
    sum_frac: f64,
    min_frac: f64,
}

impl MotionStatistics {
    /// Share of the robot's states during motions that were answered, 0 to 1; 1 before the first.
    pub fn success_frac(&self) -> f64 {
        match self.n_cycles + self.n_lost {
            0 => 1.0,
            n => self.n_answered as f64 / n as f64,
        }
    }

    /// The robot's own `control_command_success_rate`, 0 to 1: on average, and the least of any 100 commands in a row; `None` where
    /// no motion was so long.
    pub fn robot_success_frac(&self) -> Option<[f64; 2]> {
        let ReportedSuccess { n, sum_frac, min_frac } = self.summary;
        (n > 0).then(|| [sum_frac / n as f64, min_frac])
    }

    /// How long after the quickest state could have come commands were sent: a share of them no later than this; 1 is all of them.
    pub fn delay(&self, frac: f64) -> Duration {
        self.delays.at(frac)
    }

    /// Counts a command that went so late.
    pub(super) fn count(&mut self, delay: Duration) {
        self.n_answered += 1;
        self.delays.count(delay);
    }

    /// Counts what the robot tells of its last 100 commands.
    pub(super) fn count_robot_success(&mut self, frac: f64) {
        let ReportedSuccess { n, sum_frac, min_frac } = &mut self.summary;
        *min_frac = if *n == 0 { frac } else { min_frac.min(frac) };
        *n += 1;
        *sum_frac += frac;
    }
}

impl std::fmt::Display for MotionStatistics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { n_motions, n_cycles, n_stale, n_lost, n_missed, n_limited, delays, .. } = self;
        let [median, p99, max] = delays.summary();
        write!(
            f,
            "{n_motions} motions of {n_cycles} cycles, {:.2} % answered ({n_lost} states lost, {n_stale} too late), half of them within \
             {median} us of the quickest state, 99 % within {p99} us, all within {max} us",
            100.0 * self.success_frac()
        )?;
        if let Some([mean, min]) = self.robot_success_frac() {
            let [mean, min] = [mean, min].map(|frac| 100.0 * frac);
            write!(f, "; the robot took {mean:.2} % in time, of any 100 at least {min:.0} %")?;
        }
        if *n_missed + *n_limited > 0 {
            write!(f, "; it was seen to go on without {n_missed} of them, {n_limited} were held back by its limits")?;
        }
        Ok(())
    }
}

/// How many delays were how long.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Delays {
    n: u64,
    bins: Vec<u64>,
    max_delay: Duration,
}

impl Default for Delays {
    fn default() -> Self {
        Self { n: 0, bins: vec![0; N_BINS], max_delay: Duration::ZERO }
    }
}

impl Delays {
    fn count(&mut self, delay: Duration) {
        self.n += 1;
        self.max_delay = self.max_delay.max(delay);
        let bin = usize::try_from(delay.as_micros() / BIN_WIDTH.as_micros()).unwrap_or(usize::MAX);
        self.bins[bin.min(N_BINS - 1)] += 1;
    }

    /// No longer than this is a share of them, to a bin's width; 1 is the longest.
    fn at(&self, frac: f64) -> Duration {
        if frac >= 1.0 {
            return self.max_delay;
        }
        let mut n_left = frac * self.n as f64;
        let bin = self.bins.iter().position(|n| {
            n_left -= *n as f64;
            n_left <= 0.0
        });
        let ix = u32::try_from(bin.unwrap_or(N_BINS - 1)).expect("there are few bins");
        (BIN_WIDTH * (ix + 1)).min(self.max_delay)
    }

    /// Half of them, 99 % of them, all of them, us.
    fn summary(&self) -> [u128; 3] {
        [0.5, 0.99, 1.0].map(|frac| self.at(frac).as_micros())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delay_quantiles_are_reported() {
        let mut statistics = StateStatistics::default();
        assert_eq!(statistics.success_frac(), 1.0);
        for micros in 0..1000 {
            statistics.count(Duration::from_micros(micros));
        }
        let within = |summary: Duration, micros: u128| summary.as_micros().abs_diff(micros) <= BIN_WIDTH.as_micros();
        assert!(within(statistics.delay(0.5), 500), "{statistics}");
        assert!(within(statistics.delay(0.99), 990), "{statistics}");
        statistics.count(Duration::from_secs(7));
        assert_eq!(statistics.max_delay(), Duration::from_secs(7));
        statistics.n_lost = 1001;
        assert_eq!(statistics.success_frac(), 0.5);
        assert!(statistics.to_string().contains("50.00 %"), "{statistics}");
    }

    #[test]
    fn robot_success_rate_is_reported() {
        let mut statistics = MotionStatistics { n_cycles: 3, n_lost: 1, ..MotionStatistics::default() };
        assert_eq!(statistics.robot_success_frac(), None);
        statistics.count(Duration::from_millis(1));
        statistics.count_robot_success(0.98);
        statistics.count_robot_success(0.9);
        assert_eq!(statistics.success_frac(), 0.25);
        let [mean, min] = statistics.robot_success_frac().unwrap();
        assert!((mean - 0.94).abs() < 1e-12 && min == 0.9);
        assert!(statistics.to_string().contains("at least 90 %"), "{statistics}");
    }
}
