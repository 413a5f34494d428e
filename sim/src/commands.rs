//! Commanded joint motion, which the controller of the arm and its client share. Positions are
//! reported positions.

use crate::Error;
use drivers::motion::{JointTarget, Motion, MotionLimits, Mover, Setpoint, SteeringPort};
use kinematics::Stamp;
use parking_lot::Mutex;
use std::sync::Arc;
use std::time::Duration;

/// The commanded motion. Clones share it.
#[derive(Clone)]
pub(crate) struct Commands(Arc<Mutex<CommandedMotion>>);

struct CommandedMotion {
    mover: Mover,
    /// The port, if the arm is steered.
    port: Option<SteeringPort>,
    period: Duration,
    /// Number of setpoints so far. The stamps of joint readings count them, too.
    n_steps: u32,
    /// Why the arm stopped, if it did.
    stopped: Option<String>,
}

impl Commands {
    /// An arm at rest at `position`, with one setpoint per `period`.
    pub(crate) fn new(
        limits: &[MotionLimits],
        position: &[f64],
        period: Duration,
    ) -> Result<Self, Error> {
        let mut mover = Mover::default();
        mover
            .hold_at(limits.to_vec(), position.to_vec(), period)
            .map_err(|error| Error::Motion {
                reason: reason_of(error),
            })?;
        Ok(Self(Arc::new(Mutex::new(CommandedMotion {
            mover,
            port: None,
            period,
            n_steps: 0,
            stopped: None,
        }))))
    }

    /// The setpoint of the next period. Without a trajectory, the arm stays where it is.
    pub(crate) fn next_setpoint(&self) -> Setpoint {
        self.0.lock().next_setpoint()
    }

    pub(crate) fn set_target(&self, target: &JointTarget) -> Result<JointTarget, String> {
        let mut motion = self.0.lock();
        motion.refuse_if_stopped()?;
        motion.mover.set_target(target).map_err(reason_of)
    }

    pub(crate) fn motion(&self) -> Motion {
        let motion = self.0.lock();
        match &motion.stopped {
            Some(reason) => Motion::Stopped {
                reason: reason.clone(),
            },
            None => motion.mover.motion(),
        }
    }

    pub(crate) fn stop(&self) {
        self.0.lock().mover.stop();
    }

    pub(crate) fn recover(&self) -> Result<(), String> {
        self.0.lock().recover()
    }

    /// Follows the port from now on. Its times are those of the joint readings.
    pub(crate) fn steer(&self, brake_factor: f64) -> Result<SteeringPort, String> {
        let mut motion = self.0.lock();
        if let Some(port) = &motion.port {
            return Ok(port.clone());
        }
        motion.refuse_if_stopped()?;
        // The motion keeps the port, so the port must not keep the motion.
        let commanded = Arc::downgrade(&self.0);
        let recover = move || {
            let Some(commanded) = commanded.upgrade() else {
                return Err(simulation_error("the simulation has ended".to_owned()));
            };
            let recovered = commanded.lock().recover();
            recovered.map_err(simulation_error)
        };
        let port =
            SteeringPort::new(motion.mover.limits(), brake_factor, recover).map_err(reason_of)?;
        motion.mover.steer(port.clone()).map_err(reason_of)?;
        motion.port = Some(port.clone());
        Ok(port)
    }
}

impl CommandedMotion {
    fn next_setpoint(&mut self) -> Setpoint {
        self.n_steps += 1;
        let now = Stamp(0) + self.period * self.n_steps;
        if let Some(reason) = &self.stopped {
            // After a fault, the arm holds the last setpoint, at rest.
            self.mover.report_stopped(now, reason);
            return Setpoint::at_rest(self.mover.held().position);
        }
        match self.mover.step(now) {
            Ok(setpoint) => setpoint,
            Err(error) => {
                self.stopped = Some(reason_of(error));
                Setpoint::at_rest(self.mover.held().position)
            }
        }
    }

    fn refuse_if_stopped(&self) -> Result<(), String> {
        match &self.stopped {
            Some(reason) => Err(format!(
                "the arm accepts no target before it is recovered: {reason}"
            )),
            None => Ok(()),
        }
    }

    fn recover(&mut self) -> Result<(), String> {
        if self.stopped.is_none() {
            return Ok(());
        }
        // A trajectory that was interrupted must not continue when the arm is recovered.
        let limits = self.mover.limits().to_vec();
        let position = self.mover.held().position;
        self.mover
            .hold_at(limits, position, self.period)
            .map_err(reason_of)?;
        self.stopped = None;
        Ok(())
    }
}

/// Reason of the error, without the prefix "the arm cannot be moved".
fn reason_of(error: drivers::Error) -> String {
    match error {
        drivers::Error::Motion { reason } => reason,
        other => other.to_string(),
    }
}

fn simulation_error(reason: String) -> drivers::Error {
    drivers::Error::Simulation { reason }
}
