//! CubeMars (T-Motor) AK motors in MIT mode.
//!
//! Sources: `neurobionics/TMotorCANControl` `mit_can.py` (limits, error codes, frames); CubeMars AK
//! Series Module Product Manual, MIT mode (feedback, temperature offset of 40). The limits depend
//! on the firmware: newer versions have different limits for some models.

use crate::wire::can::mit::{self, Command, Limits, Motion};
use crate::wire::can::{CanError, Frame, Id, decode_enum};

/// A model with known limits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Model {
    /// AK10-9.
    Ak10x9,
    /// AK60-6.
    Ak60x6,
    /// AK70-10.
    Ak70x10,
    /// AK80-6.
    Ak80x6,
    /// AK80-9.
    Ak80x9,
    /// AK80-64.
    Ak80x64,
}

impl Model {
    /// Ranges of its raw values.
    pub const fn limits(self) -> Limits {
        match self {
            Self::Ak10x9 => Limits::of(12.5, 50.0, 65.0),
            Self::Ak60x6 => Limits::of(12.5, 50.0, 15.0),
            Self::Ak70x10 => Limits::of(12.5, 50.0, 25.0),
            Self::Ak80x6 => Limits::of(12.5, 76.0, 12.0),
            Self::Ak80x9 => Limits::of(12.5, 50.0, 18.0),
            Self::Ak80x64 => Limits::of(12.5, 8.0, 144.0),
        }
    }
}

/// A state command. Its frame consists of seven bytes `FF` and this byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum StateCommand {
    /// Enable the motor.
    Enable = 0xFC,
    /// Disable the motor; the shaft is free.
    Disable = 0xFD,
    /// Set the current position as zero; the motor does not respond for about a second.
    SetZero = 0xFE,
}

/// Fault reported by a motor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Fault {
    /// No fault.
    None = 0,
    /// Overtemperature.
    OverTemperature = 1,
    /// Overcurrent.
    OverCurrent = 2,
    /// Supply voltage too high.
    OverVoltage = 3,
    /// Supply voltage too low.
    UnderVoltage = 4,
    /// Encoder failure.
    Encoder = 5,
    /// Unbalanced phase currents; the hardware may be damaged.
    PhaseUnbalance = 6,
}

impl Fault {
    const ALL: [Self; 7] = [
        Self::None,
        Self::OverTemperature,
        Self::OverCurrent,
        Self::OverVoltage,
        Self::UnderVoltage,
        Self::Encoder,
        Self::PhaseUnbalance,
    ];
}

/// Encoding of the temperature, which depends on the firmware.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Thermometer {
    /// The raw value is degrees Celsius plus 40, as in the manual.
    Offset40,
    /// The raw value is degrees Celsius, as in TMotorCANControl.
    Plain,
}

/// The last two bytes of a feedback frame. Firmware of 2020 and earlier omits them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Health {
    /// Temperature of the drive, degrees Celsius.
    pub drive_celsius: f64,
    /// The fault.
    pub fault: Fault,
}

/// Answer of a motor to every frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Feedback {
    /// ID of the motor.
    pub motor: u8,
    /// Measured motion.
    pub motion: Motion,
    /// Temperature and fault, if the firmware reports them.
    pub health: Option<Health>,
}

/// Encodes a command to a motor.
pub fn encode_command(motor: u8, command: &Command, limits: &Limits) -> Result<Frame, CanError> {
    Frame::classic(Id::standard(motor.into())?, &mit::encode(command, limits)?)
}

/// Encodes a state command to a motor.
pub fn encode_state_command(motor: u8, state_command: StateCommand) -> Result<Frame, CanError> {
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

/// Decodes a motor's answer of six or eight bytes.
pub fn decode_feedback(
    frame: &Frame,
    limits: &Limits,
    thermometer: Thermometer,
) -> Result<Feedback, CanError> {
    const MESSAGE: &str = "feedback of an AK motor";
    if frame.is_remote() || frame.id().is_extended() {
        return Err(CanError::UnexpectedFrame {
            message: MESSAGE,
            id: frame.id().value(),
        });
    }
    // Older firmware sends six bytes, and newer firmware sends eight. Any other length is another
    // message.
    let (motor, motion, rest) = match *frame.data() {
        [motor, a, b, c, d, e, ref rest @ ..] if rest.is_empty() || rest.len() == 2 => {
            (motor, [a, b, c, d, e], rest)
        }
        ref other => {
            return Err(CanError::Length {
                message: MESSAGE,
                got_bytes: other.len(),
                expected_bytes: 8,
            });
        }
    };
    let health = match *rest {
        [temperature, code] => {
            let zero = if thermometer == Thermometer::Offset40 {
                40.0
            } else {
                0.0
            };
            let fault = decode_enum("the error code", code.into(), &Fault::ALL, |known| {
                known as u32
            })?;
            Some(Health {
                drive_celsius: f64::from(temperature) - zero,
                fault,
            })
        }
        _ => None,
    };
    Ok(Feedback {
        motor,
        motion: mit::decode_motion(motion, limits),
        health,
    })
}

/// Encodes the answer of an emulated motor. Its CAN ID is `host`, the ID of the host, which is 0 by
/// default.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "checked to be 0 to 255 first"
)]
pub fn encode_feedback(
    host: u8,
    feedback: &Feedback,
    limits: &Limits,
    thermometer: Thermometer,
) -> Result<Frame, CanError> {
    let mut bytes = vec![feedback.motor];
    bytes.extend(mit::encode_motion(&feedback.motion, limits)?);
    if let Some(Health {
        drive_celsius,
        fault,
    }) = feedback.health
    {
        let zero = if thermometer == Thermometer::Offset40 {
            40.0
        } else {
            0.0
        };
        // The value is rounded before the check, so that values that round into the range are
        // accepted.
        let count = (drive_celsius + zero).round();
        if !(0.0..=255.0).contains(&count) {
            let field = "the temperature";
            return Err(CanError::Range {
                field,
                value: drive_celsius,
                lower: -zero,
                upper: 255.0 - zero,
            });
        }
        bytes.extend([count as u8, fault as u8]);
    }
    Frame::classic(Id::standard(host.into())?, &bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::can::testing::{random_frames, truncated_and_doubled};

    const LIMITS: Limits = Model::Ak80x9.limits();

    fn frame(bytes: &[u8]) -> Frame {
        Frame::classic(Id::standard(0).expect("small"), bytes).expect("classic")
    }

    #[test]
    fn commands_match_published_bytes() {
        let enable = encode_state_command(1, StateCommand::Enable).expect("a motor");
        assert_eq!(
            (enable.id().value(), enable.data()),
            (1, &[255, 255, 255, 255, 255, 255, 255, 0xFC][..])
        );
        assert_eq!(
            encode_state_command(1, StateCommand::Disable)
                .expect("a motor")
                .data()[7],
            0xFD
        );
        assert_eq!(
            encode_state_command(1, StateCommand::SetZero)
                .expect("a motor")
                .data()[7],
            0xFE
        );
        let zero_command = encode_command(104, &Command::default(), &LIMITS).expect("numbers");
        assert_eq!(
            (zero_command.id().value(), zero_command.data()),
            (104, &[0x7F, 0xFF, 0x7F, 0xF0, 0, 0, 0x07, 0xFF][..])
        );
    }

    #[test]
    fn feedback_round_trips() {
        let bytes = [0x68, 0xFF, 0xFF, 0x00, 0x0F, 0xFF, 75, 2];
        let feedback =
            decode_feedback(&frame(&bytes), &LIMITS, Thermometer::Offset40).expect("feedback");
        let motion = Motion {
            position_rad: 12.5,
            velocity_rad_s: -50.0,
            torque_nm: 18.0,
        };
        let health = Some(Health {
            drive_celsius: 35.0,
            fault: Fault::OverCurrent,
        });
        assert_eq!(
            feedback,
            Feedback {
                motor: 0x68,
                motion,
                health
            }
        );
        assert_eq!(
            encode_feedback(0, &feedback, &LIMITS, Thermometer::Offset40),
            Ok(frame(&bytes))
        );
        let plain = decode_feedback(&frame(&bytes), &LIMITS, Thermometer::Plain).expect("feedback");
        assert_eq!(plain.health.expect("eight bytes").drive_celsius, 75.0);
        let short =
            decode_feedback(&frame(&bytes[..6]), &LIMITS, Thermometer::Offset40).expect("feedback");
        assert_eq!(
            short,
            Feedback {
                health: None,
                ..feedback
            }
        );
        assert_eq!(
            encode_feedback(0, &short, &LIMITS, Thermometer::Offset40),
            Ok(frame(&bytes[..6]))
        );
    }

    #[test]
    fn invalid_messages_are_rejected() {
        let complete = frame(&[1, 0x80, 0, 0x80, 0x08, 0, 65, 0]);
        let read = |frame: &Frame| decode_feedback(frame, &LIMITS, Thermometer::Offset40);
        assert!(read(&complete).is_ok());
        for malformed in truncated_and_doubled(&complete) {
            assert_eq!(
                read(&malformed).is_ok(),
                malformed.data().len() == 6,
                "{malformed:?}"
            );
        }
        let undefined = CanError::Undefined {
            field: "the error code",
            raw: 7,
        };
        assert_eq!(read(&frame(&[1, 0, 0, 0, 0, 0, 0, 7])), Err(undefined));
        let remote = Frame::remote(complete.id(), 8).expect("classic");
        assert!(matches!(
            read(&remote),
            Err(CanError::UnexpectedFrame { .. })
        ));
        let too_hot = Feedback {
            health: Some(Health {
                drive_celsius: 216.0,
                fault: Fault::None,
            }),
            ..read(&complete).expect("whole")
        };
        assert!(matches!(
            encode_feedback(0, &too_hot, &LIMITS, Thermometer::Offset40),
            Err(CanError::Range { .. })
        ));
        let mut n_read = 0;
        for frame in random_frames(11, complete.id()) {
            if let Ok(feedback) = read(&frame) {
                n_read += 1;
                assert_eq!(
                    encode_feedback(0, &feedback, &LIMITS, Thermometer::Offset40)
                        .expect("own")
                        .data(),
                    frame.data()
                );
            }
        }
        assert!(n_read > 100, "{n_read}");
    }

    #[test]
    fn model_limits_cover_full_scale() {
        for (model, velocity_rad_s, torque_nm) in [
            (Model::Ak10x9, 50.0, 65.0),
            (Model::Ak60x6, 50.0, 15.0),
            (Model::Ak70x10, 50.0, 25.0),
            (Model::Ak80x6, 76.0, 12.0),
            (Model::Ak80x9, 50.0, 18.0),
            (Model::Ak80x64, 8.0, 144.0),
        ] {
            let read = decode_feedback(
                &frame(&[1, 0, 0, 255, 255, 255]),
                &model.limits(),
                Thermometer::Offset40,
            );
            let motion = Motion {
                position_rad: -12.5,
                velocity_rad_s,
                torque_nm,
            };
            assert_eq!(
                read,
                Ok(Feedback {
                    motor: 1,
                    motion,
                    health: None
                }),
                "{model:?}"
            );
        }
    }
}
