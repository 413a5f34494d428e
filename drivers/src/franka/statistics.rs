//! How well the states of an arm came through.

use std::time::Duration;

/// Width of a bin of delays.
const BIN: Duration = Duration::from_micros(20);
/// Bins; longer delays count in the last.
const N_BINS: usize = 2000;

/// What became of the states of one arm since it was opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Statistics {
    /// That came, and were told.
    pub n_received: u64,
    /// Whose numbers were passed over.
    pub n_lost: u64,
    /// That came twice, or after a later one.
    pub n_late: u64,
    /// Datagrams that are no state of this robot, or at an impossible time.
    pub n_refused: u64,
    /// That gave way to newer ones because nobody took them.
    pub n_dropped: u64,
    /// How often the robot's clock began anew.
    pub n_restarts: u64,
    delays: Vec<u64>,
    longest: Duration,
}

impl Default for Statistics {
    fn default() -> Self {
        Self {
            n_received: 0,
            n_lost: 0,
            n_late: 0,
            n_refused: 0,
            n_dropped: 0,
            n_restarts: 0,
            delays: vec![0; N_BINS],
            longest: Duration::ZERO,
        }
    }
}

impl Statistics {
    /// Share of the robot's states that were received in order, 0 to 1; 1 before the first.
    pub fn success_frac(&self) -> f64 {
        match self.n_received + self.n_lost {
            0 => 1.0,
            n => self.n_received as f64 / n as f64,
        }
    }

    /// How late states came against the quickest ones: no later than this did a share of them.
    ///
    /// Told to 20 us, and up to 40 ms; the latest of all is [`Statistics::longest_delay`].
    pub fn delay(&self, frac: f64) -> Duration {
        let mut n_left = frac * self.n_received as f64;
        let bin = self.delays.iter().position(|n| {
            n_left -= *n as f64;
            n_left <= 0.0
        });
        let ix = u32::try_from(bin.unwrap_or(N_BINS - 1)).expect("there are few bins");
        (BIN * (ix + 1)).min(self.longest)
    }

    /// How late the latest state came against the quickest ones.
    pub fn longest_delay(&self) -> Duration {
        self.longest
    }

    /// Counts a state that came so late.
    pub(super) fn count(&mut self, delay: Duration) {
        self.n_received += 1;
        self.longest = self.longest.max(delay);
        let bin = usize::try_from(delay.as_micros() / BIN.as_micros()).unwrap_or(usize::MAX);
        self.delays[bin.min(N_BINS - 1)] += 1;
    }
}

impl std::fmt::Display for Statistics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { n_received, n_lost, n_late, n_refused, n_dropped, n_restarts, .. } = self;
        let [half, most, all] = [self.delay(0.5), self.delay(0.99), self.longest].map(|delay| delay.as_micros());
        write!(
            f,
            "{n_received} states, {:.2} % of those sent ({n_lost} lost, {n_late} late or twice, {n_refused} refused); half of them \
             came at most {half} us after the quickest, 99 % at most {most} us, all at most {all} us",
            100.0 * self.success_frac()
        )?;
        if *n_dropped + *n_restarts > 0 {
            write!(f, "; {n_dropped} gave way to newer ones, the robot's clock began anew {n_restarts} times")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_are_told_by_their_share() {
        let mut statistics = Statistics::default();
        assert_eq!(statistics.success_frac(), 1.0);
        for micros in 0..1000 {
            statistics.count(Duration::from_micros(micros));
        }
        let within = |told: Duration, micros: u128| told.as_micros().abs_diff(micros) <= BIN.as_micros();
        assert!(within(statistics.delay(0.5), 500), "{statistics}");
        assert!(within(statistics.delay(0.99), 990), "{statistics}");
        statistics.count(Duration::from_secs(7));
        assert_eq!(statistics.longest_delay(), Duration::from_secs(7));
        statistics.n_lost = 1001;
        assert_eq!(statistics.success_frac(), 0.5);
        assert!(statistics.to_string().contains("50.00 %"), "{statistics}");
    }
}
