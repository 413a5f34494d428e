//! TCP messages between client and controller, and the client's motion commands over UDP.

use super::super::N_JOINTS;
use franka::FciVersion;
use franka::wire::robot::{v5, v10};
use franka::wire::{HeaderLayout, f64s_to_f64};
use zerocopy::FromBytes;

/// A request of a client.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Request {
    Connect,
    Move,
    Stop,
    Recover,
    Model,
    Library,
    CartesianLimit,
    Set(Setting),
}

/// A setting that a client can change.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Setting {
    Collision,
    JointImpedance,
    CartesianImpedance,
    Guiding,
    EeToStiffness,
    NominalToEe,
    Load,
    Filters,
}

/// Motion command with which a client answers one state.
pub(super) struct Command {
    pub(super) number: u64,
    pub(super) position_rad: [f64; N_JOINTS],
    pub(super) velocity_rad_s: [f64; N_JOINTS],
    pub(super) is_last: bool,
}

/// A message to the client, without its header.
pub(super) struct Reply {
    pub(super) command: u32,
    pub(super) command_id: u32,
    pub(super) payload: Vec<u8>,
}

impl Reply {
    /// Encodes the message with its header.
    pub(super) fn bytes(&self) -> Vec<u8> {
        let mut bytes =
            HeaderLayout::Robot.encode_header(self.command, self.command_id, self.payload.len());
        bytes.extend(&self.payload);
        bytes
    }
}

impl Request {
    /// The request of a command number; `None` if the version has no such command.
    pub(super) fn from_number(version: FciVersion, number: u32) -> Option<Self> {
        Some(match version {
            FciVersion::V5 => match v5::Command::from_u32(number)? {
                v5::Command::Connect => Self::Connect,
                v5::Command::Move => Self::Move,
                v5::Command::StopMove => Self::Stop,
                v5::Command::GetCartesianLimit => Self::CartesianLimit,
                v5::Command::SetCollisionBehavior => Self::Set(Setting::Collision),
                v5::Command::SetJointImpedance => Self::Set(Setting::JointImpedance),
                v5::Command::SetCartesianImpedance => Self::Set(Setting::CartesianImpedance),
                v5::Command::SetGuidingMode => Self::Set(Setting::Guiding),
                v5::Command::SetEEToK => Self::Set(Setting::EeToStiffness),
                v5::Command::SetNEToEE => Self::Set(Setting::NominalToEe),
                v5::Command::SetLoad => Self::Set(Setting::Load),
                v5::Command::SetFilters => Self::Set(Setting::Filters),
                v5::Command::AutomaticErrorRecovery => Self::Recover,
                v5::Command::LoadModelLibrary => Self::Library,
            },
            FciVersion::V10 => match v10::Command::from_u32(number)? {
                v10::Command::Connect => Self::Connect,
                v10::Command::Move => Self::Move,
                v10::Command::StopMove => Self::Stop,
                v10::Command::SetCollisionBehavior => Self::Set(Setting::Collision),
                v10::Command::SetJointImpedance => Self::Set(Setting::JointImpedance),
                v10::Command::SetCartesianImpedance => Self::Set(Setting::CartesianImpedance),
                v10::Command::SetGuidingMode => Self::Set(Setting::Guiding),
                v10::Command::SetEEToK => Self::Set(Setting::EeToStiffness),
                v10::Command::SetNEToEE => Self::Set(Setting::NominalToEe),
                v10::Command::SetLoad => Self::Set(Setting::Load),
                v10::Command::AutomaticErrorRecovery => Self::Recover,
                v10::Command::GetRobotModel => Self::Model,
            },
        })
    }
}

impl Setting {
    /// Payload length.
    pub(super) fn n_bytes(self) -> usize {
        match self {
            Self::Collision => size_of::<v10::SetCollisionBehaviorRequest>(),
            Self::JointImpedance => size_of::<v10::SetJointImpedanceRequest>(),
            Self::CartesianImpedance => size_of::<v10::SetCartesianImpedanceRequest>(),
            Self::Guiding => size_of::<v10::SetGuidingModeRequest>(),
            Self::EeToStiffness => size_of::<v10::SetEEToKRequest>(),
            Self::NominalToEe => size_of::<v10::SetNEToEERequest>(),
            Self::Load => size_of::<v10::SetLoadRequest>(),
            Self::Filters => size_of::<v5::SetFiltersRequest>(),
        }
    }
}

impl Command {
    /// Decodes a datagram; `None` if it is not a command of this version.
    pub(super) fn decode(version: FciVersion, bytes: &[u8]) -> Option<Self> {
        let (number, q_c, dq_c, is_last) = match version {
            FciVersion::V5 => {
                let v5::RobotCommand {
                    message_id, motion, ..
                } = v5::RobotCommand::read_from_bytes(bytes).ok()?;
                (
                    message_id,
                    motion.q_c,
                    motion.dq_c,
                    motion.motion_generation_finished,
                )
            }
            FciVersion::V10 => {
                let v10::RobotCommand {
                    message_id, motion, ..
                } = v10::RobotCommand::read_from_bytes(bytes).ok()?;
                (
                    message_id,
                    motion.q_c,
                    motion.dq_c,
                    motion.motion_generation_finished,
                )
            }
        };
        Some(Self {
            number: number.get(),
            position_rad: f64s_to_f64(&q_c),
            velocity_rad_s: f64s_to_f64(&dq_c),
            is_last: is_last != 0,
        })
    }
}
