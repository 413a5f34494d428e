//! Supervision of an arm that moves: its faults, requests to stop, and joint offsets.

use crate::config::{Rig, RigPath};
use crate::stop::Stop;
use anyhow::{Context, bail};
use drivers::motion::{JointTarget, Motion};
use drivers::{Error, MovableArm, clock};
use kinematics::JointState;
use messages::Setting;
use std::time::Duration;

/// Duration of one wait for a joint state. It bounds the time until a request to stop is noticed.
const POLL: Duration = Duration::from_millis(50);
/// A movable arm that reports nothing for this long counts as lost. The time must be longer than
/// the pauses of a busy computer, because an error here stops a motion.
const MAX_SILENCE: Duration = Duration::from_secs(2);

/// Instruction for the user while the program holds an arm that its motors would otherwise release.
pub const HOLDING: &str = "holding the arm; support it before you press Ctrl-C, because the motors then no longer hold it";

/// A movable arm and its joint offsets. All positions of this type include `arm.joint_offsets`.
pub struct SupervisedArm {
    arm: Box<dyn MovableArm>,
    offsets: Vec<f64>,
    rig_path: RigPath,
}

/// How a motion ended.
#[derive(Clone, Debug, PartialEq)]
pub struct MotionEnd {
    /// The joints at the end.
    pub state: JointState,
    /// Whether the arm reached its target. If not, a stop was requested.
    pub has_arrived: bool,
}

impl SupervisedArm {
    /// An arm that was opened for motion.
    pub fn new(arm: Box<dyn MovableArm>, rig: &Rig) -> Self {
        let mut offsets = rig.arm.joint_offsets.clone();
        offsets.resize(rig.arm.joints.len(), 0.0);
        Self {
            arm,
            offsets,
            rig_path: rig.path.clone(),
        }
    }

    /// Enables a stopped arm again. Call this only at the request of a person who has checked the
    /// arm.
    ///
    /// # Errors
    /// If the arm does not recover.
    pub fn recover(&mut self) -> anyhow::Result<()> {
        Ok(self.arm.recover()?)
    }

    /// Reads the next joint state.
    ///
    /// # Errors
    /// If the arm has stopped because of a fault, or reports nothing.
    pub fn read(&mut self) -> anyhow::Result<JointState> {
        let deadline = clock::now().plus_secs(MAX_SILENCE.as_secs_f64());
        loop {
            match self.read_within(POLL)? {
                Some(state) => return Ok(state),
                None if clock::now() < deadline => {}
                None => {
                    return Err(Error::NoJoints {
                        waited: MAX_SILENCE,
                    }
                    .into());
                }
            }
        }
    }

    /// Reads the next joint state. `None` if none arrives in time.
    fn read_within(&mut self, timeout: Duration) -> anyhow::Result<Option<JointState>> {
        let state = self.arm.read(timeout);
        // This is checked after every read, even after a timeout, because an arm that has stopped
        // because of a fault may no longer report anything.
        if let Motion::Stopped { reason } = self.arm.motion() {
            bail!(
                "the arm stopped: {reason}. Inspect it, then recover it with `fieldrig move {} {} {}`",
                self.rig_path.argument(),
                Setting::Recover,
                Setting::EnableMotion
            );
        }
        match state {
            Ok(mut state) => {
                state
                    .position
                    .iter_mut()
                    .zip(&self.offsets)
                    .for_each(|(position, offset)| *position += offset);
                Ok(Some(state))
            }
            Err(Error::NoJoints { .. }) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Reads the joint states that have already arrived, at most those of a few seconds.
    ///
    /// # Errors
    /// As [`SupervisedArm::read`].
    pub fn read_queued(&mut self, mut on_state: impl FnMut(&JointState)) -> anyhow::Result<()> {
        // The states of four seconds at 1 kHz. The limit ends the loop if states arrive faster than
        // they are read.
        const MAX_STATES: usize = 4000;
        for _ in 0..MAX_STATES {
            match self.read_within(Duration::ZERO)? {
                Some(state) => on_state(&state),
                None => break,
            }
        }
        Ok(())
    }

    /// Sends a target. Returns the target after it was clamped to the limits.
    ///
    /// # Errors
    /// If the arm rejects it.
    pub fn command(&mut self, requested: &JointTarget) -> anyhow::Result<JointTarget> {
        // The driver reports positions of its encoders, without offsets.
        let requested = self.with_offsets(requested, -1.0);
        let accepted = self.arm.command(&requested)?;
        Ok(self.with_offsets(&accepted, 1.0))
    }

    /// A target with `sign` times the offsets added to its positions.
    fn with_offsets(&self, target: &JointTarget, sign: f64) -> JointTarget {
        JointTarget {
            position: target
                .position
                .iter()
                .zip(&self.offsets)
                .map(|(position, offset)| position + sign * offset)
                .collect(),
        }
    }

    /// Waits until the arm has arrived. If a stop is requested or the arm cannot be read, brings it
    /// to rest instead.
    ///
    /// * `on_state`: is called with each joint state.
    ///
    /// # Errors
    /// If the arm has stopped because of a fault, reports nothing, or cannot be stopped.
    pub fn follow(
        &mut self,
        stop: &Stop,
        on_state: impl FnMut(&JointState),
    ) -> anyhow::Result<MotionEnd> {
        let end = self.follow_while_read(stop, on_state);
        // If the program can no longer read the arm, it must not let the arm move unsupervised. An
        // arm that has already stopped is not commanded again.
        if end.is_err()
            && !matches!(self.arm.motion(), Motion::Stopped { .. })
            && let Err(error) = self.arm.stop()
        {
            log::error!(
                "cannot stop the arm, which may still move: {error}; press the emergency stop"
            );
        }
        end
    }

    fn follow_while_read(
        &mut self,
        stop: &Stop,
        mut on_state: impl FnMut(&JointState),
    ) -> anyhow::Result<MotionEnd> {
        loop {
            let state = self.read()?;
            on_state(&state);
            // Arrival has priority over a stop that was requested at the same time, because the arm
            // is already at rest.
            if self.arm.motion() == Motion::Holding {
                return Ok(MotionEnd {
                    state: self.read_newest(on_state)?,
                    has_arrived: true,
                });
            }
            if stop.requested() {
                self.arm.stop().context("cannot stop the arm")?;
                // The arm decelerates within its limits. Callers expect it at rest.
                while self.arm.motion() == Motion::Moving {
                    on_state(&self.read()?);
                }
                return Ok(MotionEnd {
                    state: self.read_newest(on_state)?,
                    has_arrived: false,
                });
            }
        }
    }

    /// Waits for a joint state that arrives after this call. On a busy computer, earlier states may
    /// wait to be read, in which the arm is still on its way.
    fn read_newest(&mut self, mut on_state: impl FnMut(&JointState)) -> anyhow::Result<JointState> {
        self.read_queued(&mut on_state)?;
        let state = self.read()?;
        on_state(&state);
        Ok(state)
    }

    /// Reads the arm, which holds its position, until a stop is requested.
    ///
    /// # Errors
    /// As [`SupervisedArm::read`].
    pub fn hold(
        &mut self,
        stop: &Stop,
        mut on_state: impl FnMut(&JointState),
    ) -> anyhow::Result<()> {
        while !stop.requested() {
            on_state(&self.read()?);
        }
        Ok(())
    }
}
