//! Configuration of buses, motors and arms.

use super::family::MotorProtocol;
use crate::motion::MotionConfig;
use crate::wire::can::frame::BitRates;
use std::sync::Arc;

/// Configuration of an arm from the rig file.
#[derive(Clone, Debug, PartialEq)]
pub struct ArmConfig {
    /// The buses of the arm.
    pub buses: Vec<BusConfig>,
    /// One motor per joint, in the order of the readings.
    pub motors: Vec<MotorConfig>,
    /// Rate at which motors are polled, in Hz. It is reduced if the load of a bus would exceed 70
    /// %.
    pub rate_hz: f64,
}

/// Configuration of an arm that may be moved.
#[derive(Clone, Debug, PartialEq)]
pub struct MovableArmConfig {
    /// Buses and motors. Motors in MIT mode need their gains.
    pub arm: ArmConfig,
    /// Limits of each joint, in the order of the motors, and the fail-safe behavior if this
    /// computer stops sending.
    pub motion: MotionConfig,
}

/// Configuration of a bus from the rig file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BusConfig {
    /// Name of the interface, for instance `can0`.
    pub interface: String,
    /// Bit rate, bit/s.
    pub bitrate_hz: u32,
    /// Bit rate of the data phase of FD frames, bit/s; `None` on a classic bus.
    pub data_bitrate_hz: Option<u32>,
    /// Whether to accept an adapter that the kernel cannot restart, such as a serial-line adapter
    /// (`slcan`). After a bus-off, such an adapter stays bus-off.
    pub accept_no_restart: bool,
}

impl BusConfig {
    /// Nominal and data bit rate.
    pub fn rates(&self) -> BitRates {
        let nominal_hz = f64::from(self.bitrate_hz);
        BitRates {
            nominal_hz,
            data_hz: self.data_bitrate_hz.map_or(nominal_hz, f64::from),
        }
    }
}

/// A motor and its joint: `joint = direction * motor / gear_ratio + offset_rad`, where the
/// direction is -1 if the motor is reversed.
#[derive(Clone, Debug)]
pub struct MotorConfig {
    /// Name of the joint that it moves.
    pub joint: String,
    /// Index of its bus in [`ArmConfig::buses`].
    pub bus_ix: usize,
    /// Its protocol, and its address on the bus.
    pub protocol: Arc<dyn MotorProtocol>,
    /// Turns that the motor reports per turn of the joint. It is 1 if the motor reports the angle
    /// of its output shaft and drives the joint directly.
    pub gear_ratio: f64,
    /// Whether it turns in the opposite direction to its joint.
    pub is_reversed: bool,
    /// Joint angle at which the motor reports 0, rad.
    pub offset_rad: f64,
    /// Gains for families whose commands include them (MIT mode); `None` if the motor is only read.
    pub gains: Option<Gains>,
    /// Following limits of this joint.
    pub following: FollowingLimits,
}

// This is not derived, because the derived code would move the trait object (rust-lang/rust#31740).
impl PartialEq for MotorConfig {
    fn eq(&self, other: &Self) -> bool {
        let Self {
            joint,
            bus_ix,
            protocol,
            gear_ratio,
            is_reversed,
            offset_rad,
            gains,
            following,
        } = self;
        protocol.as_ref() == other.protocol.as_ref()
            && (joint, bus_ix, is_reversed) == (&other.joint, &other.bus_ix, &other.is_reversed)
            && (gear_ratio, offset_rad) == (&other.gear_ratio, &other.offset_rad)
            && (gains, following) == (&other.gains, &other.following)
    }
}

/// Stiffness and damping of a joint. A motor in front of a gear gets both divided by the square of
/// the gear ratio.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gains {
    /// Torque per position error, N m / rad of the joint.
    pub stiffness_nm_rad: f64,
    /// Torque per velocity error, N m s / rad of the joint.
    pub damping_nm_s_rad: f64,
}

/// Limits beyond which a joint counts as blocked, and the arm stops.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FollowingLimits {
    /// Following error: largest difference between the commanded and the reported position, rad or
    /// m.
    pub max_error_rad: f64,
    /// Largest effort that the motor may report, N m or N at the joint; `None` if it is not
    /// limited.
    pub max_effort_nm: Option<f64>,
    /// Whether these limits are disabled.
    pub is_off: bool,
}

impl Default for FollowingLimits {
    fn default() -> Self {
        Self {
            // With a stiffness of 30 N m / rad, a motor pushes against an obstacle with 6 N m at
            // this error. A smaller default would stop loaded or fast joints, which lag their
            // commands.
            max_error_rad: 0.2,
            max_effort_nm: None,
            is_off: false,
        }
    }
}

impl FollowingLimits {
    /// Describes the exceeded limit; `None` if there is none.
    pub(crate) fn violation(
        &self,
        commanded_rad: f64,
        position_rad: f64,
        effort_nm: Option<f64>,
    ) -> Option<String> {
        if self.is_off {
            return None;
        }
        // The position comes first: every family reports it, but not every family reports an
        // effort.
        let error_rad = (commanded_rad - position_rad).abs();
        if error_rad > self.max_error_rad {
            return Some(format!(
                "it is {error_rad:.3} rad from its commanded position, and max_following_error_rad is {}: the joint is blocked, or its stiffness is too \
                 low for its load",
                self.max_error_rad
            ));
        }
        // Without a reported effort or a configured limit, no limit can be exceeded.
        let effort_nm = effort_nm?.abs();
        let max_effort_nm = self.max_effort_nm?;
        (effort_nm > max_effort_nm).then(|| {
            format!("its effort is {effort_nm:.2} N m, and max_effort_nm is {max_effort_nm}: the joint is blocked or overloaded")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joint_is_blocked_beyond_either_limit() {
        let limits = FollowingLimits {
            max_error_rad: 0.1,
            max_effort_nm: Some(4.0),
            is_off: false,
        };
        assert_eq!(limits.violation(0.5, 0.41, Some(-3.9)), None);
        let error = limits
            .violation(0.5, 0.39, None)
            .expect("the position is too far");
        assert!(
            error.contains("0.110 rad") && error.contains("max_following_error_rad is 0.1"),
            "{error}"
        );
        let effort = limits
            .violation(0.5, 0.5, Some(-4.1))
            .expect("the effort is too large");
        assert!(
            effort.contains("4.10 N m") && effort.contains("max_effort_nm is 4"),
            "{effort}"
        );
        assert_eq!(
            FollowingLimits {
                max_effort_nm: None,
                ..limits
            }
            .violation(0.5, 0.5, Some(99.0)),
            None
        );
        assert_eq!(
            FollowingLimits {
                is_off: true,
                ..limits
            }
            .violation(0.0, 9.0, Some(99.0)),
            None
        );
    }
}
