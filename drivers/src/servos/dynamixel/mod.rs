//! Dynamixel servos of the X series, and MX servos with protocol 2.0, such as the XL330 and XL430
//! of the Koch arm, and the XM430 and XM540 of ALOHA.
//!
//! Source: ROBOTIS e-Manual, control tables of the X series; model numbers: `dynamixel_easy_sdk`.
//! Numbers are little endian. Negative numbers are in two's complement.

mod packet;

pub(super) use packet::DynamixelPackets;
#[cfg(feature = "emulation")]
pub(super) use packet::{crc, packet as encode_packet, unstuffed};

use super::bus::ServoBus;
use super::packet::{PacketFormat, Status};
use super::protocol::{
    Block, COUNTS_PER_TURN, Feedback, FoundServo, LossReactions, ServoError, ServoInfo,
    ServoProtocol, bit_names, read, write,
};
use crate::Error;
use crate::motion::OnLoss;
use std::time::Duration;

/// Registers. Lengths are in bytes.
pub(super) mod register {
    /// Model number (2).
    pub(crate) const MODEL: u16 = 0;
    /// Firmware version.
    pub(crate) const FIRMWARE: u16 = 6;
    /// Drive mode (1) and operating mode (1).
    pub(crate) const DRIVE_MODE: u16 = 10;
    /// Largest velocity (4).
    pub(crate) const VELOCITY_LIMIT: u16 = 44;
    /// Maximum (4) and minimum (4) position in position mode.
    pub(crate) const LIMITS: u16 = 48;
    /// 1 if the servo is enabled.
    pub(crate) const TORQUE: u16 = 64;
    /// Hardware errors.
    pub(crate) const HARDWARE_ERROR: u16 = 70;
    /// Bus watchdog, 20 ms.
    pub(crate) const WATCHDOG: u16 = 98;
    /// Profile acceleration (4) and velocity (4).
    pub(crate) const PROFILE: u16 = 108;
    /// Goal position (4).
    pub(crate) const GOAL: u16 = 116;
    /// Velocity (4) and position (4).
    pub(crate) const VELOCITY: u16 = 128;
}

/// Names of the bits of the hardware error register.
const FAULTS: [(u8, &str); 5] = [
    (0, "the supply voltage is too high or too low"),
    (2, "overheating"),
    (3, "the position sensor failed"),
    (4, "electrical shock, or too little power for the motor"),
    (5, "overload"),
];
/// Bit of the error byte: the hardware error register is not 0.
const ALERT: u8 = 0x80;
/// Model numbers of servos with this control table.
const MODELS: [(u16, &str); 34] = [
    (30, "MX-28"),
    (311, "MX-64"),
    (321, "MX-106"),
    (1000, "XH430-W350"),
    (1001, "XD430-T350"),
    (1010, "XH430-W210"),
    (1011, "XD430-T210"),
    (1020, "XM430-W350"),
    (1030, "XM430-W210"),
    (1040, "XH430-V350"),
    (1050, "XH430-V210"),
    (1060, "XL430-W250"),
    (1070, "XC430-W150"),
    (1080, "XC430-W240"),
    (1090, "2XL430-W250"),
    (1100, "XH540-W270"),
    (1101, "XD540-T270"),
    (1110, "XH540-W150"),
    (1111, "XD540-T150"),
    (1120, "XM540-W270"),
    (1130, "XM540-W150"),
    (1140, "XH540-V270"),
    (1150, "XH540-V150"),
    (1160, "2XC430-W250"),
    (1170, "XW540-T260"),
    (1180, "XW540-T140"),
    (1190, "XL330-M077"),
    (1200, "XL330-M288"),
    (1210, "XC330-T181"),
    (1220, "XC330-T288"),
    (1230, "XC330-M181"),
    (1240, "XC330-M288"),
    (1270, "XW430-T333"),
    (1310, "XW540-H260"),
];
/// Counts per second of a velocity of 1, which is 0.229 revolutions per minute.
const VELOCITY_UNIT_COUNTS_S: f64 = 0.229 / 60.0 * COUNTS_PER_TURN as f64;
/// Bit of the drive mode: profiles are in milliseconds.
const TIME_BASED: u8 = 1 << 2;
/// Operating modes that accept goal positions.
const POSITION_MODE: u8 = 3;
const EXTENDED_POSITION_MODE: u8 = 4;
const CURRENT_BASED_POSITION_MODE: u8 = 5;
/// Range of the modes with several turns.
const MULTI_TURN_COUNTS: i32 = 256 * COUNTS_PER_TURN;
/// Unit of the bus watchdog, ms.
const WATCHDOG_UNIT_MILLIS: u128 = 20;
const MAX_WATCHDOG: u128 = 127;
/// Value of the bus watchdog after it has expired.
const WATCHDOG_EXPIRED: u8 = 0xFF;
/// IDs that are searched. Each ID that does not answer takes 40 ms.
const SEARCHED_IDS: std::ops::RangeInclusive<u8> = 1..=12;

/// Dynamixel protocol 2.0.
#[derive(Debug)]
pub struct DynamixelProtocol;

impl ServoProtocol for DynamixelProtocol {
    fn name(&self) -> &'static str {
        "dynamixel"
    }

    fn title(&self) -> &'static str {
        "Dynamixel"
    }

    fn max_id(&self) -> u8 {
        252
    }

    fn format(&self) -> &'static dyn PacketFormat {
        &DynamixelPackets
    }

    fn find(&self, bus: &mut ServoBus) -> Result<Vec<FoundServo>, Error> {
        let mut found = Vec::new();
        for id in SEARCHED_IDS {
            if let Some(status) = bus.ping(id)? {
                let &[low, high, firmware] = status.data.first_chunk().unwrap_or(&[0; 3]);
                let number = u16::from_le_bytes([low, high]);
                let name = model(number).unwrap_or_else(|| format!("model {number}"));
                let model = format!("{name}, firmware {firmware}");
                found.push(FoundServo { id, model });
            }
        }
        Ok(found)
    }

    fn identify(&self, bus: &mut ServoBus, id: u8) -> Result<ServoInfo, ServoError> {
        let number = read(bus, id, register::MODEL, 2)?;
        let number = u16::from_le_bytes([number[0], number[1]]);
        let Some(name) = model(number) else {
            return Err(ServoError::Servo(format!(
                "the servo with ID {id} has the model number {number}: only the X series and MX servos with protocol 2.0 are supported"
            )));
        };
        let firmware = read(bus, id, register::FIRMWARE, 1)?[0];
        let mode = read(bus, id, register::DRIVE_MODE, 2)?[1];
        let limits = read(bus, id, register::LIMITS, 8)?;
        Ok(ServoInfo {
            model: format!("{name}, firmware {firmware}"),
            range_counts: if mode == POSITION_MODE {
                [number_at(&limits, 4), number_at(&limits, 0)]
            } else {
                [-MULTI_TURN_COUNTS, MULTI_TURN_COUNTS]
            },
            velocity_unit_counts_s: VELOCITY_UNIT_COUNTS_S,
            mode_problem: mode_problem(mode),
        })
    }

    fn has_fast_reads(&self) -> bool {
        true
    }

    fn feedback_block(&self) -> Block {
        Block {
            address: register::VELOCITY,
            len: 8,
        }
    }

    fn feedback(&self, data: &[u8]) -> Option<Feedback> {
        (data.len() >= 8).then(|| Feedback {
            velocity: number_at(data, 0),
            position_counts: number_at(data, 4),
        })
    }

    fn has_fault(&self, status: &Status) -> bool {
        status.error & ALERT != 0
    }

    fn faults(&self, bus: &mut ServoBus, status: &Status) -> Result<String, Error> {
        let bits = bus.read(status.id, register::HARDWARE_ERROR, 1)?;
        Ok(match bits.and_then(|status| status.data.first().copied()) {
            Some(bits) => format!(
                "{}; restart the servo to clear it",
                bit_names(bits, &FAULTS)
            ),
            None => "a hardware error".to_owned(),
        })
    }

    fn loss_reactions(&self) -> LossReactions {
        LossReactions {
            by_servo: &[OnLoss::Hold],
            while_running: &[OnLoss::Release],
            otherwise: "the watchdog of Dynamixel servos can only hold",
        }
    }

    fn prepare(
        &self,
        bus: &mut ServoBus,
        id: u8,
        info: &ServoInfo,
        max_counts_s: f64,
    ) -> Result<(), ServoError> {
        // After the watchdog has expired, goals are refused until it is set to 0.
        self.set_watchdog(bus, id, None)?;
        // A velocity above this limit is refused.
        let limit = number_at(&read(bus, id, register::VELOCITY_LIMIT, 4)?, 0).max(1);
        let is_time_based = read(bus, id, register::DRIVE_MODE, 1)?[0] & TIME_BASED != 0;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "the value is clamped to the range of the register"
        )]
        // A profile velocity of 0 would not limit the speed. In a profile in milliseconds, only 0
        // lets the servo follow setpoints without a delay.
        let velocity = if is_time_based {
            0
        } else {
            (max_counts_s / info.velocity_unit_counts_s)
                .ceil()
                .clamp(1.0, f64::from(limit)) as u32
        };
        // An acceleration of 0 does not limit the setpoints, which are smooth.
        let profile = [0_u32.to_le_bytes(), velocity.to_le_bytes()].concat();
        write(bus, id, register::PROFILE, &profile)
    }

    fn goal_address(&self) -> u16 {
        register::GOAL
    }

    fn goal(&self, counts: i32) -> Vec<u8> {
        counts.to_le_bytes().to_vec()
    }

    fn torque_address(&self) -> u16 {
        register::TORQUE
    }

    fn watchdog_address(&self) -> Option<u16> {
        Some(register::WATCHDOG)
    }

    fn set_watchdog(
        &self,
        bus: &mut ServoBus,
        id: u8,
        timeout: Option<Duration>,
    ) -> Result<(), ServoError> {
        let units = timeout.map_or(0, |timeout| {
            // It is rounded up, so that the watchdog does not expire before the timeout.
            timeout
                .as_millis()
                .div_ceil(WATCHDOG_UNIT_MILLIS)
                .clamp(1, MAX_WATCHDOG)
        });
        let value = u8::try_from(units).unwrap_or(u8::MAX >> 1);
        write(bus, id, register::WATCHDOG, &[value])
    }

    fn vitals_block(&self) -> Block {
        Block {
            address: register::TORQUE,
            len: register::WATCHDOG - register::TORQUE + 1,
        }
    }

    fn vitals_problem(&self, data: &[u8]) -> Option<String> {
        let at = |register: u16| data.get(usize::from(register - register::TORQUE)).copied();
        let problem = match (at(register::TORQUE)?, at(register::WATCHDOG)?) {
            (1, WATCHDOG_EXPIRED) => "its watchdog expired: it received no instruction in time",
            (1, _) => return None,
            _ => "the servo was disabled by something else, or lost its power for a moment",
        };
        Some(problem.to_owned())
    }
}

/// Name of a supported model.
fn model(number: u16) -> Option<String> {
    let known = MODELS.iter().find(|(known, _)| *known == number);
    known.map(|(_, name)| (*name).to_owned())
}

/// Why a servo in this operating mode cannot be moved to positions.
fn mode_problem(mode: u8) -> Option<String> {
    let is_suitable = [
        POSITION_MODE,
        EXTENDED_POSITION_MODE,
        CURRENT_BASED_POSITION_MODE,
    ]
    .contains(&mode);
    (!is_suitable).then(|| {
        format!(
            "its operating mode is {mode}: set it to 3, 4 or 5 (position) with Dynamixel Wizard"
        )
    })
}

/// The number of four bytes at an offset; 0 if there are too few bytes.
fn number_at(data: &[u8], offset: usize) -> i32 {
    let bytes = data.get(offset..).and_then(|rest| rest.first_chunk());
    i32::from_le_bytes(bytes.copied().unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn velocity_and_position_are_read_together() {
        let data = [(-10_i32).to_le_bytes(), 5000_i32.to_le_bytes()].concat();
        let expected = Feedback {
            position_counts: 5000,
            velocity: -10,
        };
        assert_eq!(DynamixelProtocol.feedback(&data), Some(expected));
        assert_eq!(DynamixelProtocol.feedback(&data[1..]), None);
    }

    #[test]
    fn expired_watchdog_and_disabled_servo_are_reported() {
        let mut data = [0; 35];
        data[0] = 1;
        assert_eq!(DynamixelProtocol.vitals_problem(&data), None);
        data[34] = WATCHDOG_EXPIRED;
        let problem = DynamixelProtocol.vitals_problem(&data).expect("expired");
        assert!(problem.contains("watchdog expired"), "{problem}");
        data[0] = 0;
        let problem = DynamixelProtocol.vitals_problem(&data).expect("disabled");
        assert!(problem.contains("disabled"), "{problem}");
    }
}
