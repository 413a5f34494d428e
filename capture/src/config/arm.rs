//! The keys in `[arm]`, checked against the robot description.

use super::can;
use super::error::ConfigError;
use super::key::{Keys, choices, entry, keys, table_of};
use super::motion::ArmMotion;
use super::section::Section;
use super::servos::{self, ArmSerial, ArmServo};
use super::table_schema::TableSchema;
use super::urdf_folder::UrdfFolder;
use crate::known_robots::{BUILTIN_PREFIX, KNOWN_ROBOTS, KnownRobot};
use drivers::can::{BusConfig, MotorConfig};
use kinematics::Chain;
use serde_json::json;
use toml::{Table, Value};

/// Maximum joint offset, rad or m. A larger offset is probably in degrees, or has the wrong sign.
const MAX_JOINT_OFFSET: f64 = 1.0;

/// Robot description of a rig without an arm, if the rig file names none.
pub(super) const EMPTY_URDF: &str = r#"<robot name="none"><link name="base"/></robot>"#;

keys! {
    /// The arm of the rig.
    #[derive(Clone, Debug, PartialEq)]
    pub struct Arm {
        /// Source of the joint states.
        pub driver: ArmDriver, required "none, franka, ur, can, feetech, dynamixel, udp or sim";
        /// Network address. For `franka` and `ur`, that of the controller. For `udp`, the address on which
        /// joint states are received.
        pub address: String = String::new();
        /// The URDF text.
        pub urdf_text: String => String::new();
        /// Folder at which the names of mesh files in the URDF start, relative to the rig file.
        /// Without this key, the folder of the URDF.
        pub mesh_folder: Option<String>;
        /// The absolute folder of mesh files.
        pub urdf_folder: UrdfFolder => UrdfFolder::default();
        /// Moving joints in the order of the joint states.
        pub joints: Vec<String> = Vec::new();
        /// Offsets that are added to the joint positions, in the order of `joints`, rad or m. Each
        /// is from -1 to 1. An empty list means no offsets.
        pub joint_offsets: Vec<f64> = Vec::new();
        /// Settings of a simulated arm.
        pub sim: ArmSim;
        /// Link of the URDF that is the base of the robot.
        pub base_link: String = String::new();
        /// Link of the URDF to which cameras with the parent `flange` are attached.
        pub flange_link: String = String::new();
        /// Speed limit for all joints when the arm is moved, rad/s or m/s.
        pub max_speed_rad_s: f64 = 0.5, in 0.001..=10.0;
        /// Rate at which motors on CAN buses and servos are polled and commanded, Hz.
        pub rate_hz: f64 = 200.0, in 1.0..=2000.0;
        /// CAN buses.
        pub buses: Vec<BusConfig> => Vec::new();
        /// Motors on the buses, in the order of `joints`.
        pub motors: Vec<MotorConfig> => Vec::new();
        /// Serial port of servos.
        pub serial: ArmSerial;
        /// Servos on the serial port, in the order of `joints`.
        pub servos: Vec<ArmServo> => Vec::new();
        /// How the arm may be moved. Without this table, it is only read.
        pub motion: Option<ArmMotion>;
    }

    /// Settings of a simulated arm.
    #[derive(Clone, Debug, Default, PartialEq)]
    pub struct ArmSim {
        /// Offsets that must be added to the simulated readings to get the true joint positions, in
        /// the order of `joints`, rad. Each is from -1 to 1. An empty list means right readings.
        pub true_joint_offsets: Vec<f64> = Vec::new();
    }
}

impl Arm {
    /// Whether the rig has a robot description. The rig file of a robot without an arm need not name
    /// one.
    #[must_use]
    pub fn has_description(&self) -> bool {
        self.driver != ArmDriver::None || self.urdf_text != EMPTY_URDF
    }
}

/// Source of the joint states.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArmDriver {
    /// The rig has no arm.
    None,
    /// A Franka arm over FCI.
    Franka,
    /// An arm of Universal Robots over RTDE.
    Ur,
    /// Motors on CAN buses.
    Can,
    /// Feetech STS servos on a serial bus.
    Feetech,
    /// Dynamixel servos on a serial bus.
    Dynamixel,
    /// Datagrams from another program.
    Udp,
    /// The simulator.
    Sim,
}

choices! {
    ArmDriver {
        None = "none", Franka = "franka", Ur = "ur", Can = "can", Feetech = "feetech", Dynamixel = "dynamixel",
        Udp = "udp", Sim = "sim";
        else "for another arm, use \"udp\" and send its joint states from another program, see docs/guide/arms.md"
    }
}

/// Reads the arm. Also returns the path of the robot description. The path is empty if there is no
/// robot description, or if it is that of a known robot, which is then part of the arm.
pub(super) fn read(mut keys: Section<'_>) -> Option<(Arm, String)> {
    let has_flange_link = keys.has("flange_link");
    let arm = Arm::read_keys(&mut keys);
    let urdf = keys.get::<String>("urdf", ());
    let is_reference = urdf
        .as_deref()
        .is_some_and(|urdf| urdf.starts_with(BUILTIN_PREFIX));
    let known_robot = urdf.as_deref().and_then(|urdf| known_robot(&keys, urdf));
    // An invalid driver counts as an arm, so that the keys that an arm needs are checked in the
    // same pass.
    let has_arm = arm.as_ref().is_none_or(|arm| arm.driver != ArmDriver::None);
    if has_arm && urdf.is_none() {
        keys.missing(
            "urdf",
            "path of the robot description, relative to the rig file, or \"builtin:NAME\" of a known robot",
        );
    }
    // Without an arm and a robot description, the robot has a single link.
    let has_single_link = !has_arm && urdf.is_none();
    if !has_flange_link && !has_single_link && !is_reference {
        keys.missing(
            "flange_link",
            "link to which cameras with the parent flange are attached",
        );
    }
    let (buses, motors) = can::read(&mut keys);
    let servos = servos::read(&mut keys);
    keys.end();
    let mut arm = Arm {
        buses,
        motors,
        servos,
        ..arm?
    };
    if let Some(robot) = known_robot {
        arm.urdf_text = robot.urdf.to_owned();
        if arm.base_link.is_empty() {
            arm.base_link = robot.base_link.to_owned();
        }
        if !has_flange_link {
            arm.flange_link = robot.flange_link.to_owned();
        }
        return Some((arm, String::new()));
    }
    if !has_flange_link {
        arm.flange_link = "base".to_owned();
    }
    Some((arm, urdf.unwrap_or_default()))
}

/// Schema of the table.
pub(super) fn schema() -> TableSchema {
    let mut arm = table_of::<Arm>();
    let about = "Robot description: path of a URDF file, relative to the rig file, or builtin:NAME of a known robot.";
    arm.add("urdf", about, urdf_schema());
    can::describe(&mut arm);
    servos::describe(&mut arm);
    arm
}

/// Schema of the key `urdf`: editors offer the known robots.
fn urdf_schema() -> serde_json::Value {
    let known: Vec<String> = KNOWN_ROBOTS.iter().map(KnownRobot::reference).collect();
    json!({ "type": "string", "examples": known })
}

/// The known robot that a value of `urdf` names; `None` if the value is a path. An unknown name is
/// reported.
fn known_robot(keys: &Section<'_>, urdf: &str) -> Option<&'static KnownRobot> {
    KnownRobot::named_by(urdf).unwrap_or_else(|unknown| {
        let got = Value::String(urdf.to_owned());
        keys.invalid(
            "urdf",
            &got,
            &format!("a path, or a known robot; {unknown}"),
        )
    })
}

pub(super) fn write(arm: &Arm) -> Table {
    let mut table = arm.write_keys();
    if arm.has_description() {
        table.extend(entry("urdf", &drivers::recording::URDF_FILE.to_owned()));
    }
    table.extend(can::write(&arm.buses, &arm.motors));
    table.extend(servos::write(&arm.servos));
    table
}

/// Checks links and joints against the robot description and fills in the joints if the rig file
/// lists none.
pub(super) fn resolve_joints(file: &str, arm: &mut Arm) -> Result<(), ConfigError> {
    let robot = |key, e: kinematics::Error| ConfigError::Robot {
        file: file.to_owned(),
        key,
        reason: e.to_string(),
    };
    let description =
        kinematics::urdf::Robot::parse(&arm.urdf_text).map_err(|e| robot("arm.urdf", e))?;
    for note in description.notes() {
        log::warn!("the URDF of {file}, {note}");
    }
    if arm.base_link.is_empty() {
        arm.base_link = description
            .root()
            .map_err(|e| robot("arm.urdf", e))?
            .to_owned();
    }
    let chain = Chain::new(&description, &arm.base_link, &arm.flange_link)
        .map_err(|e| robot("arm.flange_link", e))?;
    if arm.joints.is_empty() {
        arm.joints = chain.joint_names().to_vec();
    }
    chain
        .order_in(&arm.joints)
        .map_err(|e| robot("arm.joints", e))?;
    if let Some(motion) = &arm.motion {
        motion.steering.check(file)?;
    }
    resolve_motors(file, arm)?;
    if matches!(arm.driver, ArmDriver::Feetech | ArmDriver::Dynamixel) {
        servos::resolve(file, &arm.serial, &arm.joints, &mut arm.servos)?;
    }
    // Offsets are checked against the resolved joints, because the rig file may leave the list of
    // joints to the URDF.
    check_offsets(
        file,
        "arm.joint_offsets",
        &arm.joint_offsets,
        arm.joints.len(),
    )?;
    check_offsets(
        file,
        "arm.sim.true_joint_offsets",
        &arm.sim.true_joint_offsets,
        arm.joints.len(),
    )
}

fn check_offsets(
    file: &str,
    key: &'static str,
    offsets: &[f64],
    n_joints: usize,
) -> Result<(), ConfigError> {
    let n = offsets.len();
    if n == 0
        || (n == n_joints
            && offsets
                .iter()
                .all(|offset| offset.abs() <= MAX_JOINT_OFFSET))
    {
        return Ok(());
    }
    let reason = format!(
        "{n} numbers; must be {n_joints} from -{MAX_JOINT_OFFSET} to {MAX_JOINT_OFFSET}, or none"
    );
    Err(ConfigError::Robot {
        file: file.to_owned(),
        key,
        reason,
    })
}

/// Sorts the motors by joint. An arm on CAN buses needs exactly one motor per joint.
fn resolve_motors(file: &str, arm: &mut Arm) -> Result<(), ConfigError> {
    if arm.driver != ArmDriver::Can {
        return Ok(());
    }
    let problem = |reason| ConfigError::Robot {
        file: file.to_owned(),
        key: "arm.motor",
        reason,
    };
    let index_of = |name: &String| arm.joints.iter().position(|joint| joint == name);
    if let Some(unknown_motor) = arm
        .motors
        .iter()
        .find(|motor| index_of(&motor.joint).is_none())
    {
        return Err(problem(format!(
            "{:?} is not one of the joints {}",
            unknown_motor.joint,
            arm.joints.join(", ")
        )));
    }
    // A joint without a motor would have no readings, and the join would reject every joint state.
    if let Some(joint) = arm
        .joints
        .iter()
        .find(|joint| !arm.motors.iter().any(|motor| motor.joint == **joint))
    {
        return Err(problem(format!(
            "the joint {joint:?} has no table [arm.motor.{joint}]"
        )));
    }
    for (ix, motor) in arm.motors.iter().enumerate() {
        let is_same = |other: &&MotorConfig| {
            other.bus_ix == motor.bus_ix && other.protocol.conflicts_with(&*motor.protocol)
        };
        if let Some(same) = arm.motors[..ix].iter().find(is_same) {
            let interface = &arm.buses[motor.bus_ix].interface;
            let message = format!(
                "{:?} and {:?} have the same ID on {interface:?}",
                same.joint, motor.joint
            );
            return Err(problem(message));
        }
    }
    let mut motors = std::mem::take(&mut arm.motors);
    // Readings then have the order of `arm.joints`.
    motors.sort_by_key(|motor| index_of(&motor.joint));
    arm.motors = motors;
    Ok(())
}
