//! Emulated motors that move the simulated arm in real time, instead of MuJoCo's dynamics.

use crate::joints::Joints;
use kinematics::{JointHistory, JointState, Stamp};
use parking_lot::{Condvar, Mutex};
use std::sync::Arc;
use std::time::Duration;

/// Positions are not interpolated across longer gaps, because the emulator was stalled during such
/// a gap.
const MAX_GAP: Duration = Duration::from_secs(1);
/// Maximum number of stored states, which are the states of ten seconds at 1 kHz.
const MAX_STATES: usize = 10_000;
/// Maximum time to wait for a state. After this time, the motors count as stopped. A state comes
/// every millisecond, so only a stopped emulator is silent for this long.
const MAX_WAIT: Duration = Duration::from_secs(2);

/// Recent positions of emulated motors, in the order of the joint readings. Clones share them.
#[derive(Clone, Debug)]
pub struct MotorHistory(Arc<SharedStates>);

#[derive(Debug)]
struct SharedStates {
    history: Mutex<JointHistory>,
    arrived: Condvar,
}

impl Default for MotorHistory {
    fn default() -> Self {
        let history = Mutex::new(JointHistory::new(MAX_GAP, MAX_STATES));
        Self(Arc::new(SharedStates {
            history,
            arrived: Condvar::new(),
        }))
    }
}

impl MotorHistory {
    /// Adds the state of the motors. A state that is not later than the previous state is ignored.
    pub fn record(&self, state: JointState) {
        let _ = self.0.history.lock().push(state); // The history counts rejected states.
        self.0.arrived.notify_all();
    }

    /// Waits until the positions at a stamp are known. Returns false if the motors have stopped.
    fn wait_until(&self, stamp: Stamp) -> bool {
        let mut history = self.0.history.lock();
        // The time limit starts again with each state. Motors that lag behind are therefore waited
        // for, and only motors that send nothing count as stopped.
        while history.newest().is_none_or(|newest| newest < stamp) {
            if self.0.arrived.wait_for(&mut history, MAX_WAIT).timed_out() {
                return false;
            }
        }
        true
    }
}

/// An arm at the positions of emulated motors.
pub(crate) struct MotorizedArm {
    pub(crate) motors: MotorHistory,
    /// Stamp of simulated time zero.
    pub(crate) start: Stamp,
    /// Joint index of each motor.
    pub(crate) joint_ixs: Vec<usize>,
    /// Offsets that are added to the positions of the motors to get the positions of the joints.
    /// The list is empty if there are no offsets.
    pub(crate) joint_offsets: Vec<f64>,
}

impl MotorizedArm {
    /// Waits until the motors have reached a simulated time. Returns false if they have stopped.
    pub(crate) fn wait_until(&self, nanos: i64) -> bool {
        self.motors.wait_until(Stamp(self.start.0 + nanos))
    }

    /// Joint positions at a simulated time. `None` if no positions of the motors are known at this
    /// time.
    pub(crate) fn position_at(&self, nanos: i64) -> Option<Joints> {
        let state = self
            .motors
            .0
            .history
            .lock()
            .at(Stamp(self.start.0 + nanos))
            .ok()?;
        let mut position = Joints::zeros(self.joint_ixs.len());
        for (value_ix, (joint_ix, reported)) in
            self.joint_ixs.iter().zip(&state.position).enumerate()
        {
            position[*joint_ix] =
                reported + self.joint_offsets.get(value_ix).copied().unwrap_or(0.0);
        }
        Some(position)
    }
}
