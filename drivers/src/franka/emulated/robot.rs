//! The behavior of the controller: it answers requests, follows motions within their limits,
//! triggers reflexes and recovers.

use super::super::N_JOINTS;
use super::super::state::pose;
use super::limits::{STEP_SECS, Violation};
use super::message::{Command, Reply, Request, Setting};
use super::{CommandedJoints, Joints, RobotConfig, model};
use franka::wire::f64s_to_f64;
use franka::wire::robot::{v5, v10};
use franka::{Errors, FciVersion, MoveStatus};
use kinematics::Transform;
use std::collections::VecDeque;
use zerocopy::FromBytes;
use zerocopy::little_endian::F64;

/// Maximum number of consecutive missing answers in a motion. Source: FCI documentation, "Real-time
/// control commands".
const MAX_MISSED: u32 = 20;
/// Number of states within which a motion must start.
const MAX_UNTIL_FIRST: u32 = 1000;
/// Number of states over which the success rate is computed.
const N_SUCCESS_WINDOW: usize = 100;
/// Maximum deviation of a robot at rest from its commanded position. A greater deviation means that
/// the robot was moved by hand; the commanded position then follows it.
const MAX_SAG_RAD: f64 = 0.01;
/// External torques that end a motion, until a client sets other thresholds, Nm.
const DEFAULT_CONTACT_NM: f64 = 20.0;

/// The controller of one robot, without its sockets.
pub(super) struct Robot {
    pub(super) config: RobotConfig,
    pub(super) nominal_from_tool: Transform,
    pub(super) tool_from_stiffness: Transform,
    contact_nm: [f64; N_JOINTS],
    pub(super) joints: Joints,
    pub(super) commanded: CommandedJoints,
    pub(super) mode: Mode,
    pub(super) reflex_reason: Errors,
    answered: VecDeque<bool>,
}

#[derive(Clone, Copy)]
pub(super) enum Mode {
    Idle,
    Move(Motion),
    Reflex,
}

#[derive(Clone, Copy)]
pub(super) struct Motion {
    command_id: u32,
    pub(super) generator: TrajectoryGenerator,
    pub(super) controller: v10::ControllerMode,
    has_begun: bool,
    n_missed: u32,
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum TrajectoryGenerator {
    Position,
    Velocity,
}

impl Robot {
    /// Creates a robot at rest with these joints.
    pub(super) fn new(config: RobotConfig, joints: Joints) -> Self {
        let commanded = CommandedJoints {
            position_rad: joints.position_rad,
            ..CommandedJoints::default()
        };
        Self {
            config,
            nominal_from_tool: Transform::identity(),
            tool_from_stiffness: Transform::identity(),
            contact_nm: [DEFAULT_CONTACT_NM; N_JOINTS],
            joints,
            commanded,
            mode: Mode::Idle,
            reflex_reason: Errors::default(),
            answered: VecDeque::with_capacity(N_SUCCESS_WINDOW),
        }
    }

    /// Executes a request other than connecting, and returns the replies. Ending a motion gives two
    /// replies.
    pub(super) fn answer(
        &mut self,
        request: Request,
        command: u32,
        command_id: u32,
        payload: &[u8],
    ) -> Vec<Reply> {
        let is_moving = matches!(self.mode, Mode::Move(_));
        let mut replies = Vec::new();
        let payload = match request {
            Request::Connect => return replies,
            Request::Move => {
                let status = self.begin(command_id, payload);
                vec![self.move_byte(status)]
            }
            // The reply about the end of the motion is sent before the reply to this request.
            Request::Stop => {
                replies.extend(self.end(MoveStatus::Preempted));
                vec![0]
            }
            Request::Recover => {
                // During the reflex, the joints may have been moved by hand. The next motion starts
                // where they are.
                if matches!(self.mode, Mode::Reflex) {
                    self.mode = Mode::Idle;
                    self.commanded = CommandedJoints {
                        position_rad: self.joints.position_rad,
                        ..CommandedJoints::default()
                    };
                }
                vec![u8::from(is_moving)]
            }
            Request::Model => [&[0], model::urdf(&self.config.limits).as_bytes()].concat(),
            // The library is machine code that runs on the client. The emulator does not have it,
            // and clients work without it.
            Request::Library => vec![v5::LoadModelLibraryStatus::Error.to_u8()],
            Request::CartesianLimit => vec![0; size_of::<v5::GetCartesianLimitResponse>()],
            Request::Set(_) if is_moving => {
                vec![v10::GetterSetterStatus::CommandNotPossibleRejected.to_u8()]
            }
            Request::Set(setting) => vec![self.set(setting, payload).to_u8()],
        };
        replies.push(Reply {
            command,
            command_id,
            payload,
        });
        replies
    }

    /// Starts a motion, if possible.
    fn begin(&mut self, command_id: u32, payload: &[u8]) -> MoveStatus {
        if !matches!(self.mode, Mode::Idle) {
            return MoveStatus::CommandNotPossibleRejected;
        }
        let n_bytes = match self.config.version {
            FciVersion::V5 => size_of::<v5::MoveRequest>(),
            FciVersion::V10 => size_of::<v10::MoveRequest>(),
        };
        // In both versions, the payload starts with the codes of the controller and the motion
        // generator.
        let (Ok((head, _)), true) = (
            <[[u8; 4]; 2]>::read_from_prefix(payload),
            payload.len() == n_bytes,
        ) else {
            return MoveStatus::InvalidArgumentRejected;
        };
        let [controller, generator] = head.map(u32::from_le_bytes);
        let controller = match v10::MoveControllerMode::from_u32(controller) {
            Some(v10::MoveControllerMode::JointImpedance) => v10::ControllerMode::JointImpedance,
            Some(v10::MoveControllerMode::CartesianImpedance) => {
                v10::ControllerMode::CartesianImpedance
            }
            _ => return MoveStatus::InvalidArgumentRejected,
        };
        let generator = match v10::MoveMotionGeneratorMode::from_u32(generator) {
            Some(v10::MoveMotionGeneratorMode::JointPosition) => TrajectoryGenerator::Position,
            Some(v10::MoveMotionGeneratorMode::JointVelocity) => TrajectoryGenerator::Velocity,
            _ => return MoveStatus::InvalidArgumentRejected,
        };
        self.mode = Mode::Move(Motion {
            command_id,
            generator,
            controller,
            has_begun: false,
            n_missed: 0,
        });
        self.reflex_reason = Errors::default();
        self.commanded.is_moving = true;
        // The success rate is computed for each motion separately.
        self.answered.clear();
        MoveStatus::MotionStarted
    }

    fn set(&mut self, setting: Setting, payload: &[u8]) -> v10::GetterSetterStatus {
        const INVALID: v10::GetterSetterStatus = v10::GetterSetterStatus::InvalidArgumentRejected;
        if payload.len() != setting.n_bytes() {
            return INVALID;
        }
        match setting {
            Setting::EeToStiffness | Setting::NominalToEe => {
                let Ok(matrix) = <[F64; 16]>::read_from_bytes(payload) else {
                    return INVALID;
                };
                let Ok(pose) = pose(&f64s_to_f64(&matrix)) else {
                    return INVALID;
                };
                match setting {
                    Setting::NominalToEe => self.nominal_from_tool = pose,
                    _ => self.tool_from_stiffness = pose,
                }
            }
            Setting::Collision => {
                let Ok(thresholds) = v10::SetCollisionBehaviorRequest::read_from_bytes(payload)
                else {
                    return INVALID;
                };
                // The upper thresholds stop the robot; the lower ones are only reported.
                self.contact_nm = f64s_to_f64(&thresholds.upper_torque_thresholds_nominal);
            }
            Setting::JointImpedance
            | Setting::CartesianImpedance
            | Setting::Guiding
            | Setting::Load
            | Setting::Filters => {}
        }
        v10::GetterSetterStatus::Success
    }

    /// Advances the motion by a millisecond, with the client's answer to the newest state, or by
    /// extrapolation if there is none.
    ///
    /// `could_answer` is false if the client had no chance to answer because the emulator itself
    /// was late.
    pub(super) fn follow(
        &mut self,
        command: Option<&Command>,
        could_answer: bool,
    ) -> Option<Reply> {
        let Mode::Move(motion) = self.mode else {
            return None;
        };
        // Before the first command, missing answers do not count. States that the client could not
        // answer in time do not count either.
        if command.is_some() || (could_answer && motion.has_begun) {
            self.answered.truncate(N_SUCCESS_WINDOW - 1);
            self.answered.push_front(command.is_some());
        }
        let before = self.commanded;
        let Some(command) = command else {
            return self.extrapolate(motion, could_answer);
        };
        let now = next_commanded(&before, |ix, from| match motion.generator {
            TrajectoryGenerator::Position => (command.position_rad[ix] - from) / STEP_SECS,
            TrajectoryGenerator::Velocity => command.velocity_rad_s[ix],
        });
        if let Err(violation) = self.config.limits.check(&before, &now) {
            // If a client starts at another position, it also violates other limits. The wrong
            // start is the cause, so only this is reported.
            let is_wrong_start =
                !motion.has_begun && motion.generator == TrajectoryGenerator::Position;
            let violation = if is_wrong_start {
                Violation::StartPose
            } else {
                violation
            };
            return self.trigger_reflex(violation.name());
        }
        self.commanded = now;
        if !command.is_last {
            self.mode = Mode::Move(Motion {
                has_begun: true,
                n_missed: 0,
                ..motion
            });
            return None;
        }
        // From here on, the joints are at rest.
        let can_stop = |(velocity, max): (f64, f64)| velocity.abs() <= max * STEP_SECS;
        let is_slow_enough = now
            .velocity_rad_s
            .into_iter()
            .zip(self.config.limits.acceleration_rad_s2)
            .all(can_stop);
        if is_slow_enough {
            self.end(MoveStatus::Success)
        } else {
            self.trigger_reflex(Violation::Acceleration.name())
        }
    }

    /// Continues the motion for a millisecond without a command. The joints keep their
    /// acceleration, as on a real robot, until too many commands are missing.
    fn extrapolate(&mut self, mut motion: Motion, could_answer: bool) -> Option<Reply> {
        motion.n_missed += u32::from(could_answer);
        let max = if motion.has_begun {
            MAX_MISSED
        } else {
            MAX_UNTIL_FIRST
        };
        if motion.n_missed > max {
            return self.trigger_reflex("communication_constraints_violation");
        }
        self.mode = Mode::Move(motion);
        // Before the first command, there is no motion to continue.
        if motion.has_begun {
            let before = self.commanded;
            self.commanded = next_commanded(&before, |ix, _| {
                before.velocity_rad_s[ix] + before.acceleration_rad_s2[ix] * STEP_SECS
            });
        }
        None
    }

    /// Updates the actual joint states. A contact ends the motion.
    pub(super) fn observe(&mut self, joints: Joints) -> Option<Reply> {
        self.joints = joints;
        let Mode::Move(_) = self.mode else {
            // Between motions, a person may guide the arm by hand. A smaller difference is the sag
            // under load, which must not accumulate.
            let is_displaced = |(commanded, is): (f64, f64)| (commanded - is).abs() > MAX_SAG_RAD;
            if self
                .commanded
                .position_rad
                .into_iter()
                .zip(joints.position_rad)
                .any(is_displaced)
            {
                self.commanded.position_rad = joints.position_rad;
            }
            return None;
        };
        let has_contact = joints
            .external_torque_nm
            .into_iter()
            .zip(self.contact_nm)
            .any(|(nm, max)| nm.abs() > max);
        if has_contact {
            self.trigger_reflex("joint_reflex")
        } else {
            None
        }
    }

    /// Handles the disconnection of the client. During a motion, a disconnection triggers a reflex,
    /// just as missing commands do.
    pub(super) fn abandon(&mut self) {
        if matches!(self.mode, Mode::Move(_)) {
            // No client is left to receive the reply.
            let _ = self.trigger_reflex("communication_constraints_violation");
        }
    }

    /// Fraction of the last states of a motion that were answered in time, 0 to 1; 0 without a
    /// motion.
    pub(super) fn success_frac(&self) -> f64 {
        let n_answered = self
            .answered
            .iter()
            .filter(|is_answered| **is_answered)
            .count();
        n_answered as f64 / self.answered.len().max(1) as f64
    }

    fn trigger_reflex(&mut self, reason: &str) -> Option<Reply> {
        let mut reasons = Errors::default();
        reasons.0[Errors::index_of(reason)?] = true;
        let reply = self.end(MoveStatus::ReflexAborted);
        self.mode = Mode::Reflex;
        self.reflex_reason = reasons;
        log::info!("emulated robot: stopped by a reflex: {reason}");
        reply
    }

    /// Ends the active motion, if any, and returns the reply to the request that started it.
    fn end(&mut self, status: MoveStatus) -> Option<Reply> {
        let Mode::Move(Motion { command_id, .. }) = self.mode else {
            return None;
        };
        self.mode = Mode::Idle;
        self.commanded = CommandedJoints {
            position_rad: self.commanded.position_rad,
            ..CommandedJoints::default()
        };
        Some(Reply {
            command: v10::Command::Move.to_u32(),
            command_id,
            payload: vec![self.move_byte(status)],
        })
    }

    /// The number of a status in the robot's FCI version.
    fn move_byte(&self, status: MoveStatus) -> u8 {
        match (self.config.version, status) {
            (FciVersion::V10, _) => status.to_u8(),
            (_, MoveStatus::Success) => v5::MoveStatus::Success.to_u8(),
            (_, MoveStatus::MotionStarted) => v5::MoveStatus::MotionStarted.to_u8(),
            (_, MoveStatus::Preempted) => v5::MoveStatus::Preempted.to_u8(),
            (_, MoveStatus::CommandNotPossibleRejected) => {
                v5::MoveStatus::CommandNotPossibleRejected.to_u8()
            }
            (_, MoveStatus::InvalidArgumentRejected) => {
                v5::MoveStatus::InvalidArgumentRejected.to_u8()
            }
            (_, MoveStatus::ReflexAborted) => v5::MoveStatus::ReflexAborted.to_u8(),
            _ => v5::MoveStatus::Aborted.to_u8(),
        }
    }
}

/// Commanded joint states a millisecond later. `rate` returns the velocity for a joint index and
/// position.
fn next_commanded(before: &CommandedJoints, rate: impl Fn(usize, f64) -> f64) -> CommandedJoints {
    let velocity_rad_s: [f64; N_JOINTS] =
        std::array::from_fn(|ix| rate(ix, before.position_rad[ix]));
    CommandedJoints {
        position_rad: std::array::from_fn(|ix| {
            before.position_rad[ix] + velocity_rad_s[ix] * STEP_SECS
        }),
        velocity_rad_s,
        acceleration_rad_s2: std::array::from_fn(|ix| {
            (velocity_rad_s[ix] - before.velocity_rad_s[ix]) / STEP_SECS
        }),
        is_moving: true,
    }
}
