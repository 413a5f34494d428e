//! One motor that may be moved: prepares it while it is disabled, encodes its commands in each
//! cycle, and tracks the health that it reports.
//!
//! Positions are sent as planned, with their velocity as feedforward where the protocol supports
//! it. Commands to motors in MIT mode contain the stiffness and damping of the rig file; other
//! motors keep the gains stored in them.

use super::config::MotorConfig;
use super::family::{Health, MotionProtocol};
use super::frame_io::FrameIo;
use super::motor::{Motor, Reading};
use super::query::MotorQuery;
use super::watchdog::WatchdogPlan;
use crate::Error;
use crate::motion::{MotionLimits, OnLoss};
use crate::wire::can::mit::Command;
use crate::wire::can::{CanError, Frame};
use std::time::Duration;

/// A motor that may be moved. It stays disabled until it receives the frames of
/// [`MovableMotor::enable`] or, in families that have no such frames, its first command.
#[derive(Debug)]
pub(super) struct MovableMotor {
    motor: Motor,
    motion: Box<dyn MotionProtocol>,
    health: Option<Health>,
}

impl MovableMotor {
    /// Finds the motor of `config`, disables it, clears its faults, and sets its watchdog and its
    /// mode. Verifies the watchdog, and the mode if the family reports it.
    pub(super) fn prepare(
        bus: &dyn FrameIo,
        config: &MotorConfig,
        plan: &WatchdogPlan,
    ) -> Result<Self, Error> {
        let movable_motor = Self::new(Motor::set_up_for_motion(bus, config)?);
        let query = MotorQuery::new(bus, &config.joint);
        // The order matters. Gains are checked before anything is changed. The motor is disabled
        // before its mode changes, because its last command would have a different meaning in
        // another mode. A motor stays disabled if its watchdog reads back differently.
        movable_motor.check_gains(&query)?;
        movable_motor.motion.switch_off(&query)?;
        movable_motor.motion.set_watchdog(&query, plan)?;
        movable_motor.motion.set_mode(&query, plan)?;
        Ok(movable_motor)
    }

    fn new(motor: Motor) -> Self {
        Self {
            motion: motor.protocol().motion(motor.limits()),
            motor,
            health: None,
        }
    }

    pub(super) fn config(&self) -> &MotorConfig {
        self.motor.config()
    }

    /// The part of the motor that only reads.
    pub(super) fn motor(&self) -> &Motor {
        &self.motor
    }

    pub(super) fn health(&self) -> Option<&Health> {
        self.health.as_ref()
    }

    /// Discards the last reported health.
    pub(super) fn clear_health(&mut self) {
        self.health = None;
    }

    /// The limits of the joint, clipped to the range that the motor's protocol can encode.
    pub(super) fn limits(&self, joint: &MotionLimits) -> MotionLimits {
        let config = self.motor.config();
        let per_turn = self.motor.per_turn();
        let range = self.motor.limits();
        // Commands in MIT mode are clamped silently to this range. If a target were beyond the
        // range, the joint would stop before it, with a growing following error.
        let max = range.position_rad * per_turn.abs();
        let [lower, upper] = joint.position;
        MotionLimits {
            position: [
                lower.max(config.offset_rad - max),
                upper.min(config.offset_rad + max),
            ],
            velocity: joint.velocity.min(range.velocity_rad_s * per_turn.abs()),
            ..*joint
        }
    }

    /// How long the motor may be silent before it counts as lost. `default_limit` applies to most
    /// families.
    pub(super) fn max_silence(&self, default_limit: Duration) -> Duration {
        self.motion.max_silence(default_limit)
    }

    /// The frame that polls the position of the disabled motor; `None` if the motor sends
    /// unsolicited reports or reports on every SYNC.
    pub(super) fn poll_frame(&self) -> Option<Frame> {
        self.motion
            .poll_disabled()
            .or_else(|| self.motor.protocol().poll_frame())
    }

    /// Frames that enable the motor; empty if its first command enables it.
    pub(super) fn enable(&self) -> Result<Vec<Frame>, CanError> {
        self.motion.enable()
    }

    /// The frame that commands a position and velocity of the joint, rad and rad/s.
    pub(super) fn command(
        &self,
        position_rad: f64,
        velocity_rad_s: f64,
    ) -> Result<Frame, CanError> {
        self.motion
            .command(&self.motor_command(position_rad, velocity_rad_s))
    }

    /// Converts a joint position and velocity to a command in motor coordinates.
    fn motor_command(&self, position_rad: f64, velocity_rad_s: f64) -> Command {
        let per_turn = self.motor.per_turn();
        let [kp_nm_rad, kd_nm_s_rad] = self.gains().unwrap_or([0.0; 2]);
        Command {
            // This is the inverse of `Motor::read`. A motor that receives its own reading as a
            // command thus stays where it is.
            position_rad: (position_rad - self.motor.config().offset_rad) / per_turn,
            velocity_rad_s: velocity_rad_s / per_turn,
            kp_nm_rad,
            kd_nm_s_rad,
            // There is no dynamic model of the arm, so only the stiffness counteracts gravity.
            torque_nm: 0.0,
        }
    }

    /// The fail-safe command. After it, the motor does what `on_loss` specifies, without further
    /// commands. `position_rad` is the last commanded position of the joint.
    pub(super) fn shutdown(&self, on_loss: OnLoss, position_rad: f64) -> Result<Frame, CanError> {
        // The velocity is 0, so that a moving joint comes to rest at this position or is damped.
        let command = self.motor_command(position_rad, 0.0);
        match on_loss {
            OnLoss::Release => self.motion.release(),
            OnLoss::Hold => self.motion.hold(&command),
            // Without stiffness, the command resists motion and has no position to return to.
            OnLoss::Damp => self.motion.command(&Command {
                kp_nm_rad: 0.0,
                ..command
            }),
        }
    }

    /// Updates the motor's health from a frame. Returns the reading of the joint if the frame
    /// contains one.
    pub(super) fn process_frame(&mut self, frame: &Frame) -> Option<Reading> {
        // A frame may report health, a reading or both, depending on the family.
        if let Some(health) = self.motion.health(frame) {
            self.health = Some(health);
        }
        self.motor.read(frame)
    }

    /// Stiffness and damping at the motor: those of the joint, divided by the square of the gear
    /// ratio.
    fn gains(&self) -> Option<[f64; 2]> {
        // With `n` motor turns per joint turn, the position error at the motor is `n` times that at
        // the joint. The torque at the joint is `n` times that of the motor. The stiffness at the
        // motor is therefore `1 / n²` of the stiffness at the joint.
        let squared = self.motor.per_turn().powi(2);
        let gains = self.motor.config().gains?;
        Some([
            gains.stiffness_nm_rad * squared,
            gains.damping_nm_s_rad * squared,
        ])
    }

    /// Checks that the protocol can encode the gains, because larger values would be clamped
    /// silently.
    fn check_gains(&self, query: &MotorQuery<'_>) -> Result<(), Error> {
        let Some([kp, kd]) = self.gains() else {
            return Ok(());
        };
        let max = self.motor.limits();
        if kp <= max.kp_nm_rad && kd <= max.kd_nm_s_rad {
            Ok(())
        } else {
            Err(query.fault(format!(
                "stiffness and damping at the motor are {kp} N m / rad and {kd} N m s / rad, but its protocol supports at most {} and {}",
                max.kp_nm_rad, max.kd_nm_s_rad
            )))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::cia402::{Cia402, Units, codec::State};
    use super::super::config::{FollowingLimits, Gains};
    use super::super::damiao::Damiao;
    use super::super::family::MotorProtocol;
    use super::*;
    use crate::wire::can::canopen::{Direction, Node, Pdo};
    use crate::wire::can::mit::{self, Limits};
    use std::sync::Arc;

    const LIMITS: Limits = Limits::of(12.5, 30.0, 10.0);

    /// A motor with a gear ratio of 4 that turns opposite to its joint.
    fn movable_motor(protocol: impl MotorProtocol + 'static) -> MovableMotor {
        let config = MotorConfig {
            joint: "elbow".to_owned(),
            bus_ix: 0,
            protocol: Arc::new(protocol),
            gear_ratio: 4.0,
            is_reversed: true,
            offset_rad: 0.5,
            gains: Some(Gains {
                stiffness_nm_rad: 160.0,
                damping_nm_s_rad: 16.0,
            }),
            following: FollowingLimits::default(),
        };
        MovableMotor::new(Motor::with_limits(config, LIMITS))
    }

    fn damiao() -> MovableMotor {
        movable_motor(Damiao {
            motor: 1,
            feedback: 0x11,
        })
    }

    #[test]
    fn commands_are_in_motor_coordinates() {
        let sent = damiao().command(1.0, 0.25).expect("numbers");
        let got = mit::decode(sent.data().try_into().expect("eight bytes"), &LIMITS);
        // The tolerances are half a quantization step: 16 bits for the position, 12 bits for
        // velocity and gains.
        assert!(
            (got.position_rad + 2.0).abs() < 2e-4 && (got.velocity_rad_s + 1.0).abs() < 8e-3,
            "{got:?}"
        );
        assert!(
            (got.kp_nm_rad - 10.0).abs() < 0.07 && (got.kd_nm_s_rad - 1.0).abs() < 7e-4,
            "{got:?}"
        );
        assert!(got.torque_nm.abs() < 3e-3, "{got:?}");
        let damping_frame = damiao().shutdown(OnLoss::Damp, 1.0).expect("numbers");
        let got = mit::decode(
            damping_frame.data().try_into().expect("eight bytes"),
            &LIMITS,
        );
        assert!(
            got.kp_nm_rad == 0.0 && (got.kd_nm_s_rad - 1.0).abs() < 7e-4,
            "{got:?}"
        );
    }

    #[test]
    fn joint_limits_are_clamped_to_motor_range() {
        let wide = MotionLimits {
            position: [-9.0, f64::INFINITY],
            velocity: 20.0,
            acceleration: 1.0,
            jerk: 1.0,
        };
        let limits = damiao().limits(&wide);
        assert_eq!(
            (limits.position, limits.velocity),
            ([0.5 - 3.125, 0.5 + 3.125], 7.5)
        );
        let narrow = MotionLimits {
            position: [-1.0, 1.0],
            velocity: 0.5,
            acceleration: 1.0,
            jerk: 1.0,
        };
        assert_eq!(damiao().limits(&narrow), narrow);
    }

    #[test]
    fn commands_enable_drive_but_do_not_reset_faults() {
        let node = Node::new(5).expect("a node");
        let units = Units {
            counts_per_turn: 65_536.0,
            rated_torque_nm: 1.0,
        };
        let mut drive = movable_motor(Cia402 { node, units });
        let mut process_state = |state: State| {
            let id = Pdo::Second.id(Direction::Transmit, node);
            let reported =
                Frame::classic(id, &state.statusword().to_le_bytes()).expect("two bytes");
            assert_eq!(
                drive.process_frame(&reported),
                None,
                "a statusword is not a position"
            );
            let command = drive.command(0.5, 0.0).expect("numbers");
            assert_eq!(
                (command.id(), &command.data()[2..]),
                (Pdo::First.id(Direction::Receive, node), &[0; 4][..])
            );
            (command.data()[0], drive.health().cloned())
        };
        assert_eq!(
            process_state(State::SwitchOnDisabled),
            (0x06, Some(Health::Off))
        );
        assert_eq!(
            process_state(State::ReadyToSwitchOn),
            (0x07, Some(Health::Off))
        );
        assert_eq!(process_state(State::SwitchedOn), (0x0F, Some(Health::Off)));
        assert_eq!(
            process_state(State::OperationEnabled),
            (0x0F, Some(Health::Enabled))
        );
        for state in [State::Fault, State::QuickStopActive] {
            let (controlword, health) = process_state(state);
            assert!(
                controlword == 0 && matches!(health, Some(Health::Fault(_))),
                "{state:?} {health:?}"
            );
        }
    }
}
