//! Feetech STS and SMS servos, such as the STS3215 of the SO-100 and SO-101.
//!
//! Sources: Feetech, "Memory table of magnetic encoder STS servos"; model numbers and the encoding
//! of signs: LeRobot, `motors/feetech/tables.py`. Numbers are little endian. A negative number is
//! its absolute value with an additional sign bit.

mod packet;

pub(super) use packet::FeetechPackets;
#[cfg(feature = "emulation")]
pub(super) use packet::checksum;

use super::bus::ServoBus;
use super::packet::{PacketFormat, Status};
use super::protocol::{
    Block, COUNTS_PER_TURN, Feedback, FoundServo, LossReactions, ServoError, ServoInfo,
    ServoProtocol, bit_names, no_answer, read,
};
use crate::Error;
use crate::motion::OnLoss;

/// Registers. Lengths are in bytes.
pub(super) mod register {
    /// Firmware version (major, minor), byte order, and model (2).
    pub(crate) const FIRMWARE: u16 = 0;
    /// Minimum and maximum goal position (2 each).
    pub(crate) const LIMITS: u16 = 9;
    /// Bits that change the meaning of other registers.
    pub(crate) const PHASE: u16 = 18;
    /// Operating mode.
    pub(crate) const MODE: u16 = 33;
    /// 1 if the servo is enabled.
    pub(crate) const TORQUE: u16 = 40;
    /// Acceleration limit, 100 counts/s².
    pub(crate) const ACCELERATION: u16 = 41;
    /// Goal position (2).
    pub(crate) const GOAL: u16 = 42;
    /// Largest speed (2).
    pub(crate) const SPEED: u16 = 46;
    /// Position (2) and velocity (2).
    pub(crate) const POSITION: u16 = 56;
}

/// Names of the bits of the error byte.
const FAULTS: [(u8, &str); 5] = [
    (0, "the supply voltage is too high or too low"),
    (1, "the position sensor failed"),
    (2, "overheating"),
    (3, "overcurrent"),
    (5, "overload: the servo has reduced its torque"),
];
/// Model numbers.
const MODELS: [(u16, &str); 3] = [(777, "STS3215"), (2825, "STS3250"), (11272, "SM8512BL")];
/// Bit of the sign of positions and velocities.
const SIGN: u16 = 1 << 15;
/// Bit of the phase register: velocities are in single counts per second.
const FINE_SPEED: u8 = 1 << 2;
/// Velocity unit without this bit, counts/s: 0.732 revolutions per minute.
const COARSE_COUNTS_S: f64 = 50.0;
/// The operating mode in which a servo moves to positions.
const POSITION_MODE: u8 = 0;
/// Largest value of the acceleration register. The setpoints are smooth, so the servo must not slow
/// them down.
const MAX_ACCELERATION: u8 = 254;
/// Range of a servo whose limits are both 0: seven turns in each direction.
const MULTI_TURN_COUNTS: i32 = 7 * COUNTS_PER_TURN;
/// IDs that are searched. Each ID that does not answer takes 40 ms, so a search of all 254 IDs
/// would take 10 s. Arms have their servos numbered from 1.
const SEARCHED_IDS: std::ops::RangeInclusive<u8> = 1..=12;

/// The protocol of Feetech STS and SMS servos.
#[derive(Debug)]
pub struct FeetechProtocol;

impl ServoProtocol for FeetechProtocol {
    fn name(&self) -> &'static str {
        "feetech"
    }

    fn title(&self) -> &'static str {
        "Feetech"
    }

    fn max_id(&self) -> u8 {
        253
    }

    fn format(&self) -> &'static dyn PacketFormat {
        &FeetechPackets
    }

    fn find(&self, bus: &mut ServoBus) -> Result<Vec<FoundServo>, Error> {
        let mut found = Vec::new();
        for id in SEARCHED_IDS {
            // A broadcast would make all servos answer at once, so each ID is asked for.
            if bus.ping(id)?.is_none() {
                continue;
            }
            let version = bus.read(id, register::FIRMWARE, 5)?;
            let model = version.map_or("unknown model".to_owned(), |status| model(&status.data));
            found.push(FoundServo { id, model });
        }
        Ok(found)
    }

    fn identify(&self, bus: &mut ServoBus, id: u8) -> Result<ServoInfo, ServoError> {
        let version = read(bus, id, register::FIRMWARE, 5)?;
        // Servos with a potentiometer (SCS) store numbers with the high byte first.
        if version[2] != 0 {
            return Err(ServoError::Servo(format!(
                "the servo with ID {id} stores numbers with the high byte first, as SCS servos do: only STS and SMS servos are supported"
            )));
        }
        let limits = read(bus, id, register::LIMITS, 4)?;
        let phase = read(bus, id, register::PHASE, 1)?[0];
        let mode = read(bus, id, register::MODE, 1)?[0];
        Ok(ServoInfo {
            model: model(&version),
            range_counts: range(&limits),
            velocity_unit_counts_s: if phase & FINE_SPEED == 0 {
                COARSE_COUNTS_S
            } else {
                1.0
            },
            mode_problem: (mode != POSITION_MODE).then(|| {
                format!(
                    "its operating mode is {mode}: set it to 0 (position) with Feetech's software"
                )
            }),
        })
    }

    fn feedback_block(&self) -> Block {
        Block {
            address: register::POSITION,
            len: 4,
        }
    }

    fn feedback(&self, data: &[u8]) -> Option<Feedback> {
        let &[low, high, velocity_low, velocity_high] = data.first_chunk()?;
        Some(Feedback {
            position_counts: signed(u16::from_le_bytes([low, high])),
            velocity: signed(u16::from_le_bytes([velocity_low, velocity_high])),
        })
    }

    fn has_fault(&self, status: &Status) -> bool {
        status.error != 0
    }

    fn faults(&self, _bus: &mut ServoBus, status: &Status) -> Result<String, Error> {
        Ok(bit_names(status.error, &FAULTS))
    }

    fn loss_reactions(&self) -> LossReactions {
        LossReactions {
            by_servo: &[],
            while_running: &[OnLoss::Hold, OnLoss::Release],
            otherwise: "Feetech servos have no watchdog: they would move to their last goal position and hold it",
        }
    }

    fn prepare(
        &self,
        bus: &mut ServoBus,
        id: u8,
        info: &ServoInfo,
        max_counts_s: f64,
    ) -> Result<(), ServoError> {
        // A servo may keep a lower limit, which only makes it lag its setpoints.
        bus.write(id, register::ACCELERATION, &[MAX_ACCELERATION])?;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "the value is clamped to the range of the register"
        )]
        // A speed of 0 would mean full speed or standstill, depending on the phase register.
        let speed = (max_counts_s / info.velocity_unit_counts_s)
            .ceil()
            .clamp(1.0, f64::from(SIGN - 1)) as u16;
        // The servo may also limit the speed further.
        let contents = bus.write(id, register::SPEED, &speed.to_le_bytes())?;
        let contents = contents.ok_or_else(|| no_answer(id))?;
        let accepted = u16::from_le_bytes(contents.try_into().unwrap_or_default());
        if (1..=speed).contains(&accepted) {
            return Ok(());
        }
        Err(ServoError::Servo(format!(
            "the servo with ID {id} did not accept the speed limit {speed}: it contains {accepted}"
        )))
    }

    fn goal_address(&self) -> u16 {
        register::GOAL
    }

    fn goal(&self, counts: i32) -> Vec<u8> {
        encode(counts).to_le_bytes().to_vec()
    }

    fn torque_address(&self) -> u16 {
        register::TORQUE
    }

    fn vitals_block(&self) -> Block {
        Block {
            address: register::TORQUE,
            len: 1,
        }
    }

    fn vitals_problem(&self, data: &[u8]) -> Option<String> {
        (data.first() != Some(&1)).then(|| {
            "the servo was disabled by something else, or lost its power for a moment".to_owned()
        })
    }
}

/// Model and firmware from the registers at [`register::FIRMWARE`].
fn model(version: &[u8]) -> String {
    let &[major, minor, _, low, high] = version.first_chunk().unwrap_or(&[0; 5]);
    let number = u16::from_le_bytes([low, high]);
    let known = MODELS.iter().find(|(known, _)| *known == number);
    let name = known.map_or(format!("model {number}"), |(_, name)| (*name).to_owned());
    format!("{name}, firmware {major}.{minor}")
}

/// Range of goal positions from the registers at [`register::LIMITS`].
fn range(limits: &[u8]) -> [i32; 2] {
    let &[low, high, max_low, max_high] = limits.first_chunk().unwrap_or(&[0; 4]);
    match [
        signed(u16::from_le_bytes([low, high])),
        signed(u16::from_le_bytes([max_low, max_high])),
    ] {
        [0, 0] => [-MULTI_TURN_COUNTS, MULTI_TURN_COUNTS],
        range => range,
    }
}

/// Decodes a number with a sign bit.
pub(super) fn signed(raw: u16) -> i32 {
    let magnitude = i32::from(raw & !SIGN);
    if raw & SIGN == 0 {
        magnitude
    } else {
        -magnitude
    }
}

/// Encodes a number with a sign bit, clamped to the range of the register.
pub(super) fn encode(number: i32) -> u16 {
    let magnitude = u16::try_from(number.unsigned_abs())
        .unwrap_or(SIGN - 1)
        .min(SIGN - 1);
    if number < 0 {
        magnitude | SIGN
    } else {
        magnitude
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signs_are_in_bit_15() {
        for number in [0, 1, 2048, 4095, 30_719, -1, -600, -30_719] {
            assert_eq!(signed(encode(number)), number);
        }
        assert_eq!(encode(-5), 0x8005);
        assert_eq!(encode(-100_000), 0xFFFF, "clamped");
        let feedback = FeetechProtocol.feedback(&[0x18, 0x05, 0x64, 0x80]);
        let expected = Feedback {
            position_counts: 1304,
            velocity: -100,
        };
        assert_eq!(feedback, Some(expected));
        assert_eq!(FeetechProtocol.feedback(&[0; 3]), None);
    }

    #[test]
    fn faults_are_named() {
        assert_eq!(
            bit_names(0b10_0100, &FAULTS),
            "overheating, overload: the servo has reduced its torque"
        );
        assert_eq!(bit_names(0b1000_0000, &FAULTS), "fault 0x80");
    }

    #[test]
    fn limits_of_zero_mean_several_turns() {
        assert_eq!(range(&[0; 4]), [-28_672, 28_672]);
        assert_eq!(range(&[0, 0, 0xFF, 0x0F]), [0, 4095]);
        assert_eq!(model(&[3, 10, 0, 9, 3]), "STS3215, firmware 3.10");
    }
}
