//! Statistics of the received states of an arm, and of the setpoints of its motions.

use std::time::Duration;

/// Statistics of the states of one arm since it was opened.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StateStatistics {
    /// States that were received in order.
    pub n_received: u64,
    /// States that the controller skipped, or that were lost with a connection, counted by gaps in
    /// the controller's time.
    pub n_lost: u64,
    /// Packages with a wrong length, implausible values, or an impossible time.
    pub n_rejected: u64,
    /// States without power at the joints, whose angles are not measured.
    pub n_unpowered: u64,
    /// States dropped from a full queue because the caller did not read them.
    pub n_dropped: u64,
    /// Number of times that the connection was opened again.
    pub n_reconnects: u64,
    /// Number of restarts of the controller's clock.
    pub n_restarts: u64,
    /// Maximum delay of a state relative to the fastest ones.
    pub max_delay: Duration,
}

impl StateStatistics {
    /// Fraction of the controller's states that were received in order, 0 to 1. It is 1 before the
    /// first state.
    pub fn success_frac(&self) -> f64 {
        match self.n_received + self.n_lost {
            0 => 1.0,
            n => self.n_received as f64 / n as f64,
        }
    }

    /// Counts a state with its delay.
    pub(super) fn count(&mut self, delay: Duration) {
        self.n_received += 1;
        self.max_delay = self.max_delay.max(delay);
    }
}

impl std::fmt::Display for StateStatistics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{} states, {:.2} % of those sent ({} lost, {} rejected); delay relative to the fastest: maximum {} us",
            self.n_received,
            100.0 * self.success_frac(),
            self.n_lost,
            self.n_rejected,
            self.max_delay.as_micros()
        )?;
        for (n, what) in [
            (self.n_dropped, "dropped from a full queue"),
            (self.n_unpowered, "without power at the joints"),
            (self.n_reconnects, "reconnects"),
            (self.n_restarts, "restarts of the controller's clock"),
        ] {
            if n > 0 {
                write!(f, "; {n} {what}")?;
            }
        }
        Ok(())
    }
}

/// Statistics of all motions of one arm.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct MotionStatistics {
    /// Motions whose program ran.
    pub n_motions: u64,
    /// Setpoints that were computed during motions.
    pub n_setpoints: u64,
    /// Setpoints that were late by so much that the arm had almost come to rest.
    pub n_pauses: u64,
}

impl std::fmt::Display for MotionStatistics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{} motions, {} setpoints, {} pauses of more than 50 ms",
            self.n_motions, self.n_setpoints, self.n_pauses
        )
    }
}
