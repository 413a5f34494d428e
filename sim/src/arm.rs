//! The moving arm. The scene's own arm has MuJoCo's dynamics and a controller that follows the scan
//! or commands at 1 kHz. The arm of a rig file follows them exactly.

use crate::Error;
use crate::commands::Commands;
use crate::config::N_JOINTS;
use crate::follower::Follower;
use crate::handover::Handover;
use crate::joints::Joints;
use crate::panda;
use crate::twin::{Efforts, TwinFollower};
use drivers::motion::Setpoint;
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
#[derive(Clone, Debug)]
pub(crate) struct JointReading {
    pub(crate) nanos: i64,
    /// Radians, or meters for prismatic joints.
    pub(crate) position: Joints,
    /// The same per second.
    pub(crate) velocity: Joints,
    /// Newton meters, or newtons for prismatic joints.
    pub(crate) effort: Joints,
}

/// What the arm follows.
enum Reference {
    Scan(Box<Follower>),
    Tour(Box<TwinFollower>),
    Commands(JointCommands),
}

/// How values of joint readings and commands belong to the joints.
#[derive(Clone)]
pub(crate) struct ReadingOrder {
    /// Joint index of each value of a reading.
    pub(crate) joint_ixs: Vec<usize>,
    /// Offsets that are added to reported positions to get the true positions; empty if there are
    /// none.
    pub(crate) joint_offsets: Vec<f64>,
}

impl ReadingOrder {
    fn offset(&self, value_ix: usize) -> f64 {
        self.joint_offsets.get(value_ix).copied().unwrap_or(0.0)
    }

    /// A motion of the joints, as reported.
    fn reported(&self, position: &Joints, velocity: &Joints, acceleration: &Joints) -> Setpoint {
        let ordered = |joints: &Joints| self.joint_ixs.iter().map(|ix| joints[*ix]).collect();
        let mut reported: Vec<f64> = ordered(position);
        for (value_ix, position) in reported.iter_mut().enumerate() {
            *position -= self.offset(value_ix);
        }
        Setpoint {
            position: reported,
            velocity: ordered(velocity),
            acceleration: ordered(acceleration),
        }
    }
}

/// Where the setpoints of a commanded arm come from.
enum SetpointSource {
    /// A client that commands the arm at the pace of the simulation.
    Commands(Commands),
    /// A controller that runs in real time.
    Controller(Handover),
}

/// Commands in the order and with the offsets of the joint readings.
struct JointCommands {
    source: SetpointSource,
    order: ReadingOrder,
    position: Joints,
    velocity: Joints,
}

impl JointCommands {
    fn advance(&mut self) {
        let next = match &self.source {
            SetpointSource::Commands(commands) => Some(commands.next_setpoint()),
            SetpointSource::Controller(handover) => handover.next_setpoint(),
        };
        // Without a controller, the arm stays where it is.
        let Some(setpoint) = next else {
            self.velocity.fill(0.0);
            return;
        };
        for (value_ix, joint_ix) in self.order.joint_ixs.iter().enumerate() {
            // Commands are reported positions, but the arm needs true positions.
            self.position[*joint_ix] = setpoint.position[value_ix] + self.order.offset(value_ix);
            self.velocity[*joint_ix] = setpoint.velocity[value_ix];
        }
    }
}

impl Reference {
    fn position(&self) -> Joints {
        match self {
            Self::Scan(follower) => Joints::from_column_slice(follower.position_rad().as_slice()),
            Self::Tour(follower) => follower.position().clone(),
            Self::Commands(commands) => commands.position.clone(),
        }
    }

    fn velocity(&self) -> Joints {
        match self {
            Self::Scan(follower) => Joints::from_column_slice(follower.velocity_rad_s().as_slice()),
            Self::Tour(follower) => follower.velocity().clone(),
            Self::Commands(commands) => commands.velocity.clone(),
        }
    }

    fn acceleration(&self) -> Joints {
        match self {
            Self::Scan(follower) => {
                Joints::from_column_slice(follower.acceleration_rad_s2().as_slice())
            }
            Self::Tour(follower) => follower.acceleration().clone(),
            // Only tours are handed over.
            Self::Commands(commands) => Joints::zeros(commands.position.len()),
        }
    }

    /// Advances to a time one step after the previous one.
    fn advance(&mut self, secs: f64) {
        match self {
            Self::Scan(follower) => follower.advance(secs, STEP_SECS),
            Self::Tour(follower) => follower.advance(secs, STEP_SECS),
            Self::Commands(commands) => commands.advance(),
        }
    }
}

/// How the joints follow the reference.
enum Drive {
    /// The dynamics of the scene's own arm, with a controller.
    Dynamics(MjData<Arc<MjModel>>),
    /// The arm of a rig file is at the reference, and its efforts are those of inverse dynamics.
    /// Masses in robot descriptions are too often wrong for a stable controller.
    Exact(Box<Efforts>),
}

/// The arm with its controller and its recent readings.
pub(crate) struct Arm {
    drive: Drive,
    reference: Reference,
    /// The controller that may take the arm over from its tour, if there is one.
    handover: Option<(Handover, ReadingOrder)>,
    n_steps: i64,
    readings: VecDeque<JointReading>,
    history_duration_nanos: i64,
}

impl Arm {
    /// Places the scene's own arm at rest at the start of the scan. Readings are kept for
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
        Ok(Self::at_start(
            Drive::Dynamics(data),
            reference,
            history_duration_nanos,
        ))
    }

    /// Places the arm of a rig file at rest at the start of its tour. Readings are kept for
    /// `history_duration_nanos`.
    pub(crate) fn exact(
        efforts: Efforts,
        follower: TwinFollower,
        history_duration_nanos: i64,
    ) -> Self {
        let reference = Reference::Tour(Box::new(follower));
        Self::at_start(
            Drive::Exact(Box::new(efforts)),
            reference,
            history_duration_nanos,
        )
    }

    fn at_start(drive: Drive, reference: Reference, history_duration_nanos: i64) -> Self {
        Self {
            drive,
            reference,
            handover: None,
            n_steps: 0,
            readings: VecDeque::new(),
            history_duration_nanos,
        }
    }

    /// Position of the joints.
    pub(crate) fn position(&self) -> Joints {
        match &self.drive {
            Drive::Dynamics(data) => Joints::from_column_slice(data.qpos()),
            Drive::Exact(_) => self.reference.position(),
        }
    }

    /// Follows commands from now on, starting at rest at the current position.
    pub(crate) fn follow_commands(&mut self, commands: Commands, order: ReadingOrder) {
        let position = self.position();
        self.reference = Reference::Commands(JointCommands {
            source: SetpointSource::Commands(commands),
            order,
            velocity: Joints::zeros(position.len()),
            position,
        });
    }

    /// Lets a controller take the arm over from its tour.
    pub(crate) fn hand_over_to(&mut self, handover: Handover, order: ReadingOrder) {
        self.handover = Some((handover, order));
    }

    /// Reports the end of the simulation to the controller.
    pub(crate) fn end_control(&self) {
        if let Some((handover, _)) = &self.handover {
            handover.finish();
        }
    }

    /// Whether commands move the arm, which may come at any time.
    pub(crate) fn is_commanded(&self) -> bool {
        matches!(self.reference, Reference::Commands(_))
    }

    /// Follows the controller from now on, if it takes the arm over.
    fn hand_over(&mut self) {
        let Some((handover, order)) = &self.handover else {
            return;
        };
        let position = self.reference.position();
        let velocity = self.reference.velocity();
        let acceleration = self.reference.acceleration();
        let motion = order.reported(&position, &velocity, &acceleration);
        if handover.note_tour(self.n_steps, motion) {
            self.reference = Reference::Commands(JointCommands {
                source: SetpointSource::Controller(handover.clone()),
                order: order.clone(),
                position,
                velocity,
            });
        }
    }

    /// Reads the joints, then advances by one step.
    pub(crate) fn step(&mut self) -> JointReading {
        let nanos = self.n_steps * STEP_NANOS;
        let reading = match &mut self.drive {
            Drive::Dynamics(data) => step_dynamics(data, &self.reference, nanos),
            Drive::Exact(efforts) => {
                let position = self.reference.position();
                let velocity = self.reference.velocity();
                JointReading {
                    nanos,
                    effort: efforts.at(&position, &velocity, STEP_SECS),
                    position,
                    velocity,
                }
            }
        };
        self.n_steps += 1;
        self.reference.advance(self.n_steps as f64 * STEP_SECS);
        if !self.is_commanded() {
            self.hand_over();
        }
        self.readings.push_back(reading.clone());
        while self
            .readings
            .front()
            .is_some_and(|first| first.nanos + self.history_duration_nanos < reading.nanos)
        {
            self.readings.pop_front();
        }
        reading
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
            return Some(before.position.clone());
        }
        let after = self.readings.get(ix + 1)?;
        let share = (nanos - before.nanos) as f64 / STEP_NANOS as f64;
        // Cubic Hermite interpolation with the velocities at both ends. Linear interpolation would
        // deviate by about a micrometer, which a calibration without noise would show.
        let square = share * share;
        let cube = share * share * share;
        Some(
            &before.position * (2.0 * cube - 3.0 * square + 1.0)
                + &before.velocity * (STEP_SECS * (cube - 2.0 * square + share))
                + &after.position * (3.0 * square - 2.0 * cube)
                + &after.velocity * (STEP_SECS * (cube - square)),
        )
    }
}

/// Reads the joints of the scene's own arm, applies the torques of its controller, and steps.
fn step_dynamics(
    data: &mut MjData<Arc<MjModel>>,
    reference: &Reference,
    nanos: i64,
) -> JointReading {
    let position = Joints::from_column_slice(data.qpos());
    let velocity = Joints::from_column_slice(data.qvel());
    // The reading, the torque and the step belong to the same instant. The reading contains the
    // state before the step and the torque that is applied during the step.
    let effort = control(data, reference, &position, &velocity);
    data.qfrc_applied_mut().copy_from_slice(effort.as_slice());
    data.step();
    JointReading {
        nanos,
        position,
        velocity,
        effort,
    }
}

/// Gravity compensation, plus spring and damper torques toward the reference, newton meters.
fn control(
    data: &MjData<Arc<MjModel>>,
    reference: &Reference,
    position_rad: &Joints,
    velocity_rad_s: &Joints,
) -> Joints {
    let reference_velocity_rad_s = reference.velocity();
    let position_error = reference.position() - position_rad;
    let velocity_error = &reference_velocity_rad_s - velocity_rad_s;
    // `bias` contains the torques that gravity and velocities cause. They are added to the command,
    // so that the controller only has to overcome the inertia.
    let bias = data.qfrc_bias();
    Joints::from_fn(N_JOINTS, |ix, _| {
        let torque = bias[ix]
            + STIFFNESS[ix] * position_error[ix]
            + DAMPING[ix] * velocity_error[ix]
            // The joints of the model have a damping of 1 N m s/rad (`panda::mjcf`), which this
            // term compensates.
            + reference_velocity_rad_s[ix];
        torque.clamp(-panda::MAX_TORQUE_NM[ix], panda::MAX_TORQUE_NM[ix])
    })
}
