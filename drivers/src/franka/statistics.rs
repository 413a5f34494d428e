//! Statistics of the received states of an arm, and of the commands of its motions.

use std::time::Duration;

/// Width of a histogram bin. Delays of interest range from some tens of microseconds to a
/// millisecond, so this width is fine enough for a median. With this width, 2000 bins reach 40 ms.
/// After such a delay, a robot has stopped in any case.
const BIN_WIDTH: Duration = Duration::from_micros(20);
/// Number of bins; longer delays count in the last bin.
const N_BINS: usize = 2000;

/// Statistics of the states of one arm since it was opened.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StateStatistics {
    /// States that were received in order.
    pub n_received: u64,
    /// States that never arrived, counted by gaps in their numbers.
    pub n_lost: u64,
    /// States that arrived twice, or after a later one.
    pub n_late: u64,
    /// Datagrams that are not states of this robot, that come from another address or port than its
    /// first state, or whose time is impossible.
    pub n_rejected: u64,
    /// States dropped from a full queue because the caller did not read them.
    pub n_dropped: u64,
    /// Number of restarts of the robot's clock.
    pub n_restarts: u64,
    delays: Delays,
}

impl StateStatistics {
    /// Fraction of the robot's states that were received in order, 0 to 1. It is 1 before the first
    /// state.
    pub fn success_frac(&self) -> f64 {
        match self.n_received + self.n_lost {
            0 => 1.0,
            n => self.n_received as f64 / n as f64,
        }
    }

    /// Quantile of the delay of states relative to the fastest ones.
    ///
    /// The resolution is 20 us, up to 40 ms. [`StateStatistics::max_delay`] is the maximum.
    pub fn delay(&self, frac: f64) -> Duration {
        self.delays.at(frac)
    }

    /// Maximum delay of a state relative to the fastest ones.
    pub fn max_delay(&self) -> Duration {
        self.delays.max_delay
    }

    /// Counts a state with its delay.
    pub(super) fn count(&mut self, delay: Duration) {
        self.n_received += 1;
        self.delays.count(delay);
    }
}

impl std::fmt::Display for StateStatistics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            n_received,
            n_lost,
            n_late,
            n_rejected,
            n_dropped,
            n_restarts,
            ..
        } = self;
        let [median, p99, max] = self.delays.summary();
        write!(
            f,
            "{n_received} states, {:.2} % of those sent ({n_lost} lost, {n_late} late or duplicate, {n_rejected} rejected); delay relative to \
             the fastest: median {median} us, 99 % {p99} us, maximum {max} us",
            100.0 * self.success_frac()
        )?;
        if *n_dropped + *n_restarts > 0 {
            write!(
                f,
                "; {n_dropped} dropped from a full queue, {n_restarts} restarts of the robot's clock"
            )?;
        }
        Ok(())
    }
}

/// Statistics of the commands of all motions of one arm.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MotionStatistics {
    /// Motions that the robot accepted.
    pub n_motions: u64,
    /// States that arrived during motions.
    pub n_cycles: u64,
    /// Number of those states that were answered with a command.
    pub n_answered: u64,
    /// States that arrived too late to be answered, because the robot had already extrapolated.
    pub n_stale: u64,
    /// States that never arrived, or arrived together with a newer one.
    pub n_lost: u64,
    /// Commands that the robot missed, according to its reported reference. With a small jerk,
    /// missed commands may not be detectable, and a few received commands may count as missed.
    pub n_missed: u64,
    /// Commands that were changed to stay within the limits of the robot.
    pub n_limited: u64,
    delays: Delays,
    reported_success: ReportedSuccess,
}

/// Success rate of commands as reported by the robot.
#[derive(Clone, Debug, Default, PartialEq)]
struct ReportedSuccess {
    n: u64,
    sum_frac: f64,
    min_frac: f64,
}

impl MotionStatistics {
    /// Fraction of the robot's states during motions that were answered, 0 to 1. It is 1 before the
    /// first motion.
    pub fn success_frac(&self) -> f64 {
        // Lost states count as unanswered, because the robot receives no command in either case.
        match self.n_cycles + self.n_lost {
            0 => 1.0,
            n => self.n_answered as f64 / n as f64,
        }
    }

    /// The `control_command_success_rate` that the robot reports, 0 to 1: the mean, and the minimum
    /// over any 100 consecutive commands. `None` if no motion was long enough.
    pub fn robot_success_frac(&self) -> Option<[f64; 2]> {
        let ReportedSuccess {
            n,
            sum_frac,
            min_frac,
        } = self.reported_success;
        (n > 0).then(|| [sum_frac / n as f64, min_frac])
    }

    /// Quantile of the delay of commands relative to the fastest possible arrival of their states;
    /// 1 is the maximum.
    pub fn delay(&self, frac: f64) -> Duration {
        self.delays.at(frac)
    }

    /// Counts a command with its delay.
    pub(super) fn count(&mut self, delay: Duration) {
        self.n_answered += 1;
        self.delays.count(delay);
    }

    /// Counts the success rate that the robot reports for its last 100 commands.
    pub(super) fn count_robot_success(&mut self, frac: f64) {
        let ReportedSuccess {
            n,
            sum_frac,
            min_frac,
        } = &mut self.reported_success;
        // The first value replaces the default of 0.
        *min_frac = if *n == 0 { frac } else { min_frac.min(frac) };
        *n += 1;
        *sum_frac += frac;
    }
}

impl std::fmt::Display for MotionStatistics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            n_motions,
            n_cycles,
            n_stale,
            n_lost,
            n_missed,
            n_limited,
            delays,
            ..
        } = self;
        let [median, p99, max] = delays.summary();
        write!(
            f,
            "{n_motions} motions, {n_cycles} cycles, {:.2} % answered ({n_lost} states lost, {n_stale} too late); delay: median \
             {median} us, 99 % {p99} us, maximum {max} us",
            100.0 * self.success_frac()
        )?;
        if let Some([mean, min]) = self.robot_success_frac() {
            let [mean, min] = [mean, min].map(|frac| 100.0 * frac);
            write!(
                f,
                "; the robot received {mean:.2} % in time, of any 100 at least {min:.0} %"
            )?;
        }
        if *n_missed + *n_limited > 0 {
            write!(
                f,
                "; it missed {n_missed} of them, {n_limited} were limited"
            )?;
        }
        Ok(())
    }
}

/// Histogram of delays.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Delays {
    n: u64,
    bins: Vec<u64>,
    max_delay: Duration,
}

impl Default for Delays {
    fn default() -> Self {
        Self {
            n: 0,
            bins: vec![0; N_BINS],
            max_delay: Duration::ZERO,
        }
    }
}

impl Delays {
    fn count(&mut self, delay: Duration) {
        self.n += 1;
        self.max_delay = self.max_delay.max(delay);
        // The memory of a histogram does not depend on the length of the run. The maximum is kept
        // exactly, because one long delay is what stops a robot.
        let bin = usize::try_from(delay.as_micros() / BIN_WIDTH.as_micros()).unwrap_or(usize::MAX);
        self.bins[bin.min(N_BINS - 1)] += 1;
    }

    /// Quantile, rounded up to a bin's width; 1 is the maximum.
    fn at(&self, frac: f64) -> Duration {
        if frac >= 1.0 {
            return self.max_delay;
        }
        let mut n_left = frac * self.n as f64;
        let bin = self.bins.iter().position(|n| {
            n_left -= *n as f64;
            n_left <= 0.0
        });
        // The upper edge of the bin is returned, so that no delay is reported as shorter than it
        // was.
        let ix =
            u32::try_from(bin.unwrap_or(N_BINS - 1)).expect("the number of bins fits in 32 bits");
        (BIN_WIDTH * (ix + 1)).min(self.max_delay)
    }

    /// Median, 99 % quantile and maximum, us.
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
        let within = |delay: Duration, micros: u128| {
            delay.as_micros().abs_diff(micros) <= BIN_WIDTH.as_micros()
        };
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
        let mut statistics = MotionStatistics {
            n_cycles: 3,
            n_lost: 1,
            ..MotionStatistics::default()
        };
        assert_eq!(statistics.robot_success_frac(), None);
        statistics.count(Duration::from_millis(1));
        statistics.count_robot_success(0.98);
        statistics.count_robot_success(0.9);
        assert_eq!(statistics.success_frac(), 0.25);
        let [mean, min] = statistics.robot_success_frac().unwrap();
        assert!((mean - 0.94).abs() < 1e-12 && min == 0.9);
        assert!(
            statistics.to_string().contains("at least 90 %"),
            "{statistics}"
        );
    }
}
