//! MIT mode: position, velocity, two gains and a torque in the eight bytes of one frame.
//!
//! Source: Ben Katz, mini cheetah motor controller (`pack_cmd`, `unpack_reply`). `DM_CAN.py` of
//! `cmjang/DM_Control_Python` and `mit_can.py` of `neurobionics/TMotorCANControl` use the same
//! bytes. The drive applies `torque = kp (position - measured) + kd (velocity - measured) +
//! torque`. As in these sources, values outside the limits are clamped.

use super::CanError;
use super::scale::Scale;

/// Ranges of a motor's raw values. Gains range from 0 to these limits, and the other values from
/// the negative to the positive limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Maximum position of the output shaft, rad.
    pub position_rad: f64,
    /// Maximum velocity of the output shaft, rad/s.
    pub velocity_rad_s: f64,
    /// Maximum torque at the output shaft, N m.
    pub torque_nm: f64,
    /// Maximum stiffness, N m / rad.
    pub kp_nm_rad: f64,
    /// Maximum damping, N m s / rad.
    pub kd_nm_s_rad: f64,
}

impl Limits {
    /// Limits with the gain limits of most motors: 500 N m / rad and 5 N m s / rad.
    pub const fn of(position_rad: f64, velocity_rad_s: f64, torque_nm: f64) -> Self {
        Self {
            position_rad,
            velocity_rad_s,
            torque_nm,
            kp_nm_rad: 500.0,
            kd_nm_s_rad: 5.0,
        }
    }

    /// Returns the command as it is sent, with every number clamped to its limits. NaN stays NaN.
    pub fn clamped(&self, command: &Command) -> Command {
        let clamp_symmetric = |value: f64, max: f64| value.clamp(-max, max);
        Command {
            position_rad: clamp_symmetric(command.position_rad, self.position_rad),
            velocity_rad_s: clamp_symmetric(command.velocity_rad_s, self.velocity_rad_s),
            kp_nm_rad: command.kp_nm_rad.clamp(0.0, self.kp_nm_rad),
            kd_nm_s_rad: command.kd_nm_s_rad.clamp(0.0, self.kd_nm_s_rad),
            torque_nm: clamp_symmetric(command.torque_nm, self.torque_nm),
        }
    }
}

/// A command in MIT mode.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Command {
    /// Target position, rad.
    pub position_rad: f64,
    /// Target velocity, rad/s.
    pub velocity_rad_s: f64,
    /// Stiffness towards the position, N m / rad.
    pub kp_nm_rad: f64,
    /// Damping towards the velocity, N m s / rad.
    pub kd_nm_s_rad: f64,
    /// Feedforward torque, N m.
    pub torque_nm: f64,
}

/// Measured motion of a motor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Position of the output shaft, rad.
    pub position_rad: f64,
    /// Velocity of the output shaft, rad/s.
    pub velocity_rad_s: f64,
    /// Torque at the output shaft as estimated by the drive, N m.
    pub torque_nm: f64,
}

/// Conversion of the numbers of a command to raw values.
pub(crate) struct Scales {
    pub(crate) position: Scale,
    pub(crate) velocity: Scale,
    pub(crate) kp: Scale,
    pub(crate) kd: Scale,
    pub(crate) torque: Scale,
}

impl Scales {
    /// Scales of MIT mode.
    fn of(limits: &Limits) -> Self {
        Self::with_bits(limits, 12)
    }

    /// Scales with 16 bits for the position and `n_bits` for everything else.
    pub(crate) fn with_bits(limits: &Limits, n_bits: u32) -> Self {
        Self {
            position: Scale::symmetric(limits.position_rad, 16),
            velocity: Scale::symmetric(limits.velocity_rad_s, n_bits),
            kp: Scale::positive(limits.kp_nm_rad, n_bits),
            kd: Scale::positive(limits.kd_nm_s_rad, n_bits),
            torque: Scale::symmetric(limits.torque_nm, n_bits),
        }
    }
}

/// Encodes a command. Values outside the limits are clamped.
///
/// # Errors
/// Fails if a value is NaN.
pub fn encode(command: &Command, limits: &Limits) -> Result<[u8; 8], CanError> {
    let scales = Scales::of(limits);
    let position = scales
        .position
        .raw_from_value("the position", command.position_rad)?;
    let velocity = scales
        .velocity
        .raw_from_value("the velocity", command.velocity_rad_s)?;
    let kp = scales.kp.raw_from_value("kp", command.kp_nm_rad)?;
    let kd = scales.kd.raw_from_value("kd", command.kd_nm_s_rad)?;
    let torque = scales
        .torque
        .raw_from_value("the torque", command.torque_nm)?;
    let fields = [
        (position, 16),
        (velocity, 12),
        (kp, 12),
        (kd, 12),
        (torque, 12),
    ];
    Ok(fields
        .iter()
        // The fields follow each other without gaps, the highest bit first. Together, they have 16 +
        // 4 x 12 = 64 bits.
        .fold(0_u64, |bits, (raw, n_bits)| {
            bits << n_bits | u64::from(*raw)
        })
        .to_be_bytes())
}

/// Decodes a command, for emulated motors.
pub fn decode(bytes: &[u8; 8], limits: &Limits) -> Command {
    let scales = Scales::of(limits);
    let [p1, p0, v1, v0_kp1, kp0, kd1, kd0_t1, t0] = *bytes;
    Command {
        position_rad: scales.position.value_from_raw(u16::from_be_bytes([p1, p0])),
        velocity_rad_s: scales.velocity.value_from_raw(high_twelve(v1, v0_kp1)),
        kp_nm_rad: scales.kp.value_from_raw(low_twelve(v0_kp1, kp0)),
        kd_nm_s_rad: scales.kd.value_from_raw(high_twelve(kd1, kd0_t1)),
        torque_nm: scales.torque.value_from_raw(low_twelve(kd0_t1, t0)),
    }
}

/// Encodes the five bytes of a motion, which follow the motor's ID in the feedback of all
/// manufacturers.
pub fn encode_motion(motion: &Motion, limits: &Limits) -> Result<[u8; 5], CanError> {
    let scales = Scales::of(limits);
    let [p1, p0] = scales
        .position
        .raw_from_value("the position", motion.position_rad)?
        .to_be_bytes();
    let velocity = scales
        .velocity
        .raw_from_value("the velocity", motion.velocity_rad_s)?;
    let torque = scales
        .torque
        .raw_from_value("the torque", motion.torque_nm)?;
    let [_, b2, b3, b4] = (u32::from(velocity) << 12 | u32::from(torque)).to_be_bytes();
    Ok([p1, p0, b2, b3, b4])
}

/// Decodes the five bytes of a motion.
pub fn decode_motion(bytes: [u8; 5], limits: &Limits) -> Motion {
    let scales = Scales::of(limits);
    let [p1, p0, v1, v0_t1, t0] = bytes;
    Motion {
        position_rad: scales.position.value_from_raw(u16::from_be_bytes([p1, p0])),
        velocity_rad_s: scales.velocity.value_from_raw(high_twelve(v1, v0_t1)),
        torque_nm: scales.torque.value_from_raw(low_twelve(v0_t1, t0)),
    }
}

/// Twelve bits that end in the middle of the second byte.
fn high_twelve(first: u8, second: u8) -> u16 {
    u16::from_be_bytes([first, second]) >> 4
}

/// Twelve bits that start in the middle of the first byte.
fn low_twelve(first: u8, second: u8) -> u16 {
    u16::from_be_bytes([first, second]) & 0xFFF
}

#[cfg(test)]
mod tests {
    use super::*;
    use numbers::random::Random;

    const LIMITS: Limits = Limits::of(12.5, 30.0, 10.0);

    #[test]
    fn commands_match_manufacturer_sample_bytes() {
        // The bytes are from controlMIT of DM_CAN.py with the limits of a DM4310. The commands are
        // zeros, both ends of the ranges, and kp = 50, kd = 1, q = 1, dq = -3, tau = 2.5.
        let command = |kp_nm_rad, kd_nm_s_rad, position_rad, velocity_rad_s, torque_nm| Command {
            position_rad,
            velocity_rad_s,
            kp_nm_rad,
            kd_nm_s_rad,
            torque_nm,
        };
        let cases = [
            (
                command(0.0, 0.0, 0.0, 0.0, 0.0),
                [0x7F, 0xFF, 0x7F, 0xF0, 0x00, 0x00, 0x07, 0xFF],
            ),
            (command(500.0, 5.0, 12.5, 30.0, 10.0), [0xFF; 8]),
            (command(0.0, 0.0, -12.5, -30.0, -10.0), [0x00; 8]),
            // 35388.9, 1842.75, 409.5, 819 and 2559.375 are rounded to the nearest integer. The
            // half in 409.5 is rounded down to 409.
            (
                command(50.0, 1.0, 1.0, -3.0, 2.5),
                [0x8A, 0x3D, 0x73, 0x31, 0x99, 0x33, 0x39, 0xFF],
            ),
        ];
        for (command, bytes) in cases {
            assert_eq!(encode(&command, &LIMITS), Ok(bytes), "{command:?}");
        }
    }

    #[test]
    fn any_bytes_decode_and_round_trip() {
        let mut random = Random::new(3);
        for _ in 0..20_000 {
            let bytes = random.bits().to_be_bytes();
            assert_eq!(encode(&decode(&bytes, &LIMITS), &LIMITS), Ok(bytes));
            let motion = bytes[..5].try_into().expect("five");
            assert_eq!(
                encode_motion(&decode_motion(motion, &LIMITS), &LIMITS),
                Ok(motion)
            );
        }
    }

    #[test]
    fn commands_round_trip_within_resolution() {
        let mut random = Random::new(5);
        let mut random_within = |max: f64| random.uniform(-max, max);
        for _ in 0..20_000 {
            let command = Command {
                position_rad: random_within(12.5),
                velocity_rad_s: random_within(30.0),
                kp_nm_rad: random_within(500.0).abs(),
                kd_nm_s_rad: random_within(5.0).abs(),
                torque_nm: random_within(10.0),
            };
            let back = decode(&encode(&command, &LIMITS).expect("numbers"), &LIMITS);
            // Tolerance: half a quantization step.
            for (name, error, range, counts) in [
                (
                    "position",
                    back.position_rad - command.position_rad,
                    25.0,
                    65_535.0,
                ),
                (
                    "velocity",
                    back.velocity_rad_s - command.velocity_rad_s,
                    60.0,
                    4095.0,
                ),
                ("kp", back.kp_nm_rad - command.kp_nm_rad, 500.0, 4095.0),
                ("kd", back.kd_nm_s_rad - command.kd_nm_s_rad, 5.0, 4095.0),
                ("torque", back.torque_nm - command.torque_nm, 20.0, 4095.0),
            ] {
                assert!(
                    error.abs() <= 0.5 * range / counts * (1.0 + 1e-9),
                    "{name}: {error}"
                );
            }
        }
    }

    #[test]
    fn out_of_range_is_clamped_and_non_finite_rejected() {
        let out_of_range = Command {
            position_rad: 1e9,
            velocity_rad_s: -1e9,
            kp_nm_rad: -1.0,
            kd_nm_s_rad: 6.0,
            torque_nm: f64::INFINITY,
        };
        let clamped = LIMITS.clamped(&out_of_range);
        assert_eq!(
            clamped,
            Command {
                position_rad: 12.5,
                velocity_rad_s: -30.0,
                kp_nm_rad: 0.0,
                kd_nm_s_rad: 5.0,
                torque_nm: 10.0
            }
        );
        assert_eq!(encode(&out_of_range, &LIMITS), encode(&clamped, &LIMITS));
        let non_finite = Command {
            kp_nm_rad: f64::NAN,
            ..Command::default()
        };
        assert_eq!(
            encode(&non_finite, &LIMITS),
            Err(CanError::NotFinite { field: "kp" })
        );
        let non_finite = Motion {
            position_rad: 0.0,
            velocity_rad_s: f64::NAN,
            torque_nm: 0.0,
        };
        assert_eq!(
            encode_motion(&non_finite, &LIMITS),
            Err(CanError::NotFinite {
                field: "the velocity"
            })
        );
    }
}
