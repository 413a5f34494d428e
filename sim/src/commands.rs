//! Commanded joint motion, which the controller of the arm and its client share. Positions are
//! reported positions.

use crate::Error;
use drivers::motion::{JointTarget, Motion, MotionLimits, Setpoint, TrajectoryGenerator};
use parking_lot::Mutex;
use std::sync::Arc;
use std::time::Duration;

/// The commanded motion. Clones share it.
#[derive(Clone)]
pub(crate) struct Commands(Arc<Mutex<CommandedMotion>>);

struct CommandedMotion {
    generator: TrajectoryGenerator,
    /// Why the arm stopped, if it did.
    stopped: Option<String>,
    last: Setpoint,
}

impl Commands {
    /// An arm at rest at `position`, with one setpoint per `period`.
    pub(crate) fn new(
        limits: &[MotionLimits],
        position: &[f64],
        period: Duration,
    ) -> Result<Self, Error> {
        let failed = |reason: String| Error::Motion { reason };
        let mut generator = TrajectoryGenerator::new(limits, position, period).map_err(failed)?;
        let last = generator.step().map_err(failed)?;
        Ok(Self(Arc::new(Mutex::new(CommandedMotion {
            generator,
            stopped: None,
            last,
        }))))
    }

    /// The setpoint of the next period. Without a trajectory, the arm stays where it is.
    pub(crate) fn next_setpoint(&self) -> Setpoint {
        let mut motion = self.0.lock();
        // After a fault, the arm holds the last setpoint, at rest.
        if motion.stopped.is_none() {
            match motion.generator.step() {
                Ok(setpoint) => motion.last = setpoint,
                Err(reason) => {
                    motion.last.velocity.fill(0.0);
                    motion.last.acceleration.fill(0.0);
                    motion.stopped = Some(reason);
                }
            }
        }
        motion.last.clone()
    }

    pub(crate) fn set_target(&self, target: &JointTarget) -> Result<JointTarget, String> {
        let mut motion = self.0.lock();
        match &motion.stopped {
            Some(reason) => Err(format!(
                "the arm accepts no target before it is recovered: {reason}"
            )),
            None => motion.generator.set_target(target),
        }
    }

    pub(crate) fn motion(&self) -> Motion {
        let motion = self.0.lock();
        match &motion.stopped {
            Some(reason) => Motion::Stopped {
                reason: reason.clone(),
            },
            None if motion.generator.is_at_rest() => Motion::Holding,
            None => Motion::Moving,
        }
    }

    pub(crate) fn stop(&self) {
        self.0.lock().generator.stop();
    }

    pub(crate) fn recover(&self) -> Result<(), String> {
        let mut motion = self.0.lock();
        let at_rest = motion.last.clone();
        // A trajectory that was interrupted must not continue when the arm is recovered.
        motion.generator.resume(&at_rest)?;
        motion.generator.stop();
        motion.stopped = None;
        Ok(())
    }
}
