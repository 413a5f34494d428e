//! CiA 402 drives: CANopen nodes that send a PDO with position and velocity on each SYNC.
//!
//! Watchdog: consumer heartbeat (`0x1016`) with abort connection option code (`0x6007`). The
//! reaction is either a quick stop after which the drive stays stopped (`0x605A` = 6), or voltage
//! off. Source: CiA 301, section 7.5.2.20; CiA 402-2, objects 6007h and 605Ah. The reaction of the
//! drive to its own faults (`0x605E`) is left unchanged.

pub mod codec;
#[cfg(feature = "emulation")]
mod emulated;
#[cfg(any(test, fuzzing))]
mod fuzz;
mod motion;
mod setup;

pub use codec::Units;

use super::family::{
    MotionProtocol, MotorFamily, MotorProtocol, MotorReading, Reports, Traffic, UNLIMITED,
    frame_of_8_bytes, short_frame,
};
use super::query::MotorQuery;
use super::settings::{AllowedValues, MotorKey, MotorSettings, SettingValue};
use super::watchdog::Watchdog;
use crate::Error;
use crate::motion::OnLoss;
use crate::wire::can::Frame;
use crate::wire::can::canopen::{self, Direction, Node, Pdo};
use crate::wire::can::mit::Limits;
use std::ops::RangeInclusive;
use std::sync::Arc;

/// Heartbeat interval to which a drive is set, milliseconds. The first heartbeat proves that the
/// drive is operational, so a longer interval would slow the set-up of each drive. A shorter
/// interval would take bandwidth from the cycle.
const HEARTBEAT_MILLIS: i64 = 500;
const COUNTS_PER_TURN: &str = "counts_per_turn";
const RATED_TORQUE_NM: &str = "rated_torque_nm";

/// The family.
#[derive(Debug)]
pub struct Cia402Family;

impl MotorFamily for Cia402Family {
    fn name(&self) -> &'static str {
        "cia402"
    }

    fn title(&self) -> &'static str {
        "CiA 402"
    }

    fn ids(&self) -> RangeInclusive<u64> {
        1..=127
    }

    fn keys(&self) -> Vec<MotorKey> {
        vec![
            MotorKey {
                name: COUNTS_PER_TURN,
                allowed: AllowedValues::Number(1.0..=1e12),
                required: Some("position counts of the drive per turn of its encoder"),
            },
            MotorKey {
                name: RATED_TORQUE_NM,
                allowed: AllowedValues::Number(0.0..=1e6),
                required: None,
            },
        ]
    }

    fn has_gains(&self) -> bool {
        false
    }

    fn motor(&self, settings: &MotorSettings) -> Option<Arc<dyn MotorProtocol>> {
        let node = Node::new(u8::try_from(settings.id).ok()?).ok()?;
        let counts_per_turn = settings.number(COUNTS_PER_TURN)?;
        // Torques are optional, because positions can be read without them.
        let rated_torque_nm = settings.number(RATED_TORQUE_NM).unwrap_or(0.0);
        Some(Arc::new(Cia402 {
            node,
            units: Units {
                counts_per_turn,
                rated_torque_nm,
            },
        }))
    }

    /// Any CANopen node with a heartbeat may be a drive.
    fn identify(&self, frame: &Frame) -> Option<MotorSettings> {
        let (node, _) = canopen::decode_heartbeat(frame).ok()?;
        Some(MotorSettings::new(node.number()))
    }

    #[cfg(any(test, fuzzing))]
    fn fuzzing(&self) -> super::family::FamilyFuzzing {
        fuzz::fuzzing()
    }
}

/// A CiA 402 drive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cia402 {
    /// Node ID.
    pub node: Node,
    /// Units of its raw values.
    pub units: Units,
}

impl Cia402 {
    fn limits(self) -> Limits {
        Limits {
            // A target whose count exceeds 32 bits cannot be encoded.
            position_rad: self.units.rad_from_raw(i32::MAX),
            ..UNLIMITED
        }
    }
}

impl MotorProtocol for Cia402 {
    fn family(&self) -> &'static dyn MotorFamily {
        &Cia402Family
    }

    fn settings(&self) -> MotorSettings {
        MotorSettings::new(self.node.number())
            .with(
                COUNTS_PER_TURN,
                SettingValue::Number(self.units.counts_per_turn),
            )
            .with(
                RATED_TORQUE_NM,
                SettingValue::Number(self.units.rated_torque_nm),
            )
    }

    fn addresses(&self) -> Vec<u32> {
        vec![self.node.number().into()]
    }

    fn ranges(&self) -> Option<Limits> {
        Some(self.limits())
    }

    fn canopen_node(&self) -> Option<Node> {
        Some(self.node)
    }

    /// Makes the drive send position and velocity at every SYNC, and starts it. The drive stays
    /// disabled.
    fn set_up(&self, query: &MotorQuery<'_>) -> Result<Limits, Error> {
        // Two objects of four bytes fill one PDO, so one frame per SYNC reports the motion.
        let objects = [codec::POSITION, codec::VELOCITY];
        let mut entries =
            setup::map_pdo_at_every_sync(Pdo::First, Direction::Transmit, self.node, &objects);
        entries.push((canopen::PRODUCER_HEARTBEAT, HEARTBEAT_MILLIS));
        setup::start_drive(query, self.node, &entries)?;
        Ok(self.limits())
    }

    fn reports(&self) -> Reports {
        Reports::WhenPolled
    }

    fn typical_answer(&self) -> (Frame, Option<f64>) {
        (
            frame_of_8_bytes(Pdo::First.id(Direction::Transmit, self.node)),
            None,
        )
    }

    fn read(&self, frame: &Frame, _limits: &Limits) -> Option<MotorReading> {
        if frame.id() != Pdo::First.id(Direction::Transmit, self.node) || frame.is_remote() {
            return None;
        }
        let [a, b, c, d, e, f, g, h] = *<&[u8; 8]>::try_from(frame.data()).ok()?;
        let [position, velocity] = [[a, b, c, d], [e, f, g, h]].map(i32::from_le_bytes);
        Some(MotorReading {
            position_rad: self.units.rad_from_raw(position),
            velocity_rad_s: self.units.rad_from_raw(velocity),
            torque_nm: None,
        })
    }

    /// Frames with target, position and state.
    fn traffic(&self) -> Traffic {
        Traffic {
            cycle_frames: vec![short_frame(); 3],
            unsolicited: vec![],
        }
    }

    fn watchdog(&self) -> Watchdog {
        Watchdog::Available(&[OnLoss::Hold, OnLoss::Release])
    }

    fn motion(&self, _limits: &Limits) -> Box<dyn MotionProtocol> {
        Box::new(motion::Cia402Motion {
            address: *self,
            // Until the drive reports its state, its commands must not enable it.
            state: codec::State::NotReadyToSwitchOn,
        })
    }

    #[cfg(feature = "emulation")]
    fn emulated(&self) -> Box<dyn super::emulated::EmulatedProtocol> {
        Box::new(emulated::EmulatedCia402::new(*self))
    }
}
