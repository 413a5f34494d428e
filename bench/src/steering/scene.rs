//! Free space around a steered arm, whose answers can be held up.

use drivers::motion::ArmState;
use kinematics::Stamp;
use parking_lot::Mutex;
use session::Surroundings;
use std::time::{Duration, Instant};
use steering::{AnalyticScene, Clearance, Seen};

/// Radius around the base of the arm that is free, meters.
const FREE_RADIUS_M: f64 = 10.0;

/// A scene without surfaces, which is always seen.
#[derive(Debug, Default)]
pub(super) struct BenchScene {
    answers: Mutex<Answers>,
}

/// How the scene answers.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) enum Answers {
    /// At once.
    #[default]
    Prompt,
    /// Not at all until this time, as if the input of the map was blocked.
    MissingUntil(Instant),
    /// Only at this time: callers are blocked until then.
    BlockedUntil(Instant),
}

impl BenchScene {
    /// Leaves the next answers out for a time.
    pub(super) fn miss_answers(&self, time: Duration) {
        *self.answers.lock() = Answers::MissingUntil(Instant::now() + time);
    }

    /// Blocks callers for a time.
    pub(super) fn block_answers(&self, time: Duration) {
        *self.answers.lock() = Answers::BlockedUntil(Instant::now() + time);
    }

    /// Answers at once again.
    pub(super) fn answer(&self) {
        *self.answers.lock() = Answers::Prompt;
    }
}

impl Clearance for BenchScene {
    fn readings(&self, points_in_base: &[[f64; 3]], now: Stamp) -> Vec<Option<Seen>> {
        let answers = *self.answers.lock();
        match answers {
            Answers::MissingUntil(until) if Instant::now() < until => return Vec::new(),
            Answers::BlockedUntil(until) => {
                std::thread::sleep(until.saturating_duration_since(Instant::now()));
            }
            _ => {}
        }
        let scene = AnalyticScene {
            solids: Vec::new(),
            seen_at: now,
            seen_radius_m: FREE_RADIUS_M,
        };
        scene.readings(points_in_base, now)
    }
}

impl Surroundings for BenchScene {
    fn set_posture(&self, _arm: &ArmState) {}

    fn end_sweep(&self) {}
}
