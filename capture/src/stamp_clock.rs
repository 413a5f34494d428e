//! The time of stamps on the clock of this process.

use drivers::{PlaybackClock, clock};
use kinematics::Stamp;
use std::time::{Duration, Instant};

/// A live image that appears to be older than this was stamped by another clock. No device or queue
/// holds an image for a minute. In contrast, clocks that start at another time usually differ by
/// more than a minute.
const MAX_LIVE_AGE_SECS: f64 = 60.0;

/// Relates stamps to the clock of this process.
#[derive(Clone, Debug)]
pub enum StampClock {
    /// Devices are read in real time, and their stamps are on this computer's clock. Stamps that
    /// seem too old are from another clock.
    Computer,
    /// All devices are simulated, and their stamps are on the simulation's clock.
    Simulation,
    /// A recording is played in real time.
    Playback(PlaybackClock),
    /// A recording is read as fast as it is used.
    Unrelated,
}

impl StampClock {
    /// When a measurement with this stamp took place; `None` if the stamp is on another clock.
    #[must_use]
    pub fn instant_of(&self, stamp: Stamp) -> Option<Instant> {
        match self {
            Self::Computer => {
                let age_secs = clock::now().secs_since(stamp);
                // A stamp in the future is from another clock, too.
                let is_plausible = (0.0..MAX_LIVE_AGE_SECS).contains(&age_secs);
                is_plausible
                    .then(|| Instant::now().checked_sub(Duration::from_secs_f64(age_secs)))
                    .flatten()
            }
            Self::Playback(playback) => playback.instant_of(stamp),
            Self::Simulation | Self::Unrelated => None,
        }
    }

    /// Time at which a sample with this stamp was captured. It is the current time if the stamp is
    /// on another clock, as in recordings and simulations.
    #[must_use]
    pub fn captured_at(&self, stamp: Stamp) -> Instant {
        self.instant_of(stamp).unwrap_or_else(Instant::now)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_recent_stamps_of_this_computer_have_a_time() {
        let recent = clock::now();
        let long_ago = Stamp(recent.0 - 61_000_000_000);
        let age = StampClock::Computer
            .instant_of(recent)
            .map(|at| at.elapsed());
        assert!(
            age.is_some_and(|age| age < Duration::from_secs(10)),
            "{age:?}"
        );
        assert_eq!(StampClock::Computer.instant_of(long_ago), None);
        // Soon after the computer has started, a simulation's stamps look like recent ones.
        assert_eq!(StampClock::Simulation.instant_of(recent), None);
    }
}
