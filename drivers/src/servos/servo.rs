//! One servo of an arm: converts between counts of the servo and positions of its joint.

use super::bus::ServoBus;
use super::config::{ServoArmConfig, ServoConfig};
use super::packet::Status;
use super::protocol::{COUNTS_PER_TURN, Feedback, ServoError, ServoInfo, ServoProtocol};
use crate::Error;
use std::f64::consts::TAU;
use std::path::Path;

/// Position and velocity of a joint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Reading {
    /// Position, rad or m.
    pub(super) position_rad: f64,
    /// Velocity, rad/s or m/s.
    pub(super) velocity_rad_s: f64,
}

/// A servo that was found on the bus.
#[derive(Clone, Debug)]
pub(super) struct Servo {
    pub(super) config: ServoConfig,
    pub(super) info: ServoInfo,
}

impl Servo {
    /// Finds all servos of an arm.
    ///
    /// # Errors
    /// If a servo does not answer or is not supported.
    pub(super) fn find_all(bus: &mut ServoBus, arm: &ServoArmConfig) -> Result<Vec<Self>, Error> {
        let mut servos = Vec::new();
        for config in &arm.servos {
            let info = arm
                .protocol
                .identify(bus, config.id)
                .map_err(|error| servo_error(config, bus.device(), error))?;
            log::info!("joint {:?}: {}, ID {}", config.joint, info.model, config.id);
            let config = config.clone();
            servos.push(Self { config, info });
        }
        if arm.protocol.has_fast_reads() {
            let block = arm.protocol.feedback_block();
            bus.probe_fast_reads(block.address, block.len, &arm.ids())?;
        }
        Ok(servos)
    }

    /// The reading in an answer; `None` if it contains none.
    pub(super) fn reading(&self, protocol: &dyn ServoProtocol, status: &Status) -> Option<Reading> {
        let Feedback {
            position_counts,
            velocity,
        } = protocol.feedback(&status.data)?;
        Some(Reading {
            position_rad: self.position_rad(position_counts),
            velocity_rad_s: f64::from(velocity)
                * self.info.velocity_unit_counts_s
                * self.rad_per_count(),
        })
    }

    /// Joint position at a position of the servo, rad.
    fn position_rad(&self, counts: i32) -> f64 {
        let turned = counts - self.config.zero_counts;
        // The encoder jumps by one turn at the end of its range, wherever that is in the range of
        // the joint. A joint without a gear turns by at most half a turn from its zero.
        let is_single_turn = (0..COUNTS_PER_TURN).contains(&counts);
        let has_gear = (self.config.gear_ratio - 1.0).abs() > f64::EPSILON;
        let turned = if is_single_turn && !has_gear {
            let half = COUNTS_PER_TURN / 2;
            (turned + half).rem_euclid(COUNTS_PER_TURN) - half
        } else {
            turned
        };
        f64::from(turned) * self.rad_per_count()
    }

    /// Position of the servo at a joint position, within the range of the servo.
    pub(super) fn counts(&self, position_rad: f64) -> i32 {
        let [lower, upper] = self.info.range_counts;
        #[expect(
            clippy::cast_possible_truncation,
            reason = "the cast saturates, and the result is clamped"
        )]
        let turned = (position_rad / self.rad_per_count()).round() as i32;
        self.config
            .zero_counts
            .saturating_add(turned)
            .clamp(lower, upper.max(lower))
    }

    /// Range of the joint that the servo accepts, rad.
    pub(super) fn range_rad(&self) -> [f64; 2] {
        let ends = self
            .info
            .range_counts
            .map(|counts| f64::from(counts - self.config.zero_counts) * self.rad_per_count());
        [ends[0].min(ends[1]), ends[0].max(ends[1])]
    }

    /// Speed of the servo at a speed of the joint, counts/s.
    pub(super) fn counts_s(&self, speed_rad_s: f64) -> f64 {
        (speed_rad_s / self.rad_per_count()).abs()
    }

    fn rad_per_count(&self) -> f64 {
        let direction = if self.config.is_reversed { -1.0 } else { 1.0 };
        direction * TAU / f64::from(COUNTS_PER_TURN) / self.config.gear_ratio
    }
}

/// The error of a servo, with the name of its joint.
pub(super) fn servo_error(config: &ServoConfig, device: &Path, error: ServoError) -> Error {
    match error {
        ServoError::Port(error) => error,
        ServoError::Servo(reason) => joint_error(config, device, reason),
    }
}

/// An error of the servo of a joint.
pub(super) fn joint_error(config: &ServoConfig, device: &Path, reason: String) -> Error {
    Error::Motor {
        joint: config.joint.clone(),
        interface: device.display().to_string(),
        reason,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::FollowingLimits;
    use std::f64::consts::PI;

    fn servo(zero_counts: i32, is_reversed: bool, gear_ratio: f64) -> Servo {
        Servo {
            config: ServoConfig {
                joint: "elbow".to_owned(),
                id: 3,
                zero_counts,
                is_reversed,
                gear_ratio,
                following: FollowingLimits::default(),
            },
            info: ServoInfo {
                model: "any".to_owned(),
                range_counts: [0, 4095],
                velocity_unit_counts_s: 50.0,
                mode_problem: None,
            },
        }
    }

    /// Half of the resolution of a servo, rad.
    const RESOLUTION_RAD: f64 = PI / 4096.0;

    #[test]
    fn goal_of_a_reported_position_is_that_position() {
        for (zero, is_reversed, gear_ratio) in
            [(2048, false, 1.0), (1000, true, 1.0), (2048, true, 3.0)]
        {
            let servo = servo(zero, is_reversed, gear_ratio);
            for counts in [0, 17, 2048, 3000] {
                let position_rad = servo.position_rad(counts);
                assert_eq!(servo.counts(position_rad), counts, "{zero} {gear_ratio}");
            }
        }
    }

    #[test]
    fn direction_zero_and_gear_are_applied() {
        let quarter = servo(2048, true, 2.0).position_rad(3072);
        assert!((quarter + PI / 4.0).abs() < 1e-12, "{quarter}");
        let [lower, upper] = servo(1024, true, 1.0).range_rad();
        assert!((upper - PI / 2.0).abs() < 1e-12 && (lower + 3071.0 * PI / 2048.0).abs() < 1e-12);
        assert!((servo(0, true, 2.0).counts_s(PI) - 4096.0).abs() < 1e-9);
    }

    #[test]
    fn jump_of_the_encoder_is_not_a_jump_of_the_joint() {
        let servo = servo(100, false, 1.0);
        let before = servo.position_rad(4095);
        let after = servo.position_rad(0);
        assert!((after - before - 2.0 * RESOLUTION_RAD).abs() < 1e-12);
        // The servo cannot move across the jump, so its goal stays at the end of its range.
        assert_eq!(servo.counts(before), 0);
    }
}
