//! CiA 402: the drive behind a CANopen node, its state machine and its objects.
//!
//! Source: CiA 402-2 (IEC 61800-7-201) section "Controlling the power drive system": figure of the states, tables of
//! controlword (`0x6040`), statusword (`0x6041`) and modes (`0x6060`); the same masks in `ros-industrial/ros_canopen`. Positions,
//! velocities and torques are in units that each drive defines: [`Units`].

use super::CanError;
use super::canopen::Object;
use std::f64::consts::TAU;

/// What the drive does when the host is gone: 0 nothing, 1 fault, 2 switch off, 3 quick stop.
pub const ABORT_CONNECTION: Object = Object { index: 0x6007, subindex: 0, n_bytes: 2 };
/// What it does at a quick stop: 0 let go, 1 to 3 stop and let go, 5 to 7 stop and stay, [`STAY_STOPPED`] by its quick-stop ramp.
pub const QUICK_STOP_OPTION: Object = Object { index: 0x605A, subindex: 0, n_bytes: 2 };
/// Value of [`QUICK_STOP_OPTION`]: slow down on the quick-stop ramp and stay in [`State::QuickStopActive`].
pub const STAY_STOPPED: i64 = 6;
/// Value of [`ABORT_CONNECTION`]: the order [`StateCommand::DisableVoltage`].
pub const ABORT_BY_DISABLING: i64 = 2;
/// Value of [`ABORT_CONNECTION`]: the order [`StateCommand::QuickStop`].
pub const ABORT_BY_QUICK_STOP: i64 = 3;
/// Modes that it has, a bit each: [`Mode`] `n` is bit `n - 1`.
pub const SUPPORTED_MODES: Object = Object { index: 0x6502, subindex: 0, n_bytes: 4 };
/// How often targets come in a cyclic mode, in units of ten to the power of [`INTERPOLATION_EXPONENT`] seconds.
pub const INTERPOLATION_PERIOD: Object = Object { index: 0x60C2, subindex: 1, n_bytes: 1 };
/// See [`INTERPOLATION_PERIOD`]; -3 is milliseconds.
pub const INTERPOLATION_EXPONENT: Object = Object { index: 0x60C2, subindex: 2, n_bytes: 1 };
/// Orders, [`StateCommand::controlword`].
pub const CONTROLWORD: Object = Object { index: 0x6040, subindex: 0, n_bytes: 2 };
/// State, [`State::from_statusword`].
pub const STATUSWORD: Object = Object { index: 0x6041, subindex: 0, n_bytes: 2 };
/// Mode asked for, [`Mode`].
pub const MODE: Object = Object { index: 0x6060, subindex: 0, n_bytes: 1 };
/// Mode that it is in.
pub const MODE_DISPLAY: Object = Object { index: 0x6061, subindex: 0, n_bytes: 1 };
/// Where it is, signed counts.
pub const POSITION: Object = Object { index: 0x6064, subindex: 0, n_bytes: 4 };
/// How fast, signed counts a second.
pub const VELOCITY: Object = Object { index: 0x606C, subindex: 0, n_bytes: 4 };
/// Torque asked for, signed thousandths of the rated one.
pub const TARGET_TORQUE: Object = Object { index: 0x6071, subindex: 0, n_bytes: 2 };
/// Rated torque, mN m.
pub const RATED_TORQUE: Object = Object { index: 0x6076, subindex: 0, n_bytes: 4 };
/// Torque, signed thousandths of the rated one.
pub const TORQUE: Object = Object { index: 0x6077, subindex: 0, n_bytes: 2 };
/// Where to, signed counts.
pub const TARGET_POSITION: Object = Object { index: 0x607A, subindex: 0, n_bytes: 4 };
/// How fast it shall be, signed counts a second.
pub const TARGET_VELOCITY: Object = Object { index: 0x60FF, subindex: 0, n_bytes: 4 };

/// What the targets mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i8)]
pub enum Mode {
    /// To a position with the drive's own ramps.
    ProfilePosition = 1,
    /// A velocity with the drive's own ramps.
    ProfileVelocity = 3,
    /// A torque with the drive's own ramp.
    ProfileTorque = 4,
    /// Look for zero.
    Homing = 6,
    /// A position at every SYNC.
    CyclicPosition = 8,
    /// A velocity at every SYNC.
    CyclicVelocity = 9,
    /// A torque at every SYNC.
    CyclicTorque = 10,
}

/// State of a drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// It begins.
    NotReadyToSwitchOn,
    /// Nothing is on.
    SwitchOnDisabled,
    /// Power may come.
    ReadyToSwitchOn,
    /// Power is there, the shaft is free.
    SwitchedOn,
    /// It obeys.
    OperationEnabled,
    /// It stops by itself.
    QuickStopActive,
    /// It stops because of a fault.
    FaultReactionActive,
    /// The shaft is free because of a fault.
    Fault,
}

/// An order to a drive.
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
    /// To [`State::SwitchOnDisabled`] at once, the shaft free.
    DisableVoltage,
    /// To [`State::QuickStopActive`].
    QuickStop,
    /// From [`State::Fault`] to [`State::SwitchOnDisabled`]; counts when bit 7 rises, so another order must come before.
    ResetFault,
}

impl Mode {
    /// Whether [`SUPPORTED_MODES`] has it.
    pub fn is_in(self, supported: u32) -> bool {
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
    /// The state that a statusword tells; bits of modes and makers may be anything.
    pub fn from_statusword(statusword: u16) -> Result<Self, CanError> {
        // Bit 5 (quick stop, low when active) belongs to the state only where power may be.
        match (statusword & 0x4F, statusword & 0x20 != 0) {
            (0x00, _) => Ok(Self::NotReadyToSwitchOn),
            (0x40, _) => Ok(Self::SwitchOnDisabled),
            (0x01, true) => Ok(Self::ReadyToSwitchOn),
            (0x03, true) => Ok(Self::SwitchedOn),
            (0x07, true) => Ok(Self::OperationEnabled),
            (0x07, false) => Ok(Self::QuickStopActive),
            (0x0F, _) => Ok(Self::FaultReactionActive),
            (0x08, _) => Ok(Self::Fault),
            _ => Err(CanError::Undefined { field: "the state in the statusword", raw: statusword.into() }),
        }
    }

    /// The order that brings a drive one state nearer to obeying; `None` where it obeys or must be waited for.
    ///
    /// A fault is only reset when that is allowed: what caused it may still be there.
    pub fn next_enabling_command(self, may_reset_fault: bool) -> Option<StateCommand> {
        match self {
            Self::SwitchOnDisabled => Some(StateCommand::Shutdown),
            Self::ReadyToSwitchOn => Some(StateCommand::SwitchOn),
            Self::SwitchedOn => Some(StateCommand::EnableOperation),
            Self::QuickStopActive => Some(StateCommand::DisableVoltage),
            Self::Fault if may_reset_fault => Some(StateCommand::ResetFault),
            Self::Fault | Self::NotReadyToSwitchOn | Self::FaultReactionActive | Self::OperationEnabled => None,
        }
    }

    /// The state after an order; the same where the order does nothing there.
    ///
    /// The drive's own transitions (0, 1, 12 by itself, 13, 14) are not orders.
    pub fn after(self, state_command: StateCommand) -> Self {
        match (self, state_command) {
            (Self::SwitchOnDisabled | Self::SwitchedOn | Self::OperationEnabled, StateCommand::Shutdown) => {
                Self::ReadyToSwitchOn
            }
            (Self::ReadyToSwitchOn, StateCommand::SwitchOn | StateCommand::DisableOperation) => Self::SwitchedOn,
            (Self::OperationEnabled, StateCommand::SwitchOn | StateCommand::DisableOperation) => Self::SwitchedOn,
            (Self::SwitchedOn, StateCommand::EnableOperation) => Self::OperationEnabled,
            (Self::OperationEnabled, StateCommand::QuickStop) => Self::QuickStopActive,
            (Self::ReadyToSwitchOn | Self::SwitchedOn, StateCommand::QuickStop | StateCommand::DisableVoltage) => {
                Self::SwitchOnDisabled
            }
            (Self::OperationEnabled | Self::QuickStopActive, StateCommand::DisableVoltage) => Self::SwitchOnDisabled,
            (Self::Fault, StateCommand::ResetFault) => Self::SwitchOnDisabled,
            (state, _) => state,
        }
    }

    /// A statusword that tells it, for drives that are simulated.
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

/// What a drive's counts are worth: its objects' factors, or a rig's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Units {
    /// Counts of [`POSITION`] in a turn of the output shaft; [`VELOCITY`] is as many a second.
    pub counts_per_turn: f64,
    /// What 1000 counts of [`TORQUE`] are, N m at the output shaft.
    pub rated_torque_nm: f64,
}

impl Units {
    /// Angle of a count of [`POSITION`], rad; or velocity of one of [`VELOCITY`], rad/s.
    pub fn rad_from_raw(&self, raw: i32) -> f64 {
        f64::from(raw) * TAU / self.counts_per_turn
    }

    /// The nearest count; what 32 bits do not hold is refused, for a position cannot be clamped without meaning another.
    pub fn raw_from_rad(&self, field: &'static str, value: f64) -> Result<i32, CanError> {
        let count = (value * self.counts_per_turn / TAU).round();
        let range = (f64::from(i32::MIN), f64::from(i32::MAX));
        checked_count(field, count, range, value, TAU / self.counts_per_turn)
    }

    /// Torque of a count of [`TORQUE`], N m.
    pub fn nm_from_raw(&self, raw: i16) -> f64 {
        f64::from(raw) * self.rated_torque_nm / 1000.0
    }

    /// The nearest count of [`TARGET_TORQUE`]; what 16 bits do not hold is refused.
    pub fn raw_from_nm(&self, value: f64) -> Result<i16, CanError> {
        let count = (value * 1000.0 / self.rated_torque_nm).round();
        let range = (f64::from(i16::MIN), f64::from(i16::MAX));
        let raw = checked_count("the torque", count, range, value, self.rated_torque_nm / 1000.0)?;
        Ok(i16::try_from(raw).expect("within 16 bits by the check"))
    }
}

#[expect(clippy::cast_possible_truncation, reason = "within the ends, which are within 32 bits")]
fn checked_count(field: &'static str, count: f64, range: (f64, f64), value: f64, unit: f64) -> Result<i32, CanError> {
    match (range.0..=range.1).contains(&count) {
        true => Ok(count as i32),
        false => Err(CanError::Range { field, value, lower: range.0 * unit, upper: range.1 * unit }),
    }
}

#[cfg(test)]
mod tests {
    use super::super::canopen::{Node, encode_write};
    use super::super::testing::Random;
    use super::*;

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
        // xxxx xxxx x0xx 0000 and so on, x of both kinds; the last two as drives in the field send them.
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
            assert_eq!(State::from_statusword(statusword), Ok(state), "{statusword:#06x}");
        }
        for state in ALL {
            assert_eq!(State::from_statusword(state.statusword()), Ok(state));
        }
        let n_defined = (0..=u16::MAX).filter(|word| State::from_statusword(*word).is_ok()).count();
        // Of the 64 values of bits 0 to 3, 5 and 6: four states leave bit 5 open, four do not.
        assert_eq!(n_defined, (4 * 2 + 4) * 65_536 / 64);
        assert!(State::from_statusword(0x0003).is_err() && State::from_statusword(0x0067).is_err());
    }

    #[test]
    fn commands_enable_drive_from_every_state() {
        for start in ALL {
            let mut state = start;
            let mut n_commands = 0;
            while let Some(state_command) = state.next_enabling_command(true) {
                assert_ne!(state.after(state_command), state, "{state:?} {state_command:?}");
                state = state.after(state_command);
                n_commands += 1;
                assert!(n_commands <= 4, "{start:?}");
            }
            let waits_for_drive = matches!(start, State::NotReadyToSwitchOn | State::FaultReactionActive);
            assert_eq!(state, if waits_for_drive { start } else { State::OperationEnabled }, "{start:?}");
        }
        assert_eq!(State::Fault.next_enabling_command(false), None);
        for state in ALL {
            let is_powered =
                matches!(state.after(StateCommand::DisableVoltage), State::SwitchedOn | State::OperationEnabled);
            assert!(!is_powered, "{state:?}");
        }
        let node = Node::new(1).expect("in range");
        let enable =
            encode_write(node, CONTROLWORD, StateCommand::EnableOperation.controlword().into()).expect("16 bits");
        assert_eq!(enable.data(), [0x2B, 0x40, 0x60, 0, 0x0F, 0, 0, 0]);
        let mode = encode_write(node, MODE, Mode::CyclicPosition as i64).expect("8 bits");
        assert_eq!(mode.data(), [0x2F, 0x60, 0x60, 0, 8, 0, 0, 0]);
        assert!(Mode::CyclicPosition.is_in(0x80) && !Mode::CyclicPosition.is_in(!0x80));
    }

    #[test]
    fn counts_round_trip_and_out_of_range_is_rejected() {
        let units = Units { counts_per_turn: 524_288.0, rated_torque_nm: 2.5 };
        assert_eq!(units.raw_from_rad("the position", TAU), Ok(524_288));
        assert!((units.nm_from_raw(-1000) + 2.5).abs() < 1e-12);
        let mut random = Random(31);
        for _ in 0..10_000 {
            let raw = random.next().cast_signed();
            assert_eq!(units.raw_from_rad("the position", units.rad_from_raw(raw)), Ok(raw));
            let [low, high, ..] = random.next().to_le_bytes();
            let torque = i16::from_le_bytes([low, high]);
            assert_eq!(units.raw_from_nm(units.nm_from_raw(torque)), Ok(torque));
        }
        for bad in [1e6, -1e6, f64::NAN, f64::INFINITY] {
            assert!(matches!(units.raw_from_rad("the position", bad), Err(CanError::Range { .. })), "{bad}");
            assert!(matches!(units.raw_from_nm(bad), Err(CanError::Range { .. })), "{bad}");
        }
    }
}
