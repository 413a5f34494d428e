//! An emulated CiA 402 drive with cyclic synchronous position mode.

use super::shaft::Actuation;
use super::{EmulatedMotor, State};
use crate::wire::can::canopen::{self, CONSUMER_HEARTBEAT, Direction, Node, NodeState, Object, Pdo};
use crate::wire::can::cia402::{self, StateCommand, Units};
use crate::wire::can::mit::Command;
use crate::wire::can::{CanError, Frame, Id};
use std::time::Duration;

/// Value of [`cia402::SUPPORTED_MODES`]: profile position and the three cyclic modes.
const SUPPORTED_MODES_MASK: u32 = 0b11_1000_0001;

/// Key of an object in the settings.
fn number(index: u16, subindex: u8) -> u32 {
    u32::from(index) << 8 | u32::from(subindex)
}

/// Command of a controlword; `None` if its bits are no command. Source: CiA 402-2, table of the controlword.
fn decode_controlword(controlword: u16, before: u16) -> Option<StateCommand> {
    if controlword & !before & 0x80 != 0 {
        return Some(StateCommand::ResetFault);
    }
    match controlword & 0x8F {
        word if word & 0x82 == 0 => Some(StateCommand::DisableVoltage),
        word if word & 0x86 == 0x02 => Some(StateCommand::QuickStop),
        word if word & 0x87 == 0x06 => Some(StateCommand::Shutdown),
        0x07 => Some(StateCommand::SwitchOn),
        0x0F => Some(StateCommand::EnableOperation),
        _ => None,
    }
}

impl EmulatedMotor {
    fn object(&self, object: Object) -> Option<u32> {
        self.setting(number(object.index, object.subindex))
    }

    pub(super) fn handle_drive(&mut self, frame: &Frame, node: Node, units: Units) -> Result<Vec<Frame>, CanError> {
        if frame.is_remote() || frame.id().is_extended() {
            return Ok(Vec::new());
        }
        let sdo = 0x600 + u32::from(node.number());
        let watched_node = self.object(CONSUMER_HEARTBEAT).map_or(0, |entry| entry >> 16 & 0x7F);
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
            (0x80, &[]) if self.node_state == NodeState::Operational => self.synchronous(node, units),
            (id, &[_]) if watched_node > 0 && id == 0x700 + watched_node => {
                self.reset_watchdog();
                Ok(Vec::new())
            }
            (id, &[low, high, a, b, c, d]) if id == Pdo::First.id(Direction::Receive, node).value() => {
                if self.node_state == NodeState::Operational && self.accepts_targets(node) {
                    self.pending_command = Some((u16::from_le_bytes([low, high]), i32::from_le_bytes([a, b, c, d])));
                }
                Ok(Vec::new())
            }
            (id, &[command, low, high, subindex, a, b, c, d]) if id == sdo => {
                let index = u16::from_le_bytes([low, high]);
                let answer = match command >> 5 {
                    1 => {
                        let value = u32::from_le_bytes([a, b, c, d]);
                        let is_timeout = index == CONSUMER_HEARTBEAT.index;
                        self.set(number(index, subindex), value, is_timeout);
                        if index == cia402::CONTROLWORD.index {
                            self.state_command(u16::from_le_bytes([a, b]), None);
                        }
                        [0x60, low, high, subindex, 0, 0, 0, 0]
                    }
                    2 => {
                        let [a, b, c, d] = self.reply(index, subindex).to_le_bytes();
                        [0x43, low, high, subindex, a, b, c, d]
                    }
                    _ => return Ok(Vec::new()),
                };
                Ok(vec![Frame::classic(Id::standard(0x580 + u32::from(node.number()))?, &answer)?])
            }
            _ => Ok(Vec::new()),
        }
    }

    /// Value of an object.
    fn reply(&self, index: u16, subindex: u8) -> u32 {
        let is_object = |object: Object| object.index == index;
        if is_object(cia402::STATUSWORD) {
            self.drive_state.statusword().into()
        } else if is_object(cia402::SUPPORTED_MODES) {
            SUPPORTED_MODES_MASK
        } else if is_object(cia402::MODE_DISPLAY) {
            self.object(cia402::MODE).unwrap_or(0)
        } else {
            self.setting(number(index, subindex)).unwrap_or(0)
        }
    }

    /// Whether the first PDO delivers controlword and target at every SYNC.
    fn accepts_targets(&self, node: Node) -> bool {
        let mapped = [cia402::CONTROLWORD, cia402::TARGET_POSITION].map(|object| Some(object.mapped()));
        let entries = [1, 2].map(|entry| self.object(Pdo::First.mapping(Direction::Receive, entry)));
        self.is_on(Pdo::First, Direction::Receive, node) && entries == mapped
    }

    fn is_on(&self, pdo: Pdo, direction: Direction, node: Node) -> bool {
        self.object(pdo.communication(direction, 1)) == Some(pdo.id(direction, node).value())
            && self.object(pdo.communication(direction, 2)) == Some(1)
    }

    /// Applies a controlword, and a target if the drive is enabled in cyclic position mode.
    fn state_command(&mut self, controlword: u16, target: Option<Command>) {
        if let Some(state_command) = decode_controlword(controlword, self.last_controlword) {
            self.change_state(self.drive_state.after(state_command));
        }
        self.last_controlword = controlword;
        let is_cyclic = self.object(cia402::MODE) == Some(cia402::Mode::CyclicPosition as u32);
        if let Some(target) = target.filter(|_| is_cyclic && self.state() == State::Enabled) {
            self.actuation = Actuation::Follow(target);
            self.target = Some(target);
        }
    }

    fn change_state(&mut self, state: cia402::State) {
        if state == self.drive_state {
            return;
        }
        self.drive_state = state;
        self.actuation = match state {
            cia402::State::OperationEnabled => {
                let position_rad = self.shaft.motion.position_rad;
                Actuation::Follow(Command { position_rad, ..Command::default() })
            }
            cia402::State::QuickStopActive => match self.object(cia402::QUICK_STOP_OPTION) {
                Some(5..=7) => Actuation::Stop,
                _ => {
                    self.drive_state = cia402::State::SwitchOnDisabled;
                    Actuation::Free
                }
            },
            _ => Actuation::Free,
        };
    }

    /// Reaction of an enabled drive to a missing heartbeat.
    pub(super) fn time_out_drive(&mut self) {
        if self.state() != State::Enabled {
            return;
        }
        match self.object(cia402::ABORT_CONNECTION) {
            Some(1) => self.change_state(cia402::State::Fault),
            Some(2) => self.change_state(cia402::State::SwitchOnDisabled),
            Some(3) => self.change_state(cia402::State::QuickStopActive),
            _ => {}
        }
    }

    pub(super) fn drive_timeout(&self) -> Option<Duration> {
        let millis = self.object(CONSUMER_HEARTBEAT)? & 0xFFFF;
        (millis > 0).then(|| Duration::from_millis(millis.into()))
    }

    pub(super) fn drive_heartbeat(&self, node: Node) -> Frame {
        canopen::encode_heartbeat(node, self.node_state)
    }

    /// Applies pending commands, and sends the mapped PDOs that are enabled for every SYNC.
    fn synchronous(&mut self, node: Node, units: Units) -> Result<Vec<Frame>, CanError> {
        if let Some((controlword, target)) = self.pending_command.take() {
            let position_rad = units.rad_from_raw(target);
            self.state_command(controlword, Some(Command { position_rad, ..Command::default() }));
        }
        let mut sent = Vec::new();
        for pdo in [Pdo::First, Pdo::Second] {
            if self.is_on(pdo, Direction::Transmit, node) {
                sent.push(self.transmit(pdo, node, units)?);
            }
        }
        Ok(sent)
    }

    fn transmit(&self, pdo: Pdo, node: Node, units: Units) -> Result<Frame, CanError> {
        let n = self.object(pdo.mapping(Direction::Transmit, 0)).unwrap_or(0);
        let mut bytes = Vec::new();
        for entry in 1..=u8::try_from(n).unwrap_or(8) {
            let mapped = self.object(pdo.mapping(Direction::Transmit, entry)).unwrap_or(0);
            let mapped = Object::from_mapped(mapped)?;
            let motion = self.shaft.motion;
            let value = match mapped {
                cia402::POSITION => units.raw_from_rad("the position", motion.position_rad)?,
                cia402::VELOCITY => units.raw_from_rad("the velocity", motion.velocity_rad_s)?,
                cia402::STATUSWORD => self.drive_state.statusword().into(),
                _ => 0,
            };
            bytes.extend_from_slice(&value.to_le_bytes()[..usize::from(mapped.n_bytes)]);
        }
        Frame::classic(pdo.id(Direction::Transmit, node), &bytes)
    }
}
