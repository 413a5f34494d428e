//! The interface of motor families: the traits through which the code for whole arms accesses a
//! family, one of its motors, and the motion of that motor.

#[cfg(feature = "emulation")]
use super::emulated::EmulatedProtocol;
use super::query::MotorQuery;
use super::settings::{MotorKey, MotorSettings};
use super::watchdog::{Watchdog, WatchdogPlan};
use crate::Error;
use crate::wire::can::mit::{Command, Limits, Motion};
use crate::wire::can::{CanError, Frame, Id, canopen};
use std::fmt::Debug;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

/// Maximum time until the first report of a motor that sends unsolicited reports. The least
/// frequent report is the heartbeat of CANopen drives, which is sent every 500 ms. The limit allows
/// for one lost heartbeat.
pub(super) const MAX_REPORT: Duration = Duration::from_secs(1);
/// Maximum time for a motor to report that it is disabled, or in another mode.
pub(super) const MAX_CHANGE: Duration = Duration::from_secs(1);
/// Fault of a motor whose watchdog has expired.
pub(super) const COMMUNICATION_LOST: &str = "it received no command for longer than its timeout";
/// Ranges for motors whose values need no scaling. If such motors have gains, the gains have the
/// usual ranges.
pub(super) const UNLIMITED: Limits = Limits::of(f64::INFINITY, f64::INFINITY, f64::INFINITY);

/// Motors that share a protocol.
pub trait MotorFamily: Debug + Sync {
    /// Name in rig files.
    fn name(&self) -> &'static str;
    /// Name of the manufacturer or standard, for messages.
    fn title(&self) -> &'static str;
    /// Allowed values of the key `id`.
    fn ids(&self) -> RangeInclusive<u64>;
    /// Keys in rig files that motors of other families do not have.
    fn keys(&self) -> Vec<MotorKey> {
        Vec::new()
    }
    /// Whether each command includes stiffness and damping (MIT mode). Other motors keep the gains
    /// stored in them.
    fn has_gains(&self) -> bool;
    /// Creates the motor with these settings. Returns `None` if a required setting is missing.
    fn motor(&self, settings: &MotorSettings) -> Option<Arc<dyn MotorProtocol>>;
    /// Frames to which motors of this family answer with their ID, and which have no other effect
    /// on any motor. Empty if the family has no such requests.
    fn identification_requests(&self) -> Vec<Frame> {
        Vec::new()
    }
    /// The ID and other settings of the motor that sent a frame. `None` if the frame does not show
    /// that its sender belongs to this family.
    fn identify(&self, _frame: &Frame) -> Option<MotorSettings> {
        None
    }
    /// Data for fuzzing and its tests.
    #[cfg(any(test, fuzzing))]
    fn fuzzing(&self) -> FamilyFuzzing;
}

/// One motor: its address on the bus, and the code that reads it.
///
/// Reading never sends a motion command; only [`MotionProtocol`] does.
pub trait MotorProtocol: Debug + Send + Sync {
    /// The family, which defines names and limits for rig files.
    fn family(&self) -> &'static dyn MotorFamily;
    /// The settings from which [`MotorFamily::motor`] creates an equal motor.
    fn settings(&self) -> MotorSettings;
    /// IDs that no other motor of the family may use on the same bus.
    fn addresses(&self) -> Vec<u32>;
    /// Ranges of the motor's raw values. A range is infinite if the value is not limited. `None` if
    /// [`MotorProtocol::set_up`] reads the ranges from the motor.
    fn ranges(&self) -> Option<Limits>;
    /// Node ID, if the motor is a CANopen node. Such a motor reports and accepts targets on each
    /// SYNC, and monitors our heartbeat.
    fn canopen_node(&self) -> Option<canopen::Node> {
        None
    }

    /// Makes the motor report its position, and returns the ranges of its raw values.
    ///
    /// # Errors
    /// If the motor does not answer as expected.
    fn set_up(&self, query: &MotorQuery<'_>) -> Result<Limits, Error>;
    /// When the motor reports its position after [`MotorProtocol::set_up`].
    fn reports(&self) -> Reports;
    /// The frame that polls its position in each cycle; `None` if the motor sends unsolicited
    /// reports or reports on every SYNC.
    fn poll_frame(&self) -> Option<Frame> {
        None
    }
    /// A frame of the same size as the motor's position reports. If the motor determines the rate
    /// of its reports, the rate in Hz is also returned.
    fn typical_answer(&self) -> (Frame, Option<f64>);
    /// The reading in a frame; `None` if the frame is from another motor or has other content.
    fn read(&self, frame: &Frame, limits: &Limits) -> Option<MotorReading>;

    /// Traffic on its bus while it moves.
    fn traffic(&self) -> Traffic;
    /// Ability of the motor to detect missing commands.
    fn watchdog(&self) -> Watchdog;
    /// The protocol that moves the motor. `limits` are the ranges of its raw values.
    fn motion(&self, limits: &Limits) -> Box<dyn MotionProtocol>;

    /// The motor's side of the protocol.
    #[cfg(feature = "emulation")]
    fn emulated(&self) -> Box<dyn EmulatedProtocol>;
}

/// Moves one motor. The motor is disabled until it receives the frames of
/// [`MotionProtocol::enable`] or, if there are none, its first command.
pub trait MotionProtocol: Debug + Send {
    /// Disables the motor, and clears its faults after logging them.
    ///
    /// # Errors
    /// If the motor does not report that it is disabled.
    fn switch_off(&self, query: &MotorQuery<'_>) -> Result<(), Error>;
    /// Sets and verifies the watchdog of the disabled motor.
    ///
    /// # Errors
    /// If a value reads back differently.
    fn set_watchdog(&self, query: &MotorQuery<'_>, plan: &WatchdogPlan) -> Result<(), Error>;
    /// Sets the control mode, which determines the meaning of commands.
    ///
    /// # Errors
    /// If the motor does not support the mode, or reports another one.
    fn set_mode(&self, query: &MotorQuery<'_>, plan: &WatchdogPlan) -> Result<(), Error>;

    /// The frame that polls the position of the disabled motor, if it differs from
    /// [`MotorProtocol::poll_frame`].
    fn poll_disabled(&self) -> Option<Frame> {
        None
    }
    /// Frames that enable the motor; empty if its first command enables it.
    fn enable(&self) -> Result<Vec<Frame>, CanError>;
    /// The frame of a command in motor coordinates.
    fn command(&self, command: &Command) -> Result<Frame, CanError>;
    /// The frame that makes the motor hold this position without further commands.
    fn hold(&self, command: &Command) -> Result<Frame, CanError> {
        self.command(command)
    }
    /// The frame that disables the motor.
    fn release(&self) -> Result<Frame, CanError>;
    /// The health that a frame reports; `None` if the frame contains none or comes from another
    /// motor.
    fn health(&mut self, frame: &Frame) -> Option<Health>;
    /// How long the motor may be silent before it counts as lost. `default_limit` applies to most
    /// families.
    fn max_silence(&self, default_limit: Duration) -> Duration {
        default_limit
    }
}

impl dyn MotorProtocol {
    /// Whether the two motors would have conflicting IDs on the same bus.
    pub fn conflicts_with(&self, other: &Self) -> bool {
        // Families use different parts of the identifier, so their numbers cannot be compared.
        let theirs = other.addresses();
        self.family().name() == other.family().name()
            && self
                .addresses()
                .iter()
                .any(|address| theirs.contains(address))
    }
}

impl PartialEq for dyn MotorProtocol {
    fn eq(&self, other: &Self) -> bool {
        self.family().name() == other.family().name() && self.settings() == other.settings()
    }
}

/// Position, velocity and torque of a motor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotorReading {
    /// Position of the reported shaft, rad.
    pub position_rad: f64,
    /// Its velocity, rad/s.
    pub velocity_rad_s: f64,
    /// Its torque, N m; `None` if the motor does not report it.
    pub torque_nm: Option<f64>,
}

impl From<Motion> for MotorReading {
    fn from(motion: Motion) -> Self {
        let Motion {
            position_rad,
            velocity_rad_s,
            torque_nm,
        } = motion;
        Self {
            position_rad,
            velocity_rad_s,
            torque_nm: Some(torque_nm),
        }
    }
}

/// The occasion on which a motor reports its position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reports {
    /// When the motor is polled, or on a SYNC.
    WhenPolled,
    /// Periodically, without being polled.
    Unasked {
        /// What to check if the motor does not report.
        if_silent: &'static str,
    },
    /// In reply to each command.
    WhenCommanded {
        /// What to check if the motor does not report.
        if_silent: &'static str,
    },
}

/// State of a motor according to its last report.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Health {
    /// The motor is disabled.
    Off,
    /// The motor is enabled and follows commands.
    Enabled,
    /// The motor stopped because of a fault.
    Fault(String),
}

/// Frames sent and received while a motor moves.
#[derive(Clone, Debug, PartialEq)]
pub struct Traffic {
    /// Frames of each cycle.
    pub cycle_frames: Vec<Frame>,
    /// Other frames, with their rate in Hz.
    pub unsolicited: Vec<(Frame, f64)>,
}

/// A frame of eight bytes, to calculate the load of a bus.
pub(super) fn frame_of_8_bytes(id: Id) -> Frame {
    Frame::classic(id, &[0; 8]).expect("eight bytes")
}

/// A frame of eight bytes with an 11-bit identifier.
pub(super) fn short_frame() -> Frame {
    frame_of_8_bytes(Id::standard(0).expect("0 is a valid identifier"))
}

/// Ranges of the raw values of fuzzed motors that report them.
#[cfg(any(test, fuzzing))]
pub(super) const LIMITS: Limits = Limits::of(12.5, 30.0, 10.0);
/// A command to move away stiffly.
#[cfg(any(test, fuzzing))]
pub(super) const STIFF_COMMAND: Command = Command {
    position_rad: 1.0,
    velocity_rad_s: 0.0,
    kp_nm_rad: 200.0,
    kd_nm_s_rad: 2.0,
    torque_nm: 0.0,
};

/// Data of a family for fuzzing and its tests.
#[cfg(any(test, fuzzing))]
#[derive(Debug)]
pub struct FamilyFuzzing {
    /// An example of a motor.
    pub motor: Arc<dyn MotorProtocol>,
    /// Runs the family's codecs on a frame.
    pub run_codecs: fn(&Frame),
    /// Frames with which the driver makes the motor report.
    pub set_up: Vec<Frame>,
    /// A motion command with high stiffness. It does not enable the motor.
    pub command: Frame,
    /// Expected conversation of the driver with the motor.
    pub transcript: &'static str,
    /// For a motor that replies only to commands, a frame with which another master makes it
    /// report.
    pub other_master: Option<Frame>,
}
