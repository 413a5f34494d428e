//! Damiao (DM) motors: state commands, MIT commands, feedback, registers.
//!
//! Sources: `cmjang/DM_Control_Python` `DM_CAN.py` (frames, register numbers and types, limits of
//! the models); Damiao DM-J4310-2EC manual V1.0, as described in `jia-xie/python-damiao-driver`
//! `docs/concept/` (status nibble, clearing errors, registers, TIMEOUT in ticks of 50 us). Commands
//! have the motor's ID as their CAN ID; register and refresh requests have `0x7FF`. All answers
//! have the motor's feedback ID (register `MST_ID`).

use crate::wire::can::mit::{self, Command, Limits, Motion};
use crate::wire::can::{CanError, Frame, Id, decode_enum, eight_bytes};

/// CAN ID of register messages.
const REGISTER_ID: u32 = 0x7FF;
/// Length of a tick of register `TIMEOUT`, seconds.
const TIMEOUT_TICK_SECS: f64 = 50e-6;
/// Value of [`Register::ControlMode`] for MIT mode.
pub const MIT_MODE: u32 = 1;
/// Name that errors use for feedback.
const FEEDBACK: &str = "feedback of a Damiao motor";
const REGISTER: &str = "register message of a Damiao motor";

/// A model with known factory limits. The actual limits are in the registers `PMAX`, `VMAX` and
/// `TMAX`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "the names are those on the motors")]
pub enum Model {
    Dm4310,
    Dm4310At48V,
    Dm4340,
    Dm4340At48V,
    Dm6006,
    Dm8006,
    Dm8009,
    Dm10010L,
    Dm10010,
    DmH3510,
    DmG6215,
    DmH6220,
}

impl Model {
    /// Ranges of the raw values of a motor with factory settings.
    pub const fn limits(self) -> Limits {
        match self {
            Self::Dm4310 => Limits::of(12.5, 30.0, 10.0),
            Self::Dm4310At48V => Limits::of(12.5, 50.0, 10.0),
            Self::Dm4340 => Limits::of(12.5, 8.0, 28.0),
            Self::Dm4340At48V => Limits::of(12.5, 10.0, 28.0),
            Self::Dm6006 => Limits::of(12.5, 45.0, 20.0),
            Self::Dm8006 => Limits::of(12.5, 45.0, 40.0),
            Self::Dm8009 => Limits::of(12.5, 45.0, 54.0),
            Self::Dm10010L => Limits::of(12.5, 25.0, 200.0),
            Self::Dm10010 => Limits::of(12.5, 20.0, 200.0),
            Self::DmH3510 => Limits::of(12.5, 280.0, 1.0),
            Self::DmG6215 | Self::DmH6220 => Limits::of(12.5, 45.0, 10.0),
        }
    }
}

/// A state command. Its frame consists of seven bytes `FF` and this byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum StateCommand {
    /// Clear the error that stopped the motor.
    ClearError = 0xFB,
    /// Enable the motor.
    Enable = 0xFC,
    /// Disable the motor. The shaft is then free.
    Disable = 0xFD,
    /// Set the current position as zero.
    SetZero = 0xFE,
}

/// Status in the upper half of a feedback's first byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Status {
    /// The shaft is free.
    Disabled = 0x0,
    /// The motor follows commands.
    Enabled = 0x1,
    /// Stopped: supply voltage too high.
    OverVoltage = 0x8,
    /// Stopped: supply voltage too low.
    UnderVoltage = 0x9,
    /// Stopped: overcurrent.
    OverCurrent = 0xA,
    /// Stopped: the drive is too hot.
    DriveOverTemperature = 0xB,
    /// Stopped: the windings are too hot.
    RotorOverTemperature = 0xC,
    /// Stopped: no command for longer than register `TIMEOUT`.
    LostCommunication = 0xD,
    /// Stopped: overloaded.
    Overload = 0xE,
}

impl Status {
    const ALL: [Self; 9] = [
        Self::Disabled,
        Self::Enabled,
        Self::OverVoltage,
        Self::UnderVoltage,
        Self::OverCurrent,
        Self::DriveOverTemperature,
        Self::RotorOverTemperature,
        Self::LostCommunication,
        Self::Overload,
    ];
}

/// Answer of a motor to every command, state command and refresh request.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Feedback {
    /// The lower four bits of the motor's ID.
    pub motor_low: u8,
    /// Status of the motor.
    pub status: Status,
    /// Measured motion.
    pub motion: Motion,
    /// Temperature of the power stage, whole degrees Celsius.
    pub drive_celsius: u8,
    /// Temperature of the windings, whole degrees Celsius.
    pub rotor_celsius: u8,
}

/// A register that we read or write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Register {
    /// CAN ID of the motor's answers.
    FeedbackId = 7,
    /// ID of the motor.
    MotorId = 8,
    /// Time without commands after which the motor stops, in ticks of 50 us. With 0, it never
    /// stops.
    Timeout = 9,
    /// Control mode; 1 is MIT mode.
    ControlMode = 10,
    /// Firmware version.
    SoftwareVersion = 14,
    /// `PMAX`: largest absolute position that raw values can represent, rad.
    PositionLimit = 21,
    /// `VMAX`: largest absolute velocity that raw values can represent, rad/s.
    VelocityLimit = 22,
    /// `TMAX`: largest absolute torque that raw values can represent, N m.
    TorqueLimit = 23,
    /// Bit rate, as a numeric code.
    BitRate = 35,
}

impl Register {
    const ALL: [Self; 9] = [
        Self::FeedbackId,
        Self::MotorId,
        Self::Timeout,
        Self::ControlMode,
        Self::SoftwareVersion,
        Self::PositionLimit,
        Self::VelocityLimit,
        Self::TorqueLimit,
        Self::BitRate,
    ];

    fn is_integer(self) -> bool {
        !matches!(
            self,
            Self::PositionLimit | Self::VelocityLimit | Self::TorqueLimit
        )
    }
}

/// Value of a register.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value {
    /// Integer, for IDs, codes and ticks.
    Integer(u32),
    /// Floating-point number, for SI values.
    Float(f32),
}

/// A register message to a motor, or the answer of the motor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RegisterMessage {
    /// ID of the motor to which the message is sent or from which it comes.
    pub motor: u16,
    /// Operation.
    pub access: Access,
}

/// Operation of a register message.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Access {
    /// Reads a register. The answer is [`Access::Reported`].
    Read(Register),
    /// Writes a register. The motor keeps the value until it loses power. Its answer repeats the
    /// message.
    Write(Register, Value),
    /// The answer to [`Access::Read`].
    Reported(Register, Value),
    /// Stores all registers permanently. The motor must be disabled.
    Store,
    /// Requests feedback without a command.
    Refresh,
}

/// Converts a time to a value of register `TIMEOUT`, rounded up so that no motor stops too early. A
/// time of 0 disables the timeout.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "within u32 by the check"
)]
pub fn timeout_ticks(timeout_secs: f64) -> Result<u32, CanError> {
    let upper = f64::from(u32::MAX) * TIMEOUT_TICK_SECS;
    if !(0.0..=upper).contains(&timeout_secs) {
        return Err(CanError::Range {
            field: "the timeout in seconds",
            value: timeout_secs,
            lower: 0.0,
            upper,
        });
    }
    if timeout_secs == 0.0 {
        return Ok(0);
    }
    // Subtract a small amount so that rounding errors do not add a tick. Never return 0, which
    // would disable the timeout.
    Ok((timeout_secs / TIMEOUT_TICK_SECS - 1e-6).ceil().max(1.0) as u32)
}

/// Converts a value of register `TIMEOUT` to seconds.
pub fn timeout_secs(ticks: u32) -> f64 {
    f64::from(ticks) * TIMEOUT_TICK_SECS
}

/// Ranges of a motor's raw values from its registers `PMAX`, `VMAX` and `TMAX`, which must be
/// positive.
pub fn limits_from_registers(p_max: f32, v_max: f32, t_max: f32) -> Result<Limits, CanError> {
    // A range of 0 or NaN would turn every raw value into the same position, or into NaN.
    for (field, max) in [("PMAX", p_max), ("VMAX", v_max), ("TMAX", t_max)] {
        if !(max > 0.0 && max.is_finite()) {
            return Err(CanError::Range {
                field,
                value: max.into(),
                lower: 0.0,
                upper: f32::MAX.into(),
            });
        }
    }
    Ok(Limits::of(p_max.into(), v_max.into(), t_max.into()))
}

/// Encodes an MIT-mode command. Values outside the limits are clamped.
pub fn encode_command(motor: u16, command: &Command, limits: &Limits) -> Result<Frame, CanError> {
    Frame::classic(Id::standard(motor.into())?, &mit::encode(command, limits)?)
}

/// Encodes a state command.
pub fn encode_state_command(motor: u16, state_command: StateCommand) -> Result<Frame, CanError> {
    Frame::classic(
        Id::standard(motor.into())?,
        &[
            0xFF,
            0xFF,
            0xFF,
            0xFF,
            0xFF,
            0xFF,
            0xFF,
            state_command as u8,
        ],
    )
}

/// Encodes a register message to a motor. With `answer_id`, encodes the answer of a motor that has
/// this feedback ID.
pub fn encode_register(
    message: &RegisterMessage,
    answer_id: Option<Id>,
) -> Result<Frame, CanError> {
    let (code, register, value) = match message.access {
        Access::Read(register) => (0x33, register as u8, [0; 4]),
        Access::Write(register, value) => (0x55, register as u8, value_bytes(register, value)?),
        Access::Reported(register, value) => (0x33, register as u8, value_bytes(register, value)?),
        Access::Store => (0xAA, 0, [0; 4]),
        Access::Refresh => (0xCC, 0, [0; 4]),
    };
    let [low, high] = u16::try_from(Id::standard(message.motor.into())?.value())
        .expect("11 bits")
        .to_le_bytes();
    let [a, b, c, d] = value;
    Frame::classic(
        answer_id.map_or_else(|| Id::standard(REGISTER_ID), Ok)?,
        &[low, high, code, register, a, b, c, d],
    )
}

/// Decodes a motor's register answer.
pub fn decode_register(frame: &Frame) -> Result<RegisterMessage, CanError> {
    let [low, high, code, number, a, b, c, d] = eight_bytes(frame, REGISTER, false)?;
    // The kind of access is decoded first, because feedback has the same CAN ID. In feedback, the
    // byte at the position of the register number is part of the velocity.
    let access = match code {
        0x33 => {
            let register = decode_register_number(number)?;
            Access::Reported(register, decode_value(register, [a, b, c, d]))
        }
        0x55 => {
            let register = decode_register_number(number)?;
            Access::Write(register, decode_value(register, [a, b, c, d]))
        }
        other => {
            return Err(CanError::Undefined {
                field: "the kind of access",
                raw: other.into(),
            });
        }
    };
    Ok(RegisterMessage {
        motor: u16::from_le_bytes([low, high]),
        access,
    })
}

/// The register with this number.
fn decode_register_number(number: u8) -> Result<Register, CanError> {
    decode_enum("the register", number.into(), &Register::ALL, |known| {
        known as u32
    })
}

/// Decodes the value of a register.
fn decode_value(register: Register, bytes: [u8; 4]) -> Value {
    if register.is_integer() {
        Value::Integer(u32::from_le_bytes(bytes))
    } else {
        Value::Float(f32::from_le_bytes(bytes))
    }
}

/// Decodes a motor's feedback. Register answers have the same CAN ID, so the caller must
/// distinguish them.
pub fn decode_feedback(frame: &Frame, limits: &Limits) -> Result<Feedback, CanError> {
    let [head, a, b, c, d, e, drive_celsius, rotor_celsius] = eight_bytes(frame, FEEDBACK, false)?;
    Ok(Feedback {
        motor_low: head & 0xF,
        status: decode_enum("the status", (head >> 4).into(), &Status::ALL, |known| {
            known as u32
        })?,
        motion: mit::decode_motion([a, b, c, d, e], limits),
        drive_celsius,
        rotor_celsius,
    })
}

/// Encodes the feedback of an emulated motor.
pub fn encode_feedback(
    answer_id: Id,
    feedback: &Feedback,
    limits: &Limits,
) -> Result<Frame, CanError> {
    let [a, b, c, d, e] = mit::encode_motion(&feedback.motion, limits)?;
    let head = (feedback.status as u8) << 4 | (feedback.motor_low & 0xF);
    Frame::classic(
        answer_id,
        &[
            head,
            a,
            b,
            c,
            d,
            e,
            feedback.drive_celsius,
            feedback.rotor_celsius,
        ],
    )
}

fn value_bytes(register: Register, value: Value) -> Result<[u8; 4], CanError> {
    match (register.is_integer(), value) {
        (true, Value::Integer(integer)) => Ok(integer.to_le_bytes()),
        // A motor would store NaN and use it as a limit.
        (false, Value::Float(real)) if real.is_finite() => Ok(real.to_le_bytes()),
        _ => Err(CanError::Undefined {
            field: "the kind of value of the register",
            raw: register as u32,
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::can::testing::{random_frames, truncated_and_doubled};

    const LIMITS: Limits = Model::Dm4310.limits();

    fn answer(bytes: [u8; 8]) -> Frame {
        Frame::classic(Id::standard(0x11).expect("small"), &bytes).expect("classic")
    }

    #[test]
    fn encoded_frames_match_manufacturer_bytes() {
        let sent = |access| {
            encode_register(
                &RegisterMessage {
                    motor: 0x101,
                    access,
                },
                None,
            )
            .expect("a message")
        };
        let timeout = Value::Integer(timeout_ticks(1.0).expect("in range"));
        for (access, bytes) in [
            (
                Access::Read(Register::PositionLimit),
                [0x01, 0x01, 0x33, 21, 0, 0, 0, 0],
            ),
            (
                Access::Write(Register::ControlMode, Value::Integer(1)),
                [0x01, 0x01, 0x55, 10, 1, 0, 0, 0],
            ),
            (
                Access::Write(Register::PositionLimit, Value::Float(12.5)),
                [0x01, 0x01, 0x55, 21, 0, 0, 0x48, 0x41],
            ),
            (
                Access::Write(Register::Timeout, timeout),
                [0x01, 0x01, 0x55, 9, 0x20, 0x4E, 0, 0],
            ),
            (Access::Store, [0x01, 0x01, 0xAA, 0, 0, 0, 0, 0]),
            (Access::Refresh, [0x01, 0x01, 0xCC, 0, 0, 0, 0, 0]),
        ] {
            assert_eq!(
                (sent(access).id().value(), sent(access).data()),
                (0x7FF, &bytes[..]),
                "{access:?}"
            );
        }
        for (state_command, last) in [
            (StateCommand::ClearError, 0xFB),
            (StateCommand::Enable, 0xFC),
            (StateCommand::Disable, 0xFD),
            (StateCommand::SetZero, 0xFE),
        ] {
            let frame = encode_state_command(1, state_command).expect("a motor");
            assert_eq!(
                (frame.id().value(), frame.data()),
                (1, &[255, 255, 255, 255, 255, 255, 255, last][..])
            );
        }
        let zero_command = encode_command(1, &Command::default(), &LIMITS).expect("numbers");
        assert_eq!(
            zero_command.data(),
            [0x7F, 0xFF, 0x7F, 0xF0, 0, 0, 0x07, 0xFF]
        );
        assert_eq!(
            encode_state_command(0x800, StateCommand::Enable),
            Err(CanError::IdRange {
                id: 0x800,
                bits: 11
            })
        );
    }

    #[test]
    fn feedback_and_registers_round_trip() {
        let frame = answer([0x11, 0xFF, 0xFF, 0x00, 0x0F, 0xFF, 31, 28]);
        let feedback = decode_feedback(&frame, &LIMITS).expect("feedback");
        let motion = Motion {
            position_rad: 12.5,
            velocity_rad_s: -30.0,
            torque_nm: 10.0,
        };
        let expected = Feedback {
            motor_low: 1,
            status: Status::Enabled,
            motion,
            drive_celsius: 31,
            rotor_celsius: 28,
        };
        assert_eq!(feedback, expected);
        assert_eq!(encode_feedback(frame.id(), &feedback, &LIMITS), Ok(frame));

        let register_frame = answer([0x01, 0x00, 0x33, 22, 0, 0, 0xF0, 0x41]);
        let message = decode_register(&register_frame).expect("a register");
        let access = Access::Reported(Register::VelocityLimit, Value::Float(30.0));
        assert_eq!(message, RegisterMessage { motor: 1, access });
        assert_eq!(
            encode_register(&message, Some(register_frame.id())),
            Ok(register_frame)
        );
        assert_eq!(limits_from_registers(12.5, 30.0, 10.0), Ok(LIMITS));
    }

    #[test]
    fn timeout_is_in_ticks_of_50_us() {
        for (secs, ticks) in [
            (0.0, 0),
            (50e-6, 1),
            (0.02, 400),
            (0.4, 8000),
            (1.0, 20_000),
            (51e-6, 2),
            (1e-12, 1),
        ] {
            assert_eq!(timeout_ticks(secs), Ok(ticks), "{secs}");
        }
        assert!((timeout_secs(8000) - 0.4).abs() < 1e-12);
        for secs in [-1e-3, f64::NAN, f64::INFINITY, 1e9] {
            assert!(
                matches!(timeout_ticks(secs), Err(CanError::Range { .. })),
                "{secs}"
            );
        }
    }

    #[test]
    fn invalid_messages_are_rejected() {
        for status in [0x2, 0x7, 0xF] {
            let undefined = CanError::Undefined {
                field: "the status",
                raw: status,
            };
            let head = u8::try_from(status << 4 | 1).expect("a byte");
            assert_eq!(
                decode_feedback(&answer([head, 0, 0, 0, 0, 0, 0, 0]), &LIMITS),
                Err(undefined)
            );
        }
        for (bytes, field) in [
            ([1, 0, 0x33, 99, 0, 0, 0, 0], "the register"),
            ([1, 0, 0x34, 9, 0, 0, 0, 0], "the kind of access"),
        ] {
            assert!(
                matches!(decode_register(&answer(bytes)), Err(CanError::Undefined { field: f, .. }) if f == field)
            );
        }
        let complete = answer([0x11, 0x80, 0, 0x80, 0x08, 0, 30, 30]);
        for malformed in truncated_and_doubled(&complete) {
            assert!(matches!(
                decode_feedback(&malformed, &LIMITS),
                Err(CanError::Length { .. })
            ));
            assert!(matches!(
                decode_register(&malformed),
                Err(CanError::Length { .. })
            ));
        }
        let mixed = RegisterMessage {
            motor: 1,
            access: Access::Write(Register::Timeout, Value::Float(1.0)),
        };
        assert!(encode_register(&mixed, None).is_err());
        let non_finite = RegisterMessage {
            motor: 1,
            access: Access::Write(Register::TorqueLimit, Value::Float(f32::NAN)),
        };
        assert!(encode_register(&non_finite, None).is_err());
        for bad in [0.0, -1.0, f32::NAN, f32::INFINITY] {
            assert!(limits_from_registers(12.5, bad, 10.0).is_err(), "{bad}");
        }
    }

    #[test]
    fn random_frames_never_panic_and_round_trip() {
        let mut n_read = 0;
        for frame in random_frames(13, Id::standard(0x11).expect("small")) {
            if let Ok(feedback) = decode_feedback(&frame, &LIMITS) {
                n_read += 1;
                assert_eq!(
                    encode_feedback(frame.id(), &feedback, &LIMITS)
                        .expect("own")
                        .data(),
                    frame.data()
                );
            }
            let _ = decode_register(&frame);
        }
        assert!(n_read > 100, "{n_read}");
    }
}
