//! One motor that was found on its bus, and the readings of its joint.

use super::config::MotorConfig;
use super::family::{MAX_REPORT, MotorProtocol, MotorReading, Reports};
use super::frame_io::FrameIo;
use super::query::MotorQuery;
use crate::Error;
use crate::wire::can::Frame;
use crate::wire::can::mit::Limits;

/// Maximum plausible position (rad) or velocity (rad/s) of a joint. Readings with greater values
/// are ignored. The limit is far beyond every motor, and small enough that computations with the
/// values stay finite. Corrupted floating-point values are mostly much larger.
pub(super) const MAX_RAD: f64 = 1e4;

/// Position, velocity and effort of a joint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Reading {
    pub(super) position_rad: f64,
    pub(super) velocity_rad_s: f64,
    pub(super) effort_nm: Option<f64>,
}

/// A motor that was found on its bus.
#[derive(Clone, Debug)]
pub(super) struct Motor {
    config: MotorConfig,
    limits: Limits,
}

impl Motor {
    /// Makes the motor report its position, and waits for the first report.
    pub(super) fn set_up(bus: &dyn FrameIo, config: &MotorConfig) -> Result<Self, Error> {
        let motor = Self::set_up_for_motion(bus, config)?;
        // A motor that reports only when commanded is silent until another master commands it. If
        // it does not report, the error names this cause.
        if let Reports::WhenCommanded { if_silent } = config.protocol.reports() {
            motor.wait_for_reading(&MotorQuery::new(bus, &config.joint), if_silent)?;
        }
        Ok(motor)
    }

    /// Like [`Motor::set_up`], but does not wait for a motor that reports only when commanded,
    /// because no node commands it yet.
    pub(super) fn set_up_for_motion(
        bus: &dyn FrameIo,
        config: &MotorConfig,
    ) -> Result<Self, Error> {
        let query = MotorQuery::new(bus, &config.joint);
        // The ranges come first: without them, the raw values of a report have no meaning.
        let limits = config.protocol.set_up(&query)?;
        let motor = Self::with_limits(config.clone(), limits);
        // A motor that is polled has already answered the queries of its set-up. A motor that sends
        // unsolicited reports may not have sent a frame yet.
        if let Reports::Unasked { if_silent } = config.protocol.reports() {
            motor.wait_for_reading(&query, if_silent)?;
        }
        Ok(motor)
    }

    /// Creates a motor with these ranges of raw values.
    pub(super) fn with_limits(config: MotorConfig, limits: Limits) -> Self {
        Self { config, limits }
    }

    pub(super) fn config(&self) -> &MotorConfig {
        &self.config
    }

    pub(super) fn protocol(&self) -> &dyn MotorProtocol {
        &*self.config.protocol
    }

    /// Ranges of its raw values.
    pub(super) fn limits(&self) -> &Limits {
        &self.limits
    }

    /// Turns of the joint per turn of the motor; negative if they turn in opposite directions.
    pub(super) fn per_turn(&self) -> f64 {
        let direction = if self.config.is_reversed { -1.0 } else { 1.0 };
        direction / self.config.gear_ratio
    }

    /// Decodes the reading of the joint in a frame; `None` if the frame comes from another motor or
    /// has other content.
    pub(super) fn read(&self, frame: &Frame) -> Option<Reading> {
        let MotorReading {
            position_rad,
            velocity_rad_s,
            torque_nm,
        } = self.protocol().read(frame, &self.limits)?;
        // A gear divides position and velocity and multiplies the torque. Dividing by the signed
        // ratio also reverses the torque of a reversed motor.
        let per_turn = self.per_turn();
        let reading = Reading {
            position_rad: position_rad * per_turn + self.config.offset_rad,
            velocity_rad_s: velocity_rad_s * per_turn,
            effort_nm: torque_nm.map(|torque| torque / per_turn),
        };
        (reading.position_rad.abs() <= MAX_RAD && reading.velocity_rad_s.abs() <= MAX_RAD)
            .then_some(reading)
    }

    /// Waits for the first reading.
    fn wait_for_reading(&self, query: &MotorQuery<'_>, timeout_reason: &str) -> Result<(), Error> {
        query
            .wait(MAX_REPORT, |frame| self.read(frame))?
            .map(drop)
            .ok_or_else(|| query.fault(timeout_reason))
    }
}
