//! CiA 402: the drive profile of CANopen, with its state machine and objects.
//!
//! Source: CiA 402-2 (IEC 61800-7-201) section "Controlling the power drive system": figure of the
//! states, tables of controlword (`0x6040`), statusword (`0x6041`) and modes (`0x6060`); the same
//! masks in `ros-industrial/ros_canopen`. Positions, velocities and torques are in units that each
//! drive defines: [`Units`].

use crate::wire::can::CanError;
use crate::wire::can::canopen::Object;
use std::f64::consts::TAU;

/// Reaction of the drive to a missing host heartbeat: 0 nothing, 1 fault, 2 disable voltage, 3
/// quick stop.
pub const ABORT_CONNECTION: Object = Object {
    index: 0x6007,
    subindex: 0,
    n_bytes: 2,
};
/// Behavior at a quick stop: 0 releases, 1 to 3 stop and release, 5 to 7 stop and stay stopped. See
/// [`STAY_STOPPED`].
pub const QUICK_STOP_OPTION: Object = Object {
    index: 0x605A,
    subindex: 0,
    n_bytes: 2,
};
/// Value of [`QUICK_STOP_OPTION`]: slow down on the quick-stop ramp and stay in
/// [`State::QuickStopActive`].
pub const STAY_STOPPED: i64 = 6;
/// Value of [`ABORT_CONNECTION`]: react as to [`StateCommand::DisableVoltage`].
pub const ABORT_BY_DISABLING: i64 = 2;
/// Value of [`ABORT_CONNECTION`]: react as to [`StateCommand::QuickStop`].
pub const ABORT_BY_QUICK_STOP: i64 = 3;
/// Supported modes, one bit each: [`Mode`] `n` is bit `n - 1`.
pub const SUPPORTED_MODES: Object = Object {
    index: 0x6502,
    subindex: 0,
    n_bytes: 4,
};
/// Interval of targets in a cyclic mode, in units of ten to the power of [`INTERPOLATION_EXPONENT`]
/// seconds.
pub const INTERPOLATION_PERIOD: Object = Object {
    index: 0x60C2,
    subindex: 1,
    n_bytes: 1,
};
/// See [`INTERPOLATION_PERIOD`]; -3 is milliseconds.
pub const INTERPOLATION_EXPONENT: Object = Object {
    index: 0x60C2,
    subindex: 2,
    n_bytes: 1,
};
/// State commands, see [`StateCommand::controlword`].
pub const CONTROLWORD: Object = Object {
    index: 0x6040,
    subindex: 0,
    n_bytes: 2,
};
/// State, see [`State::from_statusword`].
pub const STATUSWORD: Object = Object {
    index: 0x6041,
    subindex: 0,
    n_bytes: 2,
};
/// Requested mode, see [`Mode`].
pub const MODE: Object = Object {
    index: 0x6060,
    subindex: 0,
    n_bytes: 1,
};
/// Active mode.
pub const MODE_DISPLAY: Object = Object {
    index: 0x6061,
    subindex: 0,
    n_bytes: 1,
};
/// Measured position, signed counts.
pub const POSITION: Object = Object {
    index: 0x6064,
    subindex: 0,
    n_bytes: 4,
};
/// Measured velocity, signed counts per second.
pub const VELOCITY: Object = Object {
    index: 0x606C,
    subindex: 0,
    n_bytes: 4,
};
/// Target torque, signed thousandths of the rated torque.
pub const TARGET_TORQUE: Object = Object {
    index: 0x6071,
    subindex: 0,
    n_bytes: 2,
};
/// Rated torque, mN m.
pub const RATED_TORQUE: Object = Object {
    index: 0x6076,
    subindex: 0,
    n_bytes: 4,
};
/// Measured torque, signed thousandths of the rated torque.
pub const TORQUE: Object = Object {
    index: 0x6077,
    subindex: 0,
    n_bytes: 2,
};
/// Target position, signed counts.
pub const TARGET_POSITION: Object = Object {
    index: 0x607A,
    subindex: 0,
    n_bytes: 4,
};
/// Target velocity, signed counts per second.
pub const TARGET_VELOCITY: Object = Object {
    index: 0x60FF,
    subindex: 0,
    n_bytes: 4,
};

/// Mode of operation, which determines the meaning of the targets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i8)]
pub enum Mode {
    /// The target is a position, approached with the drive's own ramps.
    ProfilePosition = 1,
    /// The target is a velocity, approached with the drive's own ramps.
    ProfileVelocity = 3,
    /// The target is a torque, approached with the drive's own ramp.
    ProfileTorque = 4,
    /// Homing: finds the zero position.
    Homing = 6,
    /// The drive accepts a target position at every SYNC.
    CyclicPosition = 8,
    /// The drive accepts a target velocity at every SYNC.
    CyclicVelocity = 9,
    /// The drive accepts a target torque at every SYNC.
    CyclicTorque = 10,
}

/// State of a drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// The drive is starting.
    NotReadyToSwitchOn,
    /// Switched off.
    SwitchOnDisabled,
    /// Ready for power.
    ReadyToSwitchOn,
    /// Powered, with the shaft free.
    SwitchedOn,
    /// Enabled: the drive follows its targets.
    OperationEnabled,
    /// Executing a quick stop.
    QuickStopActive,
    /// Stopping because of a fault.
    FaultReactionActive,
    /// Stopped by a fault, with the shaft free.
    Fault,
}

/// A command that changes the state of a drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StateCommand {
    /// To [`State::ReadyToSwitchOn`].
    Shutdown,
    /// To [`State::SwitchedOn`].
    SwitchOn,
    /// To [`State::OperationEnabled`].
    EnableOperation,
    /// Back to [`State::SwitchedOn`].
    DisableOperation,
    /// To [`State::SwitchOnDisabled`] at once, with the shaft free.
    DisableVoltage,
    /// To [`State::QuickStopActive`].
    QuickStop,
    /// From [`State::Fault`] to [`State::SwitchOnDisabled`]. It takes effect on the rising edge of
    /// bit 7, so another command must precede it.
    ResetFault,
}

impl Mode {
    /// Whether `supported`, the value of [`SUPPORTED_MODES`], includes this mode.
    pub fn is_in(self, supported: u32) -> bool {
        // The object counts modes from 1 and bits from 0.
        supported >> (self as i8 - 1) & 1 == 1
    }
}

impl StateCommand {
    /// The bits of the controlword that all modes share.
    pub fn controlword(self) -> u16 {
        match self {
            Self::Shutdown => 0x06,
            Self::SwitchOn | Self::DisableOperation => 0x07,
            Self::EnableOperation => 0x0F,
            Self::DisableVoltage => 0x00,
            Self::QuickStop => 0x02,
            Self::ResetFault => 0x80,
        }
    }
}

impl State {
    /// Decodes the state in a statusword. Mode-specific and manufacturer-specific bits are ignored.
    pub fn from_statusword(statusword: u16) -> Result<Self, CanError> {
        // Bits 0 to 3 and 6 are part of every state. Bit 5 (quick stop, active low) is part of the
        // state only if the drive is powered or ready.
        match (statusword & 0x4F, statusword & 0x20 != 0) {
            (0x00, _) => Ok(Self::NotReadyToSwitchOn),
            (0x40, _) => Ok(Self::SwitchOnDisabled),
            (0x01, true) => Ok(Self::ReadyToSwitchOn),
            (0x03, true) => Ok(Self::SwitchedOn),
            (0x07, true) => Ok(Self::OperationEnabled),
            (0x07, false) => Ok(Self::QuickStopActive),
            (0x0F, _) => Ok(Self::FaultReactionActive),
            (0x08, _) => Ok(Self::Fault),
            _ => Err(CanError::Undefined {
                field: "the state in the statusword",
                raw: statusword.into(),
            }),
        }
    }

    /// The command that advances a drive by one state towards enabled; `None` if the drive is
    /// enabled, or makes the next transition automatically.
    ///
    /// A fault is reset only if `may_reset_fault` is set, because its cause may persist.
    pub fn next_enabling_command(self, may_reset_fault: bool) -> Option<StateCommand> {
        match self {
            Self::SwitchOnDisabled => Some(StateCommand::Shutdown),
            Self::ReadyToSwitchOn => Some(StateCommand::SwitchOn),
            Self::SwitchedOn => Some(StateCommand::EnableOperation),
            // Drives are not required to support the direct transition back to the enabled state,
            // so the drive is disabled first.
            Self::QuickStopActive => Some(StateCommand::DisableVoltage),
            Self::Fault if may_reset_fault => Some(StateCommand::ResetFault),
            Self::Fault
            | Self::NotReadyToSwitchOn
            | Self::FaultReactionActive
            | Self::OperationEnabled => None,
        }
    }

    /// The state after a command; unchanged if the command has no effect in this state.
    ///
    /// Automatic transitions of the drive (0, 1, automatic 12, 13, 14) are not commands.
    pub fn after(self, state_command: StateCommand) -> Self {
        match (self, state_command) {
            (
                Self::SwitchOnDisabled | Self::SwitchedOn | Self::OperationEnabled,
                StateCommand::Shutdown,
            ) => Self::ReadyToSwitchOn,
            (Self::ReadyToSwitchOn, StateCommand::SwitchOn | StateCommand::DisableOperation) => {
                Self::SwitchedOn
            }
            (Self::OperationEnabled, StateCommand::SwitchOn | StateCommand::DisableOperation) => {
                Self::SwitchedOn
            }
            (Self::SwitchedOn, StateCommand::EnableOperation) => Self::OperationEnabled,
            (Self::OperationEnabled, StateCommand::QuickStop) => Self::QuickStopActive,
            (
                Self::ReadyToSwitchOn | Self::SwitchedOn,
                StateCommand::QuickStop | StateCommand::DisableVoltage,
            ) => Self::SwitchOnDisabled,
            (Self::OperationEnabled | Self::QuickStopActive, StateCommand::DisableVoltage) => {
                Self::SwitchOnDisabled
            }
            // A drive in the fault state ignores all other commands, so that no command enables it
            // by accident.
            (Self::Fault, StateCommand::ResetFault) => Self::SwitchOnDisabled,
            (state, _) => state,
        }
    }

    /// A statusword for this state, for emulated drives.
    pub fn statusword(self) -> u16 {
        match self {
            Self::NotReadyToSwitchOn => 0x00,
            Self::SwitchOnDisabled => 0x40,
            Self::ReadyToSwitchOn => 0x21,
            Self::SwitchedOn => 0x23,
            Self::OperationEnabled => 0x27,
            Self::QuickStopActive => 0x07,
            Self::FaultReactionActive => 0x0F,
            Self::Fault => 0x08,
        }
    }
}

/// Units of a drive's raw values, from its objects or the rig file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Units {
    /// Counts of [`POSITION`] per turn of the output shaft, and of [`VELOCITY`] per turn per
    /// second.
    pub counts_per_turn: f64,
    /// Torque of 1000 counts of [`TORQUE`], N m at the output shaft.
    pub rated_torque_nm: f64,
}

impl Units {
    /// Converts counts of [`POSITION`] to rad, or of [`VELOCITY`] to rad/s.
    pub fn rad_from_raw(&self, raw: i32) -> f64 {
        f64::from(raw) * TAU / self.counts_per_turn
    }

    /// Converts to the nearest count.
    ///
    /// # Errors
    /// If the count does not fit into 32 bits. Positions are not clamped, because that would change
    /// the target.
    pub fn raw_from_rad(&self, field: &'static str, value: f64) -> Result<i32, CanError> {
        let count = (value * self.counts_per_turn / TAU).round();
        let range = (f64::from(i32::MIN), f64::from(i32::MAX));
        checked_count(field, count, range, value, TAU / self.counts_per_turn)
    }

    /// Converts counts of [`TORQUE`] to N m.
    pub fn nm_from_raw(&self, raw: i16) -> f64 {
        f64::from(raw) * self.rated_torque_nm / 1000.0
    }

    /// Converts to the nearest count of [`TARGET_TORQUE`].
    ///
    /// # Errors
    /// If the count does not fit into 16 bits.
    pub fn raw_from_nm(&self, value: f64) -> Result<i16, CanError> {
        let count = (value * 1000.0 / self.rated_torque_nm).round();
        let range = (f64::from(i16::MIN), f64::from(i16::MAX));
        let raw = checked_count(
            "the torque",
            count,
            range,
            value,
            self.rated_torque_nm / 1000.0,
        )?;
        Ok(i16::try_from(raw).expect("the count was checked to fit into 16 bits"))
    }
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "within the range, which fits into 32 bits"
)]
fn checked_count(
    field: &'static str,
    count: f64,
    range: (f64, f64),
    value: f64,
    unit: f64,
) -> Result<i32, CanError> {
    // NaN is in no range, so it is rejected as well.
    if (range.0..=range.1).contains(&count) {
        Ok(count as i32)
    } else {
        Err(CanError::Range {
            field,
            value,
            lower: range.0 * unit,
            upper: range.1 * unit,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::can::canopen::{Node, encode_write};
    use numbers::random::Random;

    const ALL: [State; 8] = [
        State::NotReadyToSwitchOn,
        State::SwitchOnDisabled,
        State::ReadyToSwitchOn,
        State::SwitchedOn,
        State::OperationEnabled,
        State::QuickStopActive,
        State::FaultReactionActive,
        State::Fault,
    ];

    #[test]
    fn statuswords_match_standard() {
        // The bit patterns have the form xxxx xxxx x0xx 0000, where x is tested as 0 and as 1. The
        // last two statuswords are from real drives.
        for (statusword, state) in [
            (0x0000, State::NotReadyToSwitchOn),
            (0xFFB0, State::NotReadyToSwitchOn),
            (0x0040, State::SwitchOnDisabled),
            (0xFFF0, State::SwitchOnDisabled),
            (0x0021, State::ReadyToSwitchOn),
            (0xFFB1, State::ReadyToSwitchOn),
            (0x0023, State::SwitchedOn),
            (0x0027, State::OperationEnabled),
            (0xFFB7, State::OperationEnabled),
            (0x0007, State::QuickStopActive),
            (0xFF97, State::QuickStopActive),
            (0x000F, State::FaultReactionActive),
            (0x0008, State::Fault),
            (0x0218, State::Fault),
            (0x0250, State::SwitchOnDisabled),
            (0x1637, State::OperationEnabled),
        ] {
            assert_eq!(
                State::from_statusword(statusword),
                Ok(state),
                "{statusword:#06x}"
            );
        }
        for state in ALL {
            assert_eq!(State::from_statusword(state.statusword()), Ok(state));
        }
        let n_defined = (0..=u16::MAX)
            .filter(|word| State::from_statusword(*word).is_ok())
            .count();
        // Bits 0 to 3, 5 and 6 have 64 values. Four states ignore bit 5, and four do not.
        assert_eq!(n_defined, (4 * 2 + 4) * 65_536 / 64);
        assert!(State::from_statusword(0x0003).is_err() && State::from_statusword(0x0067).is_err());
    }

    #[test]
    fn commands_enable_drive_from_every_state() {
        for start in ALL {
            let mut state = start;
            let mut n_commands = 0;
            while let Some(state_command) = state.next_enabling_command(true) {
                assert_ne!(
                    state.after(state_command),
                    state,
                    "{state:?} {state_command:?}"
                );
                state = state.after(state_command);
                n_commands += 1;
                assert!(n_commands <= 4, "{start:?}");
            }
            let waits_for_drive = matches!(
                start,
                State::NotReadyToSwitchOn | State::FaultReactionActive
            );
            assert_eq!(
                state,
                if waits_for_drive {
                    start
                } else {
                    State::OperationEnabled
                },
                "{start:?}"
            );
        }
        assert_eq!(State::Fault.next_enabling_command(false), None);
        for state in ALL {
            let is_powered = matches!(
                state.after(StateCommand::DisableVoltage),
                State::SwitchedOn | State::OperationEnabled
            );
            assert!(!is_powered, "{state:?}");
        }
        let node = Node::new(1).expect("in range");
        let enable = encode_write(
            node,
            CONTROLWORD,
            StateCommand::EnableOperation.controlword().into(),
        )
        .expect("16 bits");
        assert_eq!(enable.data(), [0x2B, 0x40, 0x60, 0, 0x0F, 0, 0, 0]);
        let mode = encode_write(node, MODE, Mode::CyclicPosition as i64).expect("8 bits");
        assert_eq!(mode.data(), [0x2F, 0x60, 0x60, 0, 8, 0, 0, 0]);
        assert!(Mode::CyclicPosition.is_in(0x80) && !Mode::CyclicPosition.is_in(!0x80));
    }

    #[test]
    fn counts_round_trip_and_out_of_range_is_rejected() {
        let units = Units {
            counts_per_turn: 524_288.0,
            rated_torque_nm: 2.5,
        };
        assert_eq!(units.raw_from_rad("the position", TAU), Ok(524_288));
        assert!((units.nm_from_raw(-1000) + 2.5).abs() < 1e-12);
        let mut random = Random::new(31);
        for _ in 0..10_000 {
            let raw = random.bits_32().cast_signed();
            assert_eq!(
                units.raw_from_rad("the position", units.rad_from_raw(raw)),
                Ok(raw)
            );
            let torque = i16::from_le_bytes([random.byte(), random.byte()]);
            assert_eq!(units.raw_from_nm(units.nm_from_raw(torque)), Ok(torque));
        }
        for bad in [1e6, -1e6, f64::NAN, f64::INFINITY] {
            assert!(
                matches!(
                    units.raw_from_rad("the position", bad),
                    Err(CanError::Range { .. })
                ),
                "{bad}"
            );
            assert!(
                matches!(units.raw_from_nm(bad), Err(CanError::Range { .. })),
                "{bad}"
            );
        }
    }
}
