//! The keys of arms with servos on a serial bus: `[arm.serial]` and `[arm.servo.NAME]`.

use super::error::ConfigError;
use super::key::{Keys, keys, table_of};
use super::section::Section;
use super::table_schema::TableSchema;
use drivers::can::FollowingLimits;
use toml::{Table, Value};

/// Counts of the middle of a servo's range.
const MIDDLE_COUNTS: i32 = 2048;

keys! {
    /// The serial port of an arm with servos.
    #[derive(Clone, Debug, PartialEq)]
    pub struct ArmSerial {
        /// Path of the port, preferably in /dev/serial/by-id.
        pub device: String = String::new();
        /// Baud rate, bit/s.
        pub baud_hz: u32 = 1_000_000, in 9_600..=4_500_000;
        /// Time in which a disconnected arm must reconnect, seconds.
        pub reconnect_secs: f64 = 30.0, in 0.0..=86_400.0;
        /// Calibration file of LeRobot, which gives `id` and `zero_counts` of the servos.
        pub calibration: Option<String>;
    }

    /// The keys of a servo.
    struct ServoKeys {
        /// ID of the servo on the bus.
        id: u8, in 0..=252, required "ID of the servo on the bus";
        /// Position that the servo reports at joint angle 0, in counts of 1/4096 revolution.
        zero_counts: i32 = MIDDLE_COUNTS, in -1_048_576..=1_048_576;
        /// Whether the servo turns opposite to the joint.
        reversed: bool = false;
        /// Revolutions of the servo per revolution of the joint.
        gear_ratio: f64 = 1.0, in 0.001..=10_000.0;
        /// Largest allowed difference between the commanded and the reported position of the joint,
        /// rad or m. If the difference is larger, a moved arm stops.
        max_following_error_rad: f64 = FollowingLimits::default().max_error_rad, in 0.001..=10.0;
        /// Whether the following error is not checked.
        accept_following_errors: bool = false;
    }
}

/// A servo and its joint: `joint = ± (counts - zero_counts) * 2 pi / 4096 / gear_ratio`.
#[derive(Clone, Debug, PartialEq)]
pub struct ArmServo {
    /// Name of the joint that it moves.
    pub joint: String,
    /// Its ID on the bus.
    pub id: u8,
    /// Position that the servo reports at joint angle 0, counts.
    pub zero_counts: i32,
    /// Whether it turns in the opposite direction to its joint.
    pub is_reversed: bool,
    /// Revolutions of the servo per revolution of the joint.
    pub gear_ratio: f64,
    /// Following limits of the joint.
    pub following: FollowingLimits,
}

/// Adds the servos to the schema of the arm.
pub(super) fn describe(arm: &mut TableSchema) {
    let mut servo = table_of::<ServoKeys>();
    // A calibration file may give the ID.
    servo.accept_absent("id");
    let about = "Servos on the serial port. The name of a table is the joint of its servo.";
    arm.named("servo", about, "", servo);
}

/// Reads the servos, ordered by name.
pub(super) fn read(keys: &mut Section<'_>) -> Vec<ArmServo> {
    let servos = keys.named_sections("servo");
    servos
        .into_iter()
        .filter_map(|(joint, keys)| {
            let ServoKeys {
                id,
                zero_counts,
                reversed: is_reversed,
                gear_ratio,
                max_following_error_rad: max_error_rad,
                accept_following_errors: is_off,
            } = keys.read()?;
            Some(ArmServo {
                joint,
                id,
                zero_counts,
                is_reversed,
                gear_ratio,
                following: FollowingLimits {
                    max_error_rad,
                    max_effort_nm: None,
                    is_off,
                },
            })
        })
        .collect()
}

/// The table of the servos, if there are any.
pub(super) fn write(servos: &[ArmServo]) -> Option<(String, Value)> {
    if servos.is_empty() {
        return None;
    }
    let table = |servo: &ArmServo| {
        let keys = ServoKeys {
            id: servo.id,
            zero_counts: servo.zero_counts,
            reversed: servo.is_reversed,
            gear_ratio: servo.gear_ratio,
            max_following_error_rad: servo.following.max_error_rad,
            accept_following_errors: servo.following.is_off,
        };
        (servo.joint.clone(), Value::Table(keys.write_keys()))
    };
    let tables: Table = servos.iter().map(table).collect();
    Some(("servo".to_owned(), Value::Table(tables)))
}

/// Sorts the servos by joint. An arm with servos needs a port, and exactly one servo per joint.
pub(super) fn resolve(
    file: &str,
    serial: &ArmSerial,
    joints: &[String],
    servos: &mut Vec<ArmServo>,
) -> Result<(), ConfigError> {
    let problem = |key, reason| ConfigError::Robot {
        file: file.to_owned(),
        key,
        reason,
    };
    if serial.device.is_empty() {
        let reason = "it is missing: set it to the path of the serial port in /dev/serial/by-id, which `fieldrig devices` lists".to_owned();
        return Err(problem("arm.serial.device", reason));
    }
    let mut sorted: Vec<ArmServo> = Vec::new();
    for joint in joints {
        // A joint without a servo would have no readings.
        let Some(servo) = servos.iter().find(|servo| servo.joint == *joint) else {
            let reason = format!("the joint {joint:?} has no table [arm.servo.{joint}]");
            return Err(problem("arm.servo", reason));
        };
        if let Some(same) = sorted.iter().find(|other| other.id == servo.id) {
            let reason = format!(
                "{:?} and {joint:?} have the same ID {}",
                same.joint, servo.id
            );
            return Err(problem("arm.servo", reason));
        }
        sorted.push(servo.clone());
    }
    if let Some(unknown) = servos.iter().find(|servo| !joints.contains(&servo.joint)) {
        let reason = format!(
            "{:?} is not one of the joints {}; a gripper needs no table",
            unknown.joint,
            joints.join(", ")
        );
        return Err(problem("arm.servo", reason));
    }
    // Readings then have the order of the joints.
    *servos = sorted;
    Ok(())
}

#[cfg(test)]
mod tests {
    use crate::config::Rig;

    const URDF: &str = r#"<robot name="two"><link name="a"/><link name="b"/><link name="c"/>
        <joint name="pan" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
        <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
        <joint name="lift" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 1 0"/>
        <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"#;

    fn parse(arm: &str) -> Result<Rig, String> {
        let text = format!(
            "[arm]\ndriver = \"feetech\"\nurdf = \"two.urdf\"\nflange_link = \"c\"\n{arm}\n\
             [camera.front]\ndriver = \"sim\"\nsize_px = [640, 480]\nrate_hz = 30\nparent = \"base\"\n\
             intrinsics = {{ focal_px = [600, 600], principal_px = [320, 240] }}\n"
        );
        Rig::parse("rig.toml", &text, URDF, &[]).map_err(|error| error.to_string())
    }

    #[test]
    fn servos_have_the_order_of_the_joints() {
        let rig = parse(
            "[arm.serial]\ndevice = \"/dev/ttyACM0\"\n[arm.servo.lift]\nid = 2\nreversed = true\n\
             [arm.servo.pan]\nid = 1\nzero_counts = 2047",
        )
        .expect("a servo for each joint");
        let servos: Vec<_> = rig
            .arm
            .servos
            .iter()
            .map(|servo| (servo.joint.as_str(), servo.id, servo.zero_counts))
            .collect();
        assert_eq!(servos, [("pan", 1, 2047), ("lift", 2, 2048)]);
        let again = Rig::parse("rig.toml", &rig.to_toml(), URDF, &[]).expect("the effective file");
        assert_eq!(again, rig);
    }

    #[test]
    fn missing_ports_and_wrong_servos_are_named() {
        let port = "[arm.serial]\ndevice = \"/dev/ttyACM0\"\n";
        let both = "[arm.servo.pan]\nid = 1\n[arm.servo.lift]\nid = 2\n";
        for (arm, problem) in [
            (both.to_owned(), "arm.serial.device: it is missing"),
            (
                format!("{port}[arm.servo.pan]\nid = 1"),
                "the joint \"lift\" has no table [arm.servo.lift]",
            ),
            (
                format!("{port}{both}[arm.servo.gripper]\nid = 6"),
                "\"gripper\" is not one of the joints pan, lift",
            ),
            (
                format!("{port}{}", both.replace("id = 2", "id = 1")),
                "have the same ID 1",
            ),
            (
                format!("{port}[arm.servo.pan]\n[arm.servo.lift]\nid = 2"),
                "arm.servo.pan.id",
            ),
        ] {
            let message = parse(&arm).expect_err("it is refused");
            assert!(message.contains(problem), "{message}");
        }
    }
}
