//! Reads the calibration files of LeRobot, which give the IDs and zeros of servos.
//!
//! Source: `MotorCalibration` in LeRobot's `motors/motors_bus.py`. A file is an object with one
//! entry per motor: `{"shoulder_pan": {"id": 1, "drive_mode": 0, "homing_offset": -1024,
//! "range_min": 740, "range_max": 3420}, ...}`. LeRobot stores `homing_offset` in the servo, so the
//! servo reports positions that include it. In LeRobot, as in its URDFs, the angle 0 is the middle
//! of the range.

use super::ConfigError;
use super::section::ParseContext;
use std::path::Path;
use toml::{Table, Value};

const KEY: &str = "arm.serial.calibration";

/// Copies IDs and zeros from the calibration file of a rig, if it names one, to the tables of the
/// servos. The path is relative to `folder`. Values in the rig file take precedence.
pub(super) fn insert_contents(
    rig: &mut Table,
    folder: &Path,
    context: &ParseContext,
) -> Result<(), ConfigError> {
    let Some(Value::Table(arm)) = rig.get_mut("arm") else {
        return Ok(());
    };
    let Some(Value::Table(serial)) = arm.get_mut("serial") else {
        return Ok(());
    };
    // A value of another type is reported when the keys are read.
    let Some(file) = serial.get("calibration").and_then(Value::as_str) else {
        return Ok(());
    };
    let path = folder.join(file);
    let text = files::read_text(&path).map_err(|source| ConfigError::Read {
        description: "the calibration of the servos",
        path: path.clone(),
        source,
    })?;
    let motors = parse(&text).map_err(|reason| ConfigError::CameraInfo {
        at: context.location(KEY),
        key: KEY.to_owned(),
        reason: format!("{path:?}: {reason}"),
    })?;
    serial.remove("calibration");
    let Some(Value::Table(servos)) = arm.get_mut("servo") else {
        return Ok(());
    };
    // Only servos with a table are used: the gripper of an arm is usually not one of its joints.
    for (joint, servo) in servos {
        let Some(motor) = motors.iter().find(|motor| motor.name == *joint) else {
            continue;
        };
        if let Value::Table(servo) = servo {
            for (key, value) in [("id", motor.id), ("zero_counts", motor.zero_counts)] {
                servo.entry(key).or_insert_with(|| Value::Integer(value));
            }
        }
    }
    Ok(())
}

/// A motor of a calibration file.
#[derive(Debug, PartialEq, Eq)]
struct CalibratedMotor {
    name: String,
    id: i64,
    /// Middle of its range.
    zero_counts: i64,
}

/// Reads the motors.
///
/// # Errors
/// If the text is not such a file.
fn parse(text: &str) -> Result<Vec<CalibratedMotor>, String> {
    let motors: serde_json::Map<String, serde_json::Value> =
        serde_json::from_str(text).map_err(|error| format!("it is not JSON: {error}"))?;
    motors
        .into_iter()
        .map(|(name, motor)| {
            let number = |key: &str| {
                motor[key].as_i64().ok_or_else(|| {
                    format!("{name:?} has no whole number {key:?}; expected a calibration file of LeRobot, with id, range_min and range_max of each motor")
                })
            };
            let (id, min, max) = (number("id")?, number("range_min")?, number("range_max")?);
            let zero_counts = min.saturating_add(max) / 2;
            Ok(CalibratedMotor { name, id, zero_counts })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Rig;

    const CALIBRATION: &str = r#"{
        "shoulder_pan": {"id": 1, "drive_mode": 0, "homing_offset": -1024, "range_min": 740, "range_max": 3420},
        "gripper": {"id": 6, "drive_mode": 0, "homing_offset": 5, "range_min": 2000, "range_max": 3000}
    }"#;

    #[test]
    fn middle_of_the_range_is_the_zero() {
        let motors = parse(CALIBRATION).expect("a calibration");
        let pan = motors.iter().find(|motor| motor.name == "shoulder_pan");
        assert_eq!(
            pan.map(|motor| (motor.id, motor.zero_counts)),
            Some((1, 2080))
        );
        for (text, problem) in [("[]", "not JSON"), ("{\"a\": {\"id\": 1}}", "range_min")] {
            let message = parse(text).expect_err("no calibration");
            assert!(message.contains(problem), "{message}");
        }
    }

    #[test]
    fn rig_file_gets_ids_and_zeros() {
        let folder = tempfile::tempdir().expect("a folder");
        let write = |name: &str, text: &str| {
            let path = folder.path().join(name);
            std::fs::write(&path, text).expect("a file");
            path
        };
        write("arm.json", CALIBRATION);
        write(
            "arm.urdf",
            r#"<robot name="arm"><link name="base"/><link name="tool"/>
            <joint name="shoulder_pan" type="revolute"><parent link="base"/><child link="tool"/>
            <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"#,
        );
        let rig = |servo: &str| {
            let path = write(
                "rig.toml",
                &format!(
                    "[arm]\ndriver = \"feetech\"\nurdf = \"arm.urdf\"\nflange_link = \"tool\"\n\
                     [arm.serial]\ndevice = \"/dev/ttyACM0\"\ncalibration = \"arm.json\"\n\
                     [arm.servo.shoulder_pan]\n{servo}\n\
                     [camera.front]\ndriver = \"sim\"\nsize_px = [640, 480]\nrate_hz = 30\nparent = \"base\"\n\
                     intrinsics = {{ focal_px = [600, 600], principal_px = [320, 240] }}\n"
                ),
            );
            Rig::load(&path, &[]).expect("a good rig file")
        };
        let servo = rig("").arm.servos.remove(0);
        assert_eq!((servo.id, servo.zero_counts), (1, 2080));
        let servo = rig("zero_counts = 2000").arm.servos.remove(0);
        assert_eq!((servo.id, servo.zero_counts), (1, 2000));
        // The effective rig file needs no other file.
        assert_eq!(rig("").arm.serial.calibration, None);
    }
}
