//! The time of stamps on the clock of this process.

use drivers::{PlaybackClock, clock};
use kinematics::Stamp;
use std::time::{Duration, Instant};

/// A live image that appears to be older than this was stamped by another clock, such as a simulator's.
const MAX_LIVE_AGE_SECS: f64 = 60.0;

/// Relates stamps to the clock of this process.
#[derive(Clone, Debug)]
pub enum StampClock {
    /// Devices are read in real time, and their stamps are on this computer's clock. Older ones are from another clock,
    /// such as a simulator's.
    Computer,
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
                let is_plausible = (0.0..MAX_LIVE_AGE_SECS).contains(&age_secs);
                is_plausible.then(|| Instant::now().checked_sub(Duration::from_secs_f64(age_secs))).flatten()
            }
            Self::Playback(playback) => playback.instant_of(stamp),
            Self::Unrelated => None,
        }
    }
}
