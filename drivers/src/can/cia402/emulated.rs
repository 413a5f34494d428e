//! An emulated CiA 402 drive with cyclic synchronous position mode.

use super::Cia402;
use super::codec::{self, StateCommand};
use crate::can::emulated::{Actuation, EmulatedDrive, EmulatedProtocol, State};
use crate::wire::can::canopen::{self, CONSUMER_HEARTBEAT, Direction, NodeState, Object, Pdo};
use crate::wire::can::mit::Command;
use crate::wire::can::{CanError, Frame, Id};
use std::time::Duration;

/// Value of [`codec::SUPPORTED_MODES`]: profile position and the three cyclic modes.
const SUPPORTED_MODES_MASK: u32 = 0b11_1000_0001;

/// Key of an object in the settings.
fn number(index: u16, subindex: u8) -> u32 {
    u32::from(index) << 8 | u32::from(subindex)
}

/// Decodes the command in a controlword; `None` if its bits form no command. Source: CiA 402-2,
/// table of the controlword.
fn decode_controlword(controlword: u16, before: u16) -> Option<StateCommand> {
    // A reset is a rising edge of bit 7, so a controlword that is repeated in each cycle resets a
    // fault only once.
    if controlword & !before & 0x80 != 0 {
        return Some(StateCommand::ResetFault);
    }
    // The masks exclude the "don't care" bits of the table. Disabling and the quick stop ignore
    // most bits, so they work regardless of earlier commands.
    match controlword & 0x8F {
        word if word & 0x82 == 0 => Some(StateCommand::DisableVoltage),
        word if word & 0x86 == 0x02 => Some(StateCommand::QuickStop),
        word if word & 0x87 == 0x06 => Some(StateCommand::Shutdown),
        0x07 => Some(StateCommand::SwitchOn),
        0x0F => Some(StateCommand::EnableOperation),
        _ => None,
    }
}

/// Value that was written to an object.
fn written(drive: &EmulatedDrive, object: Object) -> Option<u32> {
    drive.setting(number(object.index, object.subindex))
}

#[derive(Debug)]
pub(super) struct EmulatedCia402 {
    address: Cia402,
    node_state: NodeState,
    state: codec::State,
    /// Controlword and target that take effect at the next SYNC.
    pending_command: Option<(u16, i32)>,
    last_controlword: u16,
}

impl EmulatedProtocol for EmulatedCia402 {
    fn take(&mut self, frame: &Frame, drive: &mut EmulatedDrive) -> Result<Vec<Frame>, CanError> {
        if frame.is_remote() || frame.id().is_extended() {
            return Ok(Vec::new());
        }
        let node = self.address.node;
        // Identifiers of the predefined connection set of CiA 301: 0 is NMT, 0x80 SYNC, 0x580 and
        // 0x600 SDO answers and requests, 0x700 heartbeats.
        let sdo = 0x600 + u32::from(node.number());
        let watched_node = written(drive, CONSUMER_HEARTBEAT).map_or(0, |entry| entry >> 16 & 0x7F);
        match (frame.id().value(), frame.data()) {
            (0, &[state_command, to]) if to == 0 || to == node.number() => {
                self.node_state = match state_command {
                    0x01 => NodeState::Operational,
                    0x02 => NodeState::Stopped,
                    0x80 => NodeState::PreOperational,
                    _ => NodeState::BootUp,
                };
                Ok(Vec::new())
            }
            // Outside the operational state, PDOs are neither sent nor accepted.
            (0x80, &[]) if self.node_state == NodeState::Operational => self.synchronous(drive),
            (id, &[_]) if watched_node > 0 && id == 0x700 + watched_node => {
                drive.reset_watchdog();
                Ok(Vec::new())
            }
            (id, &[low, high, a, b, c, d])
                if id == Pdo::First.id(Direction::Receive, node).value() =>
            {
                // The command takes effect at the next SYNC, as for all drives of the bus.
                if self.node_state == NodeState::Operational && self.accepts_targets(drive) {
                    self.pending_command = Some((
                        u16::from_le_bytes([low, high]),
                        i32::from_le_bytes([a, b, c, d]),
                    ));
                }
                Ok(Vec::new())
            }
            (id, &[command, low, high, subindex, a, b, c, d]) if id == sdo => {
                self.answer_sdo([command, low, high, subindex, a, b, c, d], drive)
            }
            _ => Ok(Vec::new()),
        }
    }

    fn heartbeat(&self, _drive: &EmulatedDrive) -> Result<Option<Frame>, CanError> {
        Ok(Some(canopen::encode_heartbeat(
            self.address.node,
            self.node_state,
        )))
    }

    fn timeout(&self, drive: &EmulatedDrive) -> Option<Duration> {
        // The lower half of the entry is the time, the upper half the node. A time of 0 disables
        // the consumer.
        let millis = written(drive, CONSUMER_HEARTBEAT)? & 0xFFFF;
        (millis > 0).then(|| Duration::from_millis(millis.into()))
    }

    /// Reaction of an enabled drive to a missing heartbeat.
    fn time_out(&mut self, drive: &mut EmulatedDrive) {
        if drive.state() != State::Enabled {
            return;
        }
        match written(drive, codec::ABORT_CONNECTION) {
            // See `codec::ABORT_CONNECTION` for the numbers. Without a setting, the drive
            // continues.
            Some(1) => self.change_state(codec::State::Fault, drive),
            Some(2) => self.change_state(codec::State::SwitchOnDisabled, drive),
            Some(3) => self.change_state(codec::State::QuickStopActive, drive),
            _ => {}
        }
    }

    fn fail(&mut self, _drive: &mut EmulatedDrive) {
        self.state = codec::State::Fault;
    }
}

impl EmulatedCia402 {
    /// Creates a drive that has just started.
    pub(super) fn new(address: Cia402) -> Self {
        Self {
            address,
            node_state: NodeState::PreOperational,
            state: codec::State::SwitchOnDisabled,
            pending_command: None,
            last_controlword: 0,
        }
    }

    /// Executes a request to read or write an object, and returns the answer.
    fn answer_sdo(
        &mut self,
        [command, low, high, subindex, a, b, c, d]: [u8; 8],
        drive: &mut EmulatedDrive,
    ) -> Result<Vec<Frame>, CanError> {
        let index = u16::from_le_bytes([low, high]);
        // The upper three bits are the command specifier: 1 starts a write, 2 a read.
        let answer = match command >> 5 {
            1 => {
                let value = u32::from_le_bytes([a, b, c, d]);
                let is_timeout = index == CONSUMER_HEARTBEAT.index;
                drive.set(number(index, subindex), value, is_timeout);
                if index == codec::CONTROLWORD.index {
                    // A controlword by SDO takes effect at once, without a SYNC.
                    self.state_command(u16::from_le_bytes([a, b]), None, drive);
                }
                [0x60, low, high, subindex, 0, 0, 0, 0]
            }
            2 => {
                let [a, b, c, d] = self.reply(index, subindex, drive).to_le_bytes();
                [0x43, low, high, subindex, a, b, c, d]
            }
            _ => return Ok(Vec::new()),
        };
        let id = Id::standard(0x580 + u32::from(self.address.node.number()))?;
        Ok(vec![Frame::classic(id, &answer)?])
    }

    /// Value of an object.
    fn reply(&self, index: u16, subindex: u8, drive: &EmulatedDrive) -> u32 {
        let is_object = |object: Object| object.index == index;
        if is_object(codec::STATUSWORD) {
            self.state.statusword().into()
        } else if is_object(codec::SUPPORTED_MODES) {
            SUPPORTED_MODES_MASK
        } else if is_object(codec::MODE_DISPLAY) {
            written(drive, codec::MODE).unwrap_or(0)
        } else {
            drive.setting(number(index, subindex)).unwrap_or(0)
        }
    }

    /// Whether the first PDO delivers controlword and target at every SYNC.
    fn accepts_targets(&self, drive: &EmulatedDrive) -> bool {
        let mapped =
            [codec::CONTROLWORD, codec::TARGET_POSITION].map(|object| Some(object.mapped()));
        let entries =
            [1, 2].map(|entry| written(drive, Pdo::First.mapping(Direction::Receive, entry)));
        self.is_on(Pdo::First, Direction::Receive, drive) && entries == mapped
    }

    fn is_on(&self, pdo: Pdo, direction: Direction, drive: &EmulatedDrive) -> bool {
        written(drive, pdo.communication(direction, 1))
            == Some(pdo.id(direction, self.address.node).value())
            && written(drive, pdo.communication(direction, 2)) == Some(1)
    }

    /// Applies a controlword, and a target if the drive is enabled in cyclic position mode.
    fn state_command(
        &mut self,
        controlword: u16,
        target: Option<Command>,
        drive: &mut EmulatedDrive,
    ) {
        if let Some(state_command) = decode_controlword(controlword, self.last_controlword) {
            self.change_state(self.state.after(state_command), drive);
        }
        self.last_controlword = controlword;
        let is_cyclic = written(drive, codec::MODE) == Some(codec::Mode::CyclicPosition as u32);
        if let Some(target) = target.filter(|_| is_cyclic && drive.state() == State::Enabled) {
            drive.actuation = Actuation::Follow(target);
            drive.target = Some(target);
        }
    }

    fn change_state(&mut self, state: codec::State, drive: &mut EmulatedDrive) {
        if state == self.state {
            return;
        }
        self.state = state;
        drive.actuation = match state {
            codec::State::OperationEnabled => {
                // A drive holds its position when it is enabled, until the first target arrives.
                let position_rad = drive.motion().position_rad;
                Actuation::Follow(Command {
                    position_rad,
                    ..Command::default()
                })
            }
            codec::State::QuickStopActive => match written(drive, codec::QUICK_STOP_OPTION) {
                // With these values, the drive stays in the state. With all others, it releases the
                // shaft.
                Some(5..=7) => Actuation::Stop,
                _ => {
                    self.state = codec::State::SwitchOnDisabled;
                    Actuation::Free
                }
            },
            _ => Actuation::Free,
        };
    }

    /// Applies pending commands, and sends the mapped PDOs that are enabled for every SYNC.
    fn synchronous(&mut self, drive: &mut EmulatedDrive) -> Result<Vec<Frame>, CanError> {
        if let Some((controlword, target)) = self.pending_command.take() {
            let position_rad = self.address.units.rad_from_raw(target);
            self.state_command(
                controlword,
                Some(Command {
                    position_rad,
                    ..Command::default()
                }),
                drive,
            );
        }
        let mut sent = Vec::new();
        for pdo in [Pdo::First, Pdo::Second] {
            if self.is_on(pdo, Direction::Transmit, drive) {
                sent.push(self.transmit(pdo, drive)?);
            }
        }
        Ok(sent)
    }

    fn transmit(&self, pdo: Pdo, drive: &EmulatedDrive) -> Result<Frame, CanError> {
        let Cia402 { node, units } = self.address;
        let n = written(drive, pdo.mapping(Direction::Transmit, 0)).unwrap_or(0);
        let mut bytes = Vec::new();
        for entry in 1..=u8::try_from(n).unwrap_or(8) {
            let mapped = written(drive, pdo.mapping(Direction::Transmit, entry)).unwrap_or(0);
            let mapped = Object::from_mapped(mapped)?;
            let motion = drive.motion();
            let value = match mapped {
                codec::POSITION => units.raw_from_rad("the position", motion.position_rad)?,
                codec::VELOCITY => units.raw_from_rad("the velocity", motion.velocity_rad_s)?,
                codec::STATUSWORD => self.state.statusword().into(),
                _ => 0,
            };
            bytes.extend_from_slice(&value.to_le_bytes()[..usize::from(mapped.n_bytes)]);
        }
        Frame::classic(pdo.id(Direction::Transmit, node), &bytes)
    }
}
