//! The moving arm: MuJoCo's dynamics, and a controller that follows the scan or commands at 1 kHz.

use crate::Error;
use crate::commands::Commands;
use crate::config::N_JOINTS;
use crate::follower::Follower;
use crate::panda::{self, Joints};
use mujoco_rs::prelude::{MjData, MjModel};
use std::collections::VecDeque;
use std::sync::Arc;

/// Period of the dynamics steps and of the joint readings, nanoseconds.
pub(crate) const STEP_NANOS: i64 = 1_000_000;
const STEP_SECS: f64 = 1e-3;
/// Stiffness of each joint's controller, newton meters per radian. The arm is stiff enough to
/// follow the tour closely. Joints near the flange move less mass, so their stiffness and damping
/// are lower. With much higher values, the joints could oscillate, because torques change only once
/// per millisecond.
const STIFFNESS: [f64; N_JOINTS] = [2000.0, 2000.0, 1600.0, 1600.0, 600.0, 600.0, 300.0];
/// Damping of each joint's controller, newton meter seconds per radian.
const DAMPING: [f64; N_JOINTS] = [120.0, 120.0, 90.0, 90.0, 35.0, 35.0, 18.0];

/// State of the joints at one step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct JointReading {
    pub(crate) nanos: i64,
    pub(crate) position_rad: Joints,
    pub(crate) velocity_rad_s: Joints,
    pub(crate) torque_nm: Joints,
}

/// What the controller follows.
enum Reference {
    Scan(Box<Follower>),
    Commands(JointCommands),
}

/// Commands in the order and with the offsets of the joint readings.
struct JointCommands {
    commands: Commands,
    /// Joint index of each value of a reading.
    joint_ixs: Vec<usize>,
    /// Offsets that are added to reported positions to get the true positions; empty if there are
    /// none.
    joint_offsets: Vec<f64>,
    position_rad: Joints,
    velocity_rad_s: Joints,
}

impl JointCommands {
    fn advance(&mut self) {
        let setpoint = self.commands.next_setpoint();
        for (value_ix, joint_ix) in self.joint_ixs.iter().enumerate() {
            // Commands are reported positions, but the dynamics need true positions.
            let offset = self.joint_offsets.get(value_ix).copied().unwrap_or(0.0);
            self.position_rad[*joint_ix] = setpoint.position[value_ix] + offset;
            self.velocity_rad_s[*joint_ix] = setpoint.velocity[value_ix];
        }
    }
}

impl Reference {
    fn position_rad(&self) -> &Joints {
        match self {
            Self::Scan(follower) => follower.position_rad(),
            Self::Commands(commands) => &commands.position_rad,
        }
    }

    fn velocity_rad_s(&self) -> &Joints {
        match self {
            Self::Scan(follower) => follower.velocity_rad_s(),
            Self::Commands(commands) => &commands.velocity_rad_s,
        }
    }
}

/// The arm with its controller and its recent readings.
pub(crate) struct Arm {
    data: MjData<Arc<MjModel>>,
    reference: Reference,
    n_steps: i64,
    readings: VecDeque<JointReading>,
    history_duration_nanos: i64,
}

impl Arm {
    /// Places the arm at rest at the start of the scan. Readings are kept for
    /// `history_duration_nanos`.
    pub(crate) fn new(
        model: Arc<MjModel>,
        follower: Follower,
        history_duration_nanos: i64,
    ) -> Result<Self, Error> {
        let mut data = MjData::new(model);
        // If the scene had other movable joints, their positions would be confused with those of
        // the arm.
        if data.qpos().len() != N_JOINTS {
            return Err(Error::NJoints {
                got: data.qpos().len(),
                expected: N_JOINTS,
            });
        }
        data.qpos_mut()
            .copy_from_slice(follower.position_rad().as_slice());
        data.forward();
        let reference = Reference::Scan(Box::new(follower));
        Ok(Self {
            data,
            reference,
            n_steps: 0,
            readings: VecDeque::new(),
            history_duration_nanos,
        })
    }

    /// Position of the joints.
    pub(crate) fn position_rad(&self) -> Joints {
        Joints::from_column_slice(self.data.qpos())
    }

    /// Follows commands from now on, starting at rest at the current position. `joint_ixs` and
    /// `joint_offsets` are those of the joint readings.
    pub(crate) fn follow_commands(
        &mut self,
        commands: Commands,
        joint_ixs: &[usize],
        joint_offsets: &[f64],
    ) {
        self.reference = Reference::Commands(JointCommands {
            commands,
            joint_ixs: joint_ixs.to_vec(),
            joint_offsets: joint_offsets.to_vec(),
            position_rad: self.position_rad(),
            velocity_rad_s: Joints::zeros(),
        });
    }

    /// Reads the joints, then advances by one step.
    pub(crate) fn step(&mut self) -> JointReading {
        let position_rad = self.position_rad();
        let velocity_rad_s = Joints::from_column_slice(self.data.qvel());
        // The reading, the torque and the step belong to the same instant. The reading contains the
        // state before the step and the torque that is applied during the step.
        let torque_nm = self.control(&position_rad, &velocity_rad_s);
        let reading = JointReading {
            nanos: self.n_steps * STEP_NANOS,
            position_rad,
            velocity_rad_s,
            torque_nm,
        };
        self.data
            .qfrc_applied_mut()
            .copy_from_slice(torque_nm.as_slice());
        self.data.step();
        self.n_steps += 1;
        match &mut self.reference {
            Reference::Scan(follower) => {
                follower.advance(self.n_steps as f64 * STEP_SECS, STEP_SECS)
            }
            Reference::Commands(commands) => commands.advance(),
        }
        self.readings.push_back(reading);
        while self
            .readings
            .front()
            .is_some_and(|first| first.nanos + self.history_duration_nanos < reading.nanos)
        {
            self.readings.pop_front();
        }
        reading
    }

    /// Gravity compensation, plus spring and damper torques toward the reference.
    fn control(&self, position_rad: &Joints, velocity_rad_s: &Joints) -> Joints {
        let position_error = self.reference.position_rad() - position_rad;
        let velocity_error = self.reference.velocity_rad_s() - velocity_rad_s;
        // `bias` contains the torques that gravity and velocities cause. They are added to the
        // command, so that the controller only has to overcome the inertia.
        let bias = self.data.qfrc_bias();
        Joints::from_fn(|ix, _| {
            let torque = bias[ix]
                + STIFFNESS[ix] * position_error[ix]
                + DAMPING[ix] * velocity_error[ix]
                // The joints of the model have a damping of 1 N m s/rad (`panda::mjcf`), which this
                // term compensates.
                + self.reference.velocity_rad_s()[ix];
            torque.clamp(-panda::MAX_TORQUE_NM[ix], panda::MAX_TORQUE_NM[ix])
        })
    }

    /// Joint positions at a time, by cubic interpolation of the two neighboring readings; `None` if
    /// no readings cover it.
    pub(crate) fn position_at(&self, nanos: i64) -> Option<Joints> {
        let first = self.readings.front()?;
        // Readings are one step apart, so the index follows from the time without a search.
        let ix = usize::try_from((nanos - first.nanos).checked_div(STEP_NANOS)?).ok()?;
        if nanos < first.nanos {
            return None;
        }
        let before = self.readings.get(ix)?;
        if nanos == before.nanos {
            return Some(before.position_rad);
        }
        let after = self.readings.get(ix + 1)?;
        let share = (nanos - before.nanos) as f64 / STEP_NANOS as f64;
        // Cubic Hermite interpolation with the velocities at both ends. Linear interpolation would
        // deviate by about a micrometer, which a calibration without noise would show.
        let square = share * share;
        let cube = share * share * share;
        Some(
            before.position_rad * (2.0 * cube - 3.0 * square + 1.0)
                + before.velocity_rad_s * (STEP_SECS * (cube - 2.0 * square + share))
                + after.position_rad * (3.0 * square - 2.0 * cube)
                + after.velocity_rad_s * (STEP_SECS * (cube - square)),
        )
    }
}
