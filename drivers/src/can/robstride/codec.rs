//! Robstride motors with their private protocol: the 29-bit CAN ID contains a communication type,
//! two IDs and flags.
//!
//! Sources: `RobStride/SampleProgram` (`Robstride.cpp`: types 0 to 25 and their bytes, active
//! report of 10 ms); RS00 to RS06 user manuals (scalings, fault bits, parameter table, `canTimeout`
//! of 20 000 ticks per second, 0 for never). This module uses the scalings of the manuals. The
//! table of the Python package `robstride_dynamics` differs for RS00, RS03, RS05 and RS06, and
//! gives torques of an RS05 that are three times too high (motorbridge/motorbridge pull request
//! 11). RS02 firmware up to 0.2.2.11 uses a range of 12.5 rad.

pub use super::parameter::{Parameter, Value, timeout};

use crate::wire::can::mit::{Command, Limits, Motion, Scales};
use crate::wire::can::{CanError, Frame, Id, decode_enum, eight_bytes};
use std::f64::consts::PI;

/// Name of a motor's frames in errors.
const MESSAGE: &str = "answer of a Robstride motor";
/// Value of [`Parameter::RunMode`] for motion mode, in which [`Request::Move`] is followed.
pub const MOTION_MODE: u32 = 0;
/// Fixed bytes in some requests, which keep a motor from executing other data.
const MAGIC: [u8; 6] = [1, 2, 3, 4, 5, 6];
/// Destination of a motor's answer to [`Request::Identify`].
const BROADCAST: u8 = 0xFE;

/// A motor model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "the names are those on the motors")]
pub enum Model {
    Rs00,
    Rs01,
    Rs02,
    Rs03,
    Rs04,
    Rs05,
    Rs06,
}

impl Model {
    /// Ranges of its raw values.
    pub const fn limits(self) -> Limits {
        match self {
            Self::Rs00 => Limits::of(4.0 * PI, 33.0, 14.0),
            Self::Rs01 | Self::Rs02 => Limits::of(4.0 * PI, 44.0, 17.0),
            Self::Rs03 => large(20.0, 60.0),
            Self::Rs04 => large(15.0, 120.0),
            Self::Rs05 => Limits::of(4.0 * PI, 50.0, 5.5),
            Self::Rs06 => large(50.0, 36.0),
        }
    }
}

/// Limits of the large motors, whose gains have larger ranges.
const fn large(velocity_rad_s: f64, torque_nm: f64) -> Limits {
    Limits {
        position_rad: 4.0 * PI,
        velocity_rad_s,
        torque_nm,
        kp_nm_rad: 5000.0,
        kd_nm_s_rad: 100.0,
    }
}

/// Communication type in bits 24 to 28 of the identifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
enum Communication {
    Identity = 0,
    Motion = 1,
    Feedback = 2,
    Enable = 3,
    Stop = 4,
    SetZero = 6,
    ReadParameter = 17,
    WriteParameter = 18,
    Fault = 21,
    Store = 22,
    ActiveReport = 24,
}

/// A request to a motor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Request {
    /// Type 0: request the serial number.
    Identify,
    /// Type 1: motion command; clamped to the limits.
    Move(Command),
    /// Type 3: enable the motor.
    Enable,
    /// Type 4: disable the motor, and optionally clear its fault.
    Stop {
        /// Whether to clear the fault.
        clear_fault: bool,
    },
    /// Type 6: set the current position as zero.
    SetZero,
    /// Type 17: read a parameter.
    Read(Parameter),
    /// Type 18: write a parameter until power is lost.
    Write(Parameter, Value),
    /// Type 22: store all parameters permanently.
    Store,
    /// Type 24: start or stop reporting every [`Parameter::ReportInterval`].
    ReportActively(bool),
}

/// Mode in bits 22 and 23 of a feedback's identifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Mode {
    /// The shaft is free.
    Reset = 0,
    /// The encoder is being calibrated.
    Calibration = 1,
    /// The motor follows commands.
    Run = 2,
}

/// Fault bits in bits 16 to 21 of a feedback's identifier.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Faults(pub u8);

impl Faults {
    /// Supply voltage too low.
    pub const UNDER_VOLTAGE: u8 = 1;
    /// Phase overcurrent.
    pub const OVER_CURRENT: u8 = 1 << 1;
    /// Overtemperature.
    pub const OVER_TEMPERATURE: u8 = 1 << 2;
    /// Failure of the magnetic encoder.
    pub const ENCODER: u8 = 1 << 3;
    /// Stalled or overloaded.
    pub const OVERLOAD: u8 = 1 << 4;
    /// The encoder is not calibrated.
    pub const UNCALIBRATED: u8 = 1 << 5;
}

/// A message from a motor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Answer {
    /// Type 0: the serial number of the motor.
    Identity {
        /// ID of the motor.
        motor: u8,
        /// Serial number of its processor.
        serial: [u8; 8],
    },
    /// Type 2: answer to every request except reads; type 24: unsolicited report.
    Feedback(Feedback),
    /// Type 17: a parameter.
    Parameter {
        /// ID of the motor.
        motor: u8,
        /// The parameter.
        parameter: Parameter,
        /// Its value.
        value: Value,
    },
    /// Type 21: the fault and warning words of the motor.
    Fault {
        /// ID of the motor.
        motor: u8,
        /// Fault bits, see the manual.
        faults: u32,
        /// Warning bits, see the manual.
        warnings: u32,
    },
}

/// State and motion of a motor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Feedback {
    /// ID of the motor.
    pub motor: u8,
    /// Whether it is an unsolicited report (type 24).
    pub is_unsolicited: bool,
    /// Mode.
    pub mode: Mode,
    /// Fault bits.
    pub faults: Faults,
    /// Measured motion.
    pub motion: Motion,
    /// Temperature of the windings, degrees Celsius; encoded in tenths of a degree.
    pub winding_celsius: f64,
}

/// Encodes a request from the host ID `host` to the motor ID `motor`.
pub fn encode_request(
    host: u8,
    motor: u8,
    request: &Request,
    limits: &Limits,
) -> Result<Frame, CanError> {
    // Bits 8 to 23 of the identifier contain our ID, except in motion commands, where they contain
    // the torque. That leaves all eight bytes of payload for the other four values.
    let host_only = u16::from(host);
    let (kind, middle, bytes) = match *request {
        Request::Identify => (Communication::Identity, host_only, [0; 8]),
        Request::Move(command) => {
            let (torque, bytes) = encode_motion_command(&command, limits)?;
            (Communication::Motion, torque, bytes)
        }
        Request::Enable => (Communication::Enable, host_only, [0; 8]),
        Request::Stop { clear_fault } => (
            Communication::Stop,
            host_only,
            [clear_fault.into(), 0, 0, 0, 0, 0, 0, 0],
        ),
        Request::SetZero => (Communication::SetZero, host_only, [1, 0, 0, 0, 0, 0, 0, 0]),
        Request::Read(parameter) => (
            Communication::ReadParameter,
            host_only,
            parameter.bytes([0; 4]),
        ),
        Request::Write(parameter, value) => (
            Communication::WriteParameter,
            host_only,
            parameter.bytes(parameter.value_bytes(value)?),
        ),
        Request::Store => (Communication::Store, host_only, with_magic(7)),
        Request::ReportActively(on) => (
            Communication::ActiveReport,
            host_only,
            with_magic(on.into()),
        ),
    };
    Frame::classic(id_of(kind, middle, motor)?, &bytes)
}

/// The torque field of a motion command, which is in its identifier, and its payload.
fn encode_motion_command(command: &Command, limits: &Limits) -> Result<(u16, [u8; 8]), CanError> {
    // Unlike in MIT mode, all values have 16 bits, and the payload is big-endian. Parameters are
    // little-endian.
    let scales = Scales::with_bits(limits, 16);
    let [p1, p0] = scales
        .position
        .raw_from_value("the position", command.position_rad)?
        .to_be_bytes();
    let [v1, v0] = scales
        .velocity
        .raw_from_value("the velocity", command.velocity_rad_s)?
        .to_be_bytes();
    let [kp1, kp0] = scales
        .kp
        .raw_from_value("kp", command.kp_nm_rad)?
        .to_be_bytes();
    let [kd1, kd0] = scales
        .kd
        .raw_from_value("kd", command.kd_nm_s_rad)?
        .to_be_bytes();
    let torque = scales
        .torque
        .raw_from_value("the torque", command.torque_nm)?;
    Ok((torque, [p1, p0, v1, v0, kp1, kp0, kd1, kd0]))
}

/// Payload of a request that a motor executes only with the fixed bytes.
fn with_magic(last: u8) -> [u8; 8] {
    let [a, b, c, d, e, f] = MAGIC;
    [a, b, c, d, e, f, last, 8]
}

/// Decodes a motion command to the motor ID `motor`, for emulated motors.
pub fn decode_move(frame: &Frame, motor: u8, limits: &Limits) -> Option<Command> {
    let [a, b, c, d, e, f, g, h] = eight_bytes(frame, MESSAGE, true).ok()?;
    let [kind, t1, t0, to] = frame.id().value().to_be_bytes();
    if kind != Communication::Motion as u8 || to != motor {
        return None;
    }
    let scales = Scales::with_bits(limits, 16);
    Some(Command {
        position_rad: scales.position.value_from_raw(u16::from_be_bytes([a, b])),
        velocity_rad_s: scales.velocity.value_from_raw(u16::from_be_bytes([c, d])),
        kp_nm_rad: scales.kp.value_from_raw(u16::from_be_bytes([e, f])),
        kd_nm_s_rad: scales.kd.value_from_raw(u16::from_be_bytes([g, h])),
        torque_nm: scales.torque.value_from_raw(u16::from_be_bytes([t1, t0])),
    })
}

/// Decodes a message from a motor to the host ID `host`.
pub fn decode_answer(frame: &Frame, host: u8, limits: &Limits) -> Result<Answer, CanError> {
    let bytes = eight_bytes(frame, MESSAGE, true)?;
    let id_bytes = frame.id().value().to_be_bytes();
    let [kind, flags, motor, to] = id_bytes;
    let foreign = CanError::UnexpectedFrame {
        message: MESSAGE,
        id: frame.id().value(),
    };
    // Motors broadcast their identity, so this comes before the check of the destination.
    if kind == Communication::Identity as u8 {
        return if to == BROADCAST {
            Ok(Answer::Identity {
                motor,
                serial: bytes,
            })
        } else {
            Err(foreign)
        };
    }
    // Requests have the motor as their destination, so requests of other programs are not mistaken
    // for answers.
    if to != host {
        return Err(foreign);
    }
    let [a, b, c, d, e, f, g, h] = bytes;
    if kind == Communication::Feedback as u8 || kind == Communication::ActiveReport as u8 {
        return decode_feedback(id_bytes, bytes, limits).map(Answer::Feedback);
    }
    if kind == Communication::ReadParameter as u8 {
        let index = u16::from_le_bytes([a, b]);
        // The motor does not know the parameter, or its value cannot be read. The payload is then
        // undefined.
        if flags != 0 {
            return Err(CanError::Refused {
                parameter: index.into(),
            });
        }
        let parameter = Parameter::of_index(index)?;
        let value = parameter.value([e, f, g, h]);
        return Ok(Answer::Parameter {
            motor,
            parameter,
            value,
        });
    }
    if kind == Communication::Fault as u8 {
        return Ok(Answer::Fault {
            motor,
            faults: u32::from_le_bytes([a, b, c, d]),
            warnings: u32::from_le_bytes([e, f, g, h]),
        });
    }
    Err(CanError::Undefined {
        field: "the communication type",
        raw: kind.into(),
    })
}

/// Decodes the state and motion of a motor. `id_bytes` are the bytes of the identifier, the highest
/// first.
fn decode_feedback(
    id_bytes: [u8; 4],
    bytes: [u8; 8],
    limits: &Limits,
) -> Result<Feedback, CanError> {
    let [kind, flags, motor, _] = id_bytes;
    let [a, b, c, d, e, f, g, h] = bytes;
    let modes = [Mode::Reset, Mode::Calibration, Mode::Run];
    let scales = Scales::with_bits(limits, 16);
    Ok(Feedback {
        motor,
        is_unsolicited: kind == Communication::ActiveReport as u8,
        // Two bits contain the mode. The six bits below them are fault bits.
        mode: decode_enum("the mode", (flags >> 6).into(), &modes, |known| {
            known as u32
        })?,
        faults: Faults(flags & 0x3F),
        motion: Motion {
            position_rad: scales.position.value_from_raw(u16::from_be_bytes([a, b])),
            velocity_rad_s: scales.velocity.value_from_raw(u16::from_be_bytes([c, d])),
            torque_nm: scales.torque.value_from_raw(u16::from_be_bytes([e, f])),
        },
        winding_celsius: f64::from(u16::from_be_bytes([g, h])) / 10.0,
    })
}

/// Encodes the feedback of an emulated motor to the host ID `host`. The temperature must be 0 to
/// 6553.5.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "checked to be within 16 bits first"
)]
pub fn encode_feedback(host: u8, feedback: &Feedback, limits: &Limits) -> Result<Frame, CanError> {
    let scales = Scales::with_bits(limits, 16);
    let [a, b] = scales
        .position
        .raw_from_value("the position", feedback.motion.position_rad)?
        .to_be_bytes();
    let [c, d] = scales
        .velocity
        .raw_from_value("the velocity", feedback.motion.velocity_rad_s)?
        .to_be_bytes();
    let [e, f] = scales
        .torque
        .raw_from_value("the torque", feedback.motion.torque_nm)?
        .to_be_bytes();
    let tenths = (feedback.winding_celsius * 10.0).round();
    if !(0.0..=65_535.0).contains(&tenths) {
        let value = feedback.winding_celsius;
        return Err(CanError::Range {
            field: "the temperature",
            value,
            lower: 0.0,
            upper: 6553.5,
        });
    }
    let [g, h] = (tenths as u16).to_be_bytes();
    let kind = if feedback.is_unsolicited {
        Communication::ActiveReport
    } else {
        Communication::Feedback
    };
    let flags = (feedback.mode as u8) << 6 | (feedback.faults.0 & 0x3F);
    Frame::classic(
        id_of(kind, u16::from_be_bytes([flags, feedback.motor]), host)?,
        &[a, b, c, d, e, f, g, h],
    )
}

fn id_of(kind: Communication, middle: u16, to: u8) -> Result<Id, CanError> {
    Id::extended(u32::from(kind as u8) << 24 | u32::from(middle) << 8 | u32::from(to))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::can::testing::{random_frames, truncated_and_doubled};

    const LIMITS: Limits = Model::Rs00.limits();
    const HOST: u8 = 0xFD;

    fn frame(id: u32, bytes: [u8; 8]) -> Frame {
        Frame::classic(Id::extended(id).expect("29 bits"), &bytes).expect("classic")
    }

    #[test]
    fn requests_match_manufacturer_bytes() {
        let zero_command = Request::Move(Command::default());
        let max = Command {
            position_rad: 99.0,
            velocity_rad_s: 99.0,
            kp_nm_rad: 9e3,
            kd_nm_s_rad: 9.0,
            torque_nm: -99.0,
        };
        for (request, id, bytes) in [
            (Request::Identify, 0x0000_FD7F, [0; 8]),
            (
                zero_command,
                0x017F_FF7F,
                [0x7F, 0xFF, 0x7F, 0xFF, 0, 0, 0, 0],
            ),
            (Request::Move(max), 0x0100_007F, [0xFF; 8]),
            (Request::Enable, 0x0300_FD7F, [0; 8]),
            (Request::Stop { clear_fault: false }, 0x0400_FD7F, [0; 8]),
            (
                Request::Stop { clear_fault: true },
                0x0400_FD7F,
                [1, 0, 0, 0, 0, 0, 0, 0],
            ),
            (Request::SetZero, 0x0600_FD7F, [1, 0, 0, 0, 0, 0, 0, 0]),
            // The manual's example of type 17.
            (
                Request::Read(Parameter::PositionGain),
                0x1100_FD7F,
                [0x1E, 0x70, 0, 0, 0, 0, 0, 0],
            ),
            (
                Request::Write(Parameter::Timeout, timeout(1.0).expect("in range")),
                0x1200_FD7F,
                [0x28, 0x70, 0, 0, 0x20, 0x4E, 0, 0],
            ),
            (Request::Store, 0x1600_FD7F, [1, 2, 3, 4, 5, 6, 7, 8]),
            (
                Request::ReportActively(true),
                0x1800_FD7F,
                [1, 2, 3, 4, 5, 6, 1, 8],
            ),
        ] {
            assert_eq!(
                encode_request(HOST, 0x7F, &request, &LIMITS),
                Ok(frame(id, bytes)),
                "{request:?}"
            );
        }
    }

    #[test]
    fn move_request_round_trips() {
        let command = Command {
            position_rad: 1.5,
            velocity_rad_s: -3.0,
            kp_nm_rad: 60.0,
            kd_nm_s_rad: 1.25,
            torque_nm: 0.5,
        };
        let sent = encode_request(HOST, 5, &Request::Move(command), &LIMITS).expect("numbers");
        let got = decode_move(&sent, 5, &LIMITS).expect("the command is addressed to this motor");
        // Tolerances: half a quantization step of 16 bits.
        assert!((got.position_rad - 1.5).abs() < 2e-4 && (got.velocity_rad_s + 3.0).abs() < 6e-4);
        assert!((got.kp_nm_rad - 60.0).abs() < 4e-3 && (got.kd_nm_s_rad - 1.25).abs() < 4e-5);
        assert!((got.torque_nm - 0.5).abs() < 3e-4);
        assert_eq!(decode_move(&sent, 6, &LIMITS), None);
        let enable = encode_request(HOST, 5, &Request::Enable, &LIMITS).expect("no numbers");
        assert_eq!(decode_move(&enable, 5, &LIMITS), None);
    }

    #[test]
    fn answers_are_decoded() {
        let read = |id, bytes| decode_answer(&frame(id, bytes), HOST, &LIMITS);
        // The manual's example of type 17: loc_kp is 30.
        let (parameter, value) = (Parameter::PositionGain, Value::Float(30.0));
        let parameter_answer = Answer::Parameter {
            motor: 0x7F,
            parameter,
            value,
        };
        assert_eq!(
            read(0x1100_7FFD, [0x1E, 0x70, 0, 0, 0, 0, 0xF0, 0x41]),
            Ok(parameter_answer)
        );
        assert_eq!(
            read(0x1101_7FFD, [0x1E, 0x70, 0, 0, 0, 0, 0, 0]),
            Err(CanError::Refused { parameter: 0x701E })
        );
        let mode = Answer::Parameter {
            motor: 1,
            parameter: Parameter::RunMode,
            value: Value::Integer(2),
        };
        assert_eq!(read(0x1100_01FD, [0x05, 0x70, 0, 0, 2, 9, 9, 9]), Ok(mode));
        assert_eq!(
            read(0x0000_05FE, [7; 8]),
            Ok(Answer::Identity {
                motor: 5,
                serial: [7; 8]
            })
        );
        let fault = Answer::Fault {
            motor: 5,
            faults: 1 << 14,
            warnings: 1,
        };
        assert_eq!(read(0x1500_05FD, [0, 0x40, 0, 0, 1, 0, 0, 0]), Ok(fault));

        let motion = Motion {
            position_rad: 4.0 * PI,
            velocity_rad_s: -33.0,
            torque_nm: 14.0,
        };
        for (kind, is_unsolicited) in [(0x02, false), (0x18, true)] {
            let faults = Faults(Faults::UNCALIBRATED | Faults::UNDER_VOLTAGE);
            let feedback = Feedback {
                motor: 0x11,
                is_unsolicited,
                mode: Mode::Run,
                faults,
                motion,
                winding_celsius: 30.5,
            };
            let sent = frame(
                kind << 24 | 0x00A1_11FD,
                [0xFF, 0xFF, 0, 0, 0xFF, 0xFF, 0x01, 0x31],
            );
            assert_eq!(
                decode_answer(&sent, HOST, &LIMITS),
                Ok(Answer::Feedback(feedback))
            );
            assert_eq!(encode_feedback(HOST, &feedback, &LIMITS), Ok(sent));
        }
    }

    #[test]
    fn invalid_messages_are_rejected() {
        let read = |id, bytes| decode_answer(&frame(id, bytes), HOST, &LIMITS);
        assert!(matches!(
            read(0x0280_11FC, [0; 8]),
            Err(CanError::UnexpectedFrame { .. })
        ));
        assert_eq!(
            read(0x02C0_11FD, [0; 8]),
            Err(CanError::Undefined {
                field: "the mode",
                raw: 3
            })
        );
        assert_eq!(
            read(0x1F00_11FD, [0; 8]),
            Err(CanError::Undefined {
                field: "the communication type",
                raw: 31
            })
        );
        assert_eq!(
            read(0x1100_11FD, [1; 8]),
            Err(CanError::Undefined {
                field: "the parameter",
                raw: 0x0101
            })
        );
        for malformed in truncated_and_doubled(&frame(0x0280_11FD, [0x80; 8])) {
            assert!(matches!(
                decode_answer(&malformed, HOST, &LIMITS),
                Err(CanError::Length { .. })
            ));
        }
        let requested = |request| encode_request(HOST, 1, &request, &LIMITS);
        assert!(requested(Request::Write(Parameter::RunMode, Value::Integer(256))).is_err());
        assert!(requested(Request::Write(Parameter::RunMode, Value::Float(0.0))).is_err());
        assert!(
            requested(Request::Write(
                Parameter::TorqueLimit,
                Value::Float(f32::NAN)
            ))
            .is_err()
        );
        let non_finite = Command {
            torque_nm: f64::NAN,
            ..Command::default()
        };
        assert_eq!(
            requested(Request::Move(non_finite)),
            Err(CanError::NotFinite {
                field: "the torque"
            })
        );
    }

    #[test]
    fn random_frames_never_panic_and_feedback_round_trips() {
        let mut n_read = 0;
        for frame in random_frames(17, Id::extended(0x0280_11FD).expect("29 bits")) {
            if let Ok(Answer::Feedback(feedback)) = decode_answer(&frame, HOST, &LIMITS) {
                n_read += 1;
                assert_eq!(
                    encode_feedback(HOST, &feedback, &LIMITS)
                        .expect("own")
                        .data(),
                    frame.data()
                );
            }
        }
        assert!(n_read > 100, "{n_read}");
    }

    #[test]
    fn model_limits_match_manual() {
        for (model, velocity_rad_s, torque_nm, kp, kd) in [
            (Model::Rs00, 33.0, 14.0, 500.0, 5.0),
            (Model::Rs01, 44.0, 17.0, 500.0, 5.0),
            (Model::Rs02, 44.0, 17.0, 500.0, 5.0),
            (Model::Rs03, 20.0, 60.0, 5000.0, 100.0),
            (Model::Rs04, 15.0, 120.0, 5000.0, 100.0),
            (Model::Rs05, 50.0, 5.5, 500.0, 5.0),
            (Model::Rs06, 50.0, 36.0, 5000.0, 100.0),
        ] {
            let limits = Limits {
                position_rad: 4.0 * PI,
                velocity_rad_s,
                torque_nm,
                kp_nm_rad: kp,
                kd_nm_s_rad: kd,
            };
            assert_eq!(model.limits(), limits, "{model:?}");
        }
    }
}
