//! Moves a CiA 402 drive in cyclic synchronous position mode.

use super::Cia402;
use super::codec::{self, Mode, State, StateCommand};
use super::setup::{get, map_pdo_at_every_sync, set, set_and_check, start_drive, try_set};
use crate::can::family::{Health, MAX_CHANGE, MotionProtocol};
use crate::can::query::MotorQuery;
use crate::can::watchdog::WatchdogPlan;
use crate::motion::OnLoss;
use crate::wire::can::canopen::{self, Direction, Pdo};
use crate::wire::can::mit::Command;
use crate::wire::can::{CanError, Frame};
use crate::{Error, clock};

/// SDO abort code of a drive that does not have the object.
const NO_SUCH_OBJECT: u32 = 0x0602_0000;

/// A drive that may be moved.
#[derive(Debug)]
pub(super) struct Cia402Motion {
    pub(super) address: Cia402,
    /// State according to the last report.
    pub(super) state: State,
}

impl Cia402Motion {
    /// Encodes a state command that is sent outside the cycle.
    fn encode(&self, state_command: StateCommand) -> Result<Frame, CanError> {
        canopen::encode_write(
            self.address.node,
            codec::CONTROLWORD,
            state_command.controlword().into(),
        )
    }

    /// Decodes the state in the drive's second PDO.
    fn decode_state(&self, frame: &Frame) -> Option<State> {
        if frame.id() != Pdo::Second.id(Direction::Transmit, self.address.node) || frame.is_remote()
        {
            return None;
        }
        let statusword = u16::from_le_bytes(<[u8; 2]>::try_from(frame.data()).ok()?);
        State::from_statusword(statusword).ok()
    }
}

impl MotionProtocol for Cia402Motion {
    fn switch_off(&self, query: &MotorQuery<'_>) -> Result<(), Error> {
        let node = self.address.node;
        let deadline = clock::now() + MAX_CHANGE;
        // A drive may need several commands. A fault reaction must end before the fault can be
        // reset, and the drive may still be powered after the reset.
        loop {
            let statusword = get(query, node, codec::STATUSWORD)?;
            let [low, high, ..] = statusword.to_le_bytes();
            let state = query.map_error(State::from_statusword(u16::from_le_bytes([low, high])))?;
            let requested = match state {
                State::SwitchOnDisabled => return Ok(()),
                State::Fault => {
                    log::warn!("{}: the drive reports a fault; resetting it", query.name());
                    StateCommand::ResetFault
                }
                _ => StateCommand::DisableVoltage,
            };
            if clock::now() > deadline {
                return Err(query.not_disabled(&format!("{state:?}")));
            }
            // A reset takes effect on the rising edge of its bit.
            for state_command in [StateCommand::DisableVoltage, requested] {
                set(
                    query,
                    node,
                    codec::CONTROLWORD,
                    state_command.controlword().into(),
                )?;
            }
        }
    }

    fn set_watchdog(&self, query: &MotorQuery<'_>, plan: &WatchdogPlan) -> Result<(), Error> {
        let node = self.address.node;
        // A timeout that does not fit into the object is shortened, so that the drive stops earlier
        // rather than later.
        let millis = u16::try_from(plan.timeout.as_millis()).unwrap_or(u16::MAX);
        let heartbeat = canopen::consumer_heartbeat(plan.host, millis);
        set_and_check(query, node, canopen::CONSUMER_HEARTBEAT, heartbeat.into())?;
        let reaction = match plan.on_loss {
            OnLoss::Hold => {
                // With other values, the drive would release the shaft after the stop, and an arm
                // without brakes would fall.
                set_and_check(query, node, codec::QUICK_STOP_OPTION, codec::STAY_STOPPED)?;
                codec::ABORT_BY_QUICK_STOP
            }
            // `Damp` is refused before anything is sent, because drives have no such reaction.
            OnLoss::Damp | OnLoss::Release => codec::ABORT_BY_DISABLING,
        };
        set_and_check(query, node, codec::ABORT_CONNECTION, reaction)
    }

    /// Makes the drive accept a position and report its state at every SYNC.
    fn set_mode(&self, query: &MotorQuery<'_>, plan: &WatchdogPlan) -> Result<(), Error> {
        let node = self.address.node;
        // In the cyclic mode, the drive follows our trajectory directly. In the profile modes, it
        // would add its own ramps to each target.
        let supported = get(query, node, codec::SUPPORTED_MODES)?;
        if !Mode::CyclicPosition.is_in(supported) {
            return Err(query.fault(format!(
                "the drive has no cyclic synchronous position mode (object 0x6502 is {supported:#x}), and no other mode is supported"
            )));
        }
        // A drive changes its mode some time after the object is written. A target that arrives
        // before the change would be executed in the old mode.
        set(query, node, codec::MODE, Mode::CyclicPosition as i64)?;
        let deadline = clock::now() + MAX_CHANGE;
        while get(query, node, codec::MODE_DISPLAY)? != Mode::CyclicPosition as u32 {
            if clock::now() > deadline {
                return Err(
                    query.fault("the drive does not change to cyclic synchronous position mode")
                );
            }
        }
        // For arms with drives, the period is a whole number of milliseconds. A drive that does not
        // interpolate does not have this object.
        let millis = i64::try_from(plan.period.as_millis()).unwrap_or(i64::MAX);
        for (object, value) in [
            (codec::INTERPOLATION_PERIOD, millis),
            (codec::INTERPOLATION_EXPONENT, -3),
        ] {
            match try_set(query, node, object, value)? {
                Err(CanError::Aborted {
                    code: NO_SUCH_OBJECT,
                    ..
                }) => break,
                result => query.map_error(result)?,
            }
        }
        // Controlword and target are sent in one PDO. With two PDOs, a drive could be enabled with
        // an old target.
        let targets = [codec::CONTROLWORD, codec::TARGET_POSITION];
        let mut entries = map_pdo_at_every_sync(Pdo::First, Direction::Receive, node, &targets);
        entries.extend(map_pdo_at_every_sync(
            Pdo::Second,
            Direction::Transmit,
            node,
            &[codec::STATUSWORD],
        ));
        start_drive(query, node, &entries)
    }

    /// Returns no frames, because the commands of a drive enable it.
    fn enable(&self) -> Result<Vec<Frame>, CanError> {
        Ok(Vec::new())
    }

    /// Advances the drive by one state towards enabled, and keeps it there. This does not reset a
    /// fault.
    fn command(&self, command: &Command) -> Result<Frame, CanError> {
        let state_command = match self.state {
            // The controlword is part of each target, so it must repeat the command that keeps the
            // drive enabled.
            State::OperationEnabled => StateCommand::EnableOperation,
            state => state
                .next_enabling_command(false)
                .unwrap_or(StateCommand::DisableVoltage),
        };
        let [low, high] = state_command.controlword().to_le_bytes();
        // A position that cannot be encoded is an error, because a clamped position would move the
        // joint elsewhere.
        let raw = self
            .address
            .units
            .raw_from_rad("the target position", command.position_rad)?;
        let [a, b, c, d] = raw.to_le_bytes();
        Frame::classic(
            Pdo::First.id(Direction::Receive, self.address.node),
            &[low, high, a, b, c, d],
        )
    }

    fn hold(&self, _command: &Command) -> Result<Frame, CanError> {
        // The drive brakes on its own ramp and then stays stopped, see `set_watchdog`.
        self.encode(StateCommand::QuickStop)
    }

    fn release(&self) -> Result<Frame, CanError> {
        self.encode(StateCommand::DisableVoltage)
    }

    fn health(&mut self, frame: &Frame) -> Option<Health> {
        self.state = self.decode_state(frame)?;
        Some(match self.state {
            State::OperationEnabled => Health::Enabled,
            // This program sends no quick stop while the arm moves. The drive has therefore stopped
            // for another reason, such as its watchdog.
            State::QuickStopActive => Health::Fault("the drive made a quick stop".to_owned()),
            State::Fault | State::FaultReactionActive => {
                Health::Fault("the drive reports a fault".to_owned())
            }
            _ => Health::Off,
        })
    }
}
