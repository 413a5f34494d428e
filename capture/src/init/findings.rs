//! What was found on this computer and at the addresses of controllers.

use crate::config::CameraDriver;
use crate::known_robots::KnownRobot;
use drivers::can::SettingValue;
use std::fmt;

/// Devices that were found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Findings {
    /// Cameras, in the order in which rig files get them.
    pub cameras: Vec<FoundCamera>,
    /// CAN interfaces.
    pub buses: Vec<FoundBus>,
    /// Servos, by serial port.
    pub servos: Vec<FoundServos>,
    /// Controllers of arms.
    pub controllers: Vec<FoundController>,
    /// One sentence for each device that was found but cannot be used, with the remedy.
    pub notes: Vec<String>,
}

/// A camera.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundCamera {
    /// Its driver.
    pub driver: CameraDriver,
    /// Value of the key `device`.
    pub device: String,
    /// Name of the model.
    pub name: String,
    /// Size of its images, pixels.
    pub size_px: [u32; 2],
    /// Images per second.
    pub rate_hz: f64,
}

/// A CAN interface.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundBus {
    /// Name of the interface.
    pub interface: String,
    /// Its bit rate, bit/s; `None` for a virtual interface.
    pub bitrate_hz: Option<u32>,
    /// Whether the kernel restarts it after a bus-off.
    pub restarts: bool,
    /// Motors on the bus.
    pub motors: Vec<FoundMotor>,
}

/// A motor on a CAN bus.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundMotor {
    /// Name of its family in rig files.
    pub family: &'static str,
    /// Its ID.
    pub id: u64,
    /// Keys of the family that the motor reports, with their values.
    pub reported: Vec<(&'static str, SettingValue)>,
}

/// Servos on a serial port.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundServos {
    /// Path of the port.
    pub device: String,
    /// Name of their driver.
    pub driver: &'static str,
    /// Baud rate, bit/s.
    pub baud_hz: u32,
    /// Their IDs, in ascending order.
    pub ids: Vec<u8>,
}

/// Maker of a controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ControllerKind {
    /// Franka.
    Franka,
    /// Universal Robots.
    Ur,
}

impl ControllerKind {
    /// Name of the driver in rig files.
    #[must_use]
    pub fn driver(self) -> &'static str {
        match self {
            Self::Franka => "franka",
            Self::Ur => "ur",
        }
    }

    /// Number of joints of its arms.
    #[must_use]
    pub fn n_joints(self) -> usize {
        match self {
            Self::Franka => 7,
            Self::Ur => 6,
        }
    }

    /// Whether a known robot has such a controller.
    #[must_use]
    pub fn controls(self, robot: &KnownRobot) -> bool {
        match self {
            Self::Franka => robot.title.starts_with("Franka"),
            Self::Ur => robot.title.starts_with("Universal Robots"),
        }
    }

    /// The known robot that is assumed if the controller does not tell robots apart.
    #[must_use]
    pub fn usual_robot(self) -> &'static str {
        match self {
            Self::Franka => "fr3",
            Self::Ur => "ur5e",
        }
    }
}

impl fmt::Display for ControllerKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Franka => "Franka",
            Self::Ur => "Universal Robots",
        })
    }
}

/// A controller of an arm.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundController {
    /// Its maker.
    pub kind: ControllerKind,
    /// Its address, as in rig files.
    pub address: String,
    /// Why nothing answers there as this controller does. A controller whose address the user has
    /// given may be switched off.
    pub problem: Option<String>,
    /// The known robot whose kinematics agree with the pose that the controller reports.
    pub robot: Option<&'static KnownRobot>,
}

impl FoundController {
    /// Whether it answers as a controller of its maker does.
    #[must_use]
    pub fn answers(&self) -> bool {
        self.problem.is_none()
    }
}

impl fmt::Display for FoundCamera {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [width, height] = self.size_px;
        let rate_hz = self.rate_hz;
        let Self { name, device, .. } = self;
        write!(f, "{name} ({device}), {width}x{height} at {rate_hz} Hz")
    }
}

impl fmt::Display for FoundBus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let motors: Vec<_> = self
            .motors
            .iter()
            .map(|motor| format!("{} {}", motor.family, motor.id))
            .collect();
        let motors = match &motors[..] {
            [] => "no motor answers".to_owned(),
            motors => format!("motors {}", motors.join(", ")),
        };
        write!(f, "{}: {motors}", self.interface)
    }
}

impl fmt::Display for FoundServos {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            device,
            driver,
            baud_hz,
            ids,
        } = self;
        let ids: Vec<_> = ids.iter().map(u8::to_string).collect();
        let ids = ids.join(", ");
        write!(f, "{device}: {driver} servos {ids} at {baud_hz} baud")
    }
}

impl fmt::Display for FoundController {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kind, address, .. } = self;
        if let Some(problem) = &self.problem {
            return write!(f, "{kind} controller at {address}: {problem}");
        }
        match self.robot {
            Some(robot) => write!(f, "{kind} controller at {address}: {}", robot.title),
            None => write!(f, "{kind} controller at {address}"),
        }
    }
}

impl Findings {
    /// The findings as text.
    #[must_use]
    pub fn lines(&self) -> Vec<String> {
        let Self {
            cameras,
            buses,
            servos,
            controllers,
            notes,
        } = self;
        let mut lines = Vec::new();
        let (found, silent): (Vec<_>, Vec<_>) = controllers
            .iter()
            .partition(|controller| controller.answers());
        let rows = [
            ("camera", texts(cameras)),
            ("CAN", texts(buses)),
            ("servos", texts(servos)),
            ("controller", texts(&found)),
        ];
        if rows.iter().all(|(_, found)| found.is_empty()) {
            lines.push("  no cameras, motors, servos or controllers".to_owned());
        }
        for (kind, found) in rows {
            for device in found {
                lines.push(format!("  {kind:10} {device}"));
            }
        }
        for controller in silent {
            lines.push(format!("  not found  {controller}"));
        }
        for note in notes {
            lines.push(format!("  not used   {note}"));
        }
        lines
    }
}

fn texts(devices: &[impl ToString]) -> Vec<String> {
    devices.iter().map(ToString::to_string).collect()
}
