//! Writes a plan as the text of a rig file: each key with a comment, and unknown keys as comments
//! with the command that finds their values.

use super::GUESS;
use super::arm_plan::{ArmPlan, ArmSource};
use super::findings::{ControllerKind, FoundBus, FoundMotor, FoundServos};
use super::plan::{CameraPlan, RigPlan, place};
use crate::calibration_commands::{CalibrationCommand, where_the_target_is_from};
use crate::config::CameraDriver;
use drivers::can::{AllowedValues, FAMILIES, MotorKey, SettingValue};
use kinematics::Transform;
use messages::{Setting, quoted_for_shell};
use std::fmt::Display;

/// Maximum length of a line of a comment, in characters.
const MAX_LINE_CHARS: usize = 110;
/// Typical counts per turn of the encoder of a drive, as a guess: 16 bits.
const COUNTS_PER_TURN_GUESS: u32 = 65_536;

impl RigPlan {
    /// The text of the rig file.
    ///
    /// * `rig`: path of the file, for the commands in its comments.
    #[must_use]
    pub fn to_toml(&self, rig: &str) -> String {
        let rig = &quoted_for_shell(rig);
        let mut text = RigText::default();
        self.write_head(&mut text, rig);
        match &self.arm {
            None => {
                text.table("arm");
                text.key("driver", quoted("none"), "The rig has no arm.");
            }
            Some(arm) => write_arm(&mut text, arm, rig),
        }
        if self.has_moving_base {
            write_base(&mut text);
        }
        for camera in &self.cameras {
            self.write_camera(&mut text, camera, rig);
        }
        text.0
    }

    fn write_head(&self, text: &mut RigText, rig: &str) {
        let robot = self
            .arm
            .as_ref()
            .map_or("a robot without an arm", |arm| &*arm.title);
        text.comment(&format!(
            "Rig file of {robot}. `fieldrig doctor {rig}` checks it, and `fieldrig run {rig} {}` simulates it. All keys are in docs/reference/rig.md.",
            Setting::Sim
        ));
    }

    fn write_camera(&self, text: &mut RigText, camera: &CameraPlan, rig: &str) {
        text.table(&format!("camera.{}", camera.name));
        write_camera_device(text, camera);
        let [width, height] = camera.size_px;
        text.key(
            "size_px",
            format!("[{width}, {height}]"),
            "Width and height of the images, pixels.",
        );
        text.key("rate_hz", number(camera.rate_hz), "Images per second.");
        text.unknown(
            "exposure_micros = 8000",
            "Exposure time in microseconds. A fixed exposure makes motion blur predictable; without this key, it is automatic.",
        );
        let place = place(camera.parent);
        let others = "Other values: flange, base, world.";
        let about = if camera.is_parent_guessed {
            format!("{GUESS}the camera is {place}. {others}")
        } else {
            format!("The camera is {place}. {others}")
        };
        text.key("parent", quoted(camera.parent.name()), &about);
        let scene = scene_command(rig);
        let commands = if self.arm.is_some() {
            format!(
                "`{}` measures it, {}; or `{scene}`, without a target.",
                CalibrationCommand::HandEye.line(rig, &camera.name),
                where_the_target_is_from()
            )
        } else {
            format!("`{scene}` measures it if the base moves.")
        };
        let about = format!(
            "{GUESS}pose of the camera (x right, y down, z forward) in that frame. {commands}"
        );
        text.key(
            "parent_from_camera",
            pose(&camera.parent_from_camera),
            &about,
        );
        self.write_lens(text, camera, rig);
        text.unknown(
            "stamp_to_mid_exposure_millis = { value = 0.0 }",
            &format!(
                "Time from the stamp of an image to mid-exposure. `{}` measures it.",
                scene_command(rig)
            ),
        );
        let has_depth = camera
            .found
            .as_ref()
            .is_some_and(|found| found.driver == CameraDriver::Realsense);
        if has_depth {
            text.table(&format!("camera.{}.depth", camera.name));
            text.key(
                "min_m",
                "0.2",
                "Smaller depth readings are discarded, meters.",
            );
            text.key(
                "max_m",
                "3.0",
                "Larger depth readings are discarded, meters.",
            );
        }
    }

    fn write_lens(&self, text: &mut RigText, camera: &CameraPlan, rig: &str) {
        let Some(focal_px) = camera.focal_px else {
            text.comment("The camera reports its intrinsics.");
            return;
        };
        let [x, y] = camera.size_px.map(|side| 0.5 * f64::from(side));
        let focal_px = rounded(focal_px, 1);
        let lens = format!(
            "{{ focal_px = [{focal_px}, {focal_px}], principal_px = [{}, {}] }}",
            number(x),
            number(y)
        );
        let about = format!(
            "{GUESS}a lens without distortion and with a horizontal field of view of {} degrees. `{}` measures it, {}.",
            self.field_of_view_deg,
            CalibrationCommand::Intrinsics.line(rig, &camera.name),
            where_the_target_is_from()
        );
        text.key("intrinsics", lens, &about);
    }
}

/// The command that calibrates the cameras of a rig file without a target, and writes the result into
/// the rig file.
fn scene_command(rig: &str) -> String {
    format!("fieldrig calibrate scene {rig} {} {rig}", Setting::WriteRig)
}

/// Driver and device of a camera.
fn write_camera_device(text: &mut RigText, camera: &CameraPlan) {
    let Some(found) = &camera.found else {
        let about = "No camera was found. For a webcam: \"v4l2\", and the device that `fieldrig devices` prints.";
        text.key("driver", quoted("sim"), about);
        text.unknown("device = \"/dev/v4l/by-id/NAME\"", "");
        return;
    };
    let driver = match found.driver {
        CameraDriver::Realsense => "realsense",
        CameraDriver::Nokhwa => "nokhwa",
        CameraDriver::V4l2 | CameraDriver::Sim => "v4l2",
    };
    text.key("driver", quoted(driver), &format!("{}.", found.name));
    text.key(
        "device",
        quoted(&found.device),
        "Path or serial number of the camera.",
    );
}

fn write_arm(text: &mut RigText, arm: &ArmPlan, rig: &str) {
    text.table("arm");
    write_arm_source(text, arm);
    let about =
        "Robot description: a URDF file relative to this file, or builtin:NAME of a known robot.";
    let about = if arm.is_robot_guessed {
        format!(
            "{GUESS}the robot is a {}. Other values: a URDF file relative to this file, or builtin:NAME of a known robot.",
            arm.title
        )
    } else {
        about.to_owned()
    };
    text.key("urdf", quoted(&arm.urdf), &about);
    if arm.names_links {
        let links = &arm.links;
        text.key(
            "base_link",
            quoted(&links.base),
            "Link that is the base of the robot.",
        );
        let about = if arm.is_flange_guessed {
            format!(
                "{GUESS}link to which cameras on the arm are attached. Other values: links of the URDF."
            )
        } else {
            "Link to which cameras on the arm are attached.".to_owned()
        };
        text.key("flange_link", quoted(&links.flange), &about);
    }
    match &arm.source {
        ArmSource::Motors { buses, motors } => write_motors(text, arm, buses, motors),
        ArmSource::Servos(servos) => write_servos(text, arm, servos),
        ArmSource::Simulated(_) | ArmSource::Controller(_) => {}
    }
    if !matches!(arm.source, ArmSource::Simulated(_)) {
        text.line("");
        text.comment(&format!(
            "The arm is only read. To let it move, read docs/guide/moving-arms.md, add this table, and check it with `fieldrig doctor {rig}`:"
        ));
        text.line("# [arm.motion]");
        text.line("# on_loss = \"hold\"");
    }
}

/// Driver and address of the arm.
fn write_arm_source(text: &mut RigText, arm: &ArmPlan) {
    match &arm.source {
        ArmSource::Simulated(driver) => {
            let about = match driver {
                Some("feetech") => "The arm is simulated. For the real arm: \"feetech\" with [arm.serial] and [arm.servo.JOINT], see docs/guide/arms.md.".to_owned(),
                Some(driver) => format!("The arm is simulated. For the real arm: {driver:?} with its address."),
                None => "The arm is simulated. For the real arm: franka, ur, can, feetech, dynamixel or udp, see docs/guide/arms.md.".to_owned(),
            };
            text.key("driver", quoted("sim"), &about);
            match driver {
                Some("franka") => text.unknown(
                    "address = \"172.16.0.2\"",
                    "Address of the controller; Desk shows it under Settings, Network.",
                ),
                Some("ur") => text.unknown(
                    "address = \"192.168.1.10\"",
                    "Address of the controller; the pendant shows it under Settings, System, Network.",
                ),
                _ => {}
            }
        }
        ArmSource::Controller(controller) => {
            let about = match controller.kind {
                ControllerKind::Franka => "A Franka arm over FCI.",
                ControllerKind::Ur => "An arm of Universal Robots over RTDE.",
            };
            text.key("driver", quoted(controller.kind.driver()), about);
            text.key(
                "address",
                quoted(&controller.address),
                "Address of its controller.",
            );
        }
        ArmSource::Motors { .. } => text.key("driver", quoted("can"), "Motors on CAN buses."),
        ArmSource::Servos(servos) => {
            text.key("driver", quoted(servos.driver), "Servos on a serial port.");
        }
    }
}

fn write_servos(text: &mut RigText, arm: &ArmPlan, servos: &FoundServos) {
    text.table("arm.serial");
    text.key("device", quoted(&servos.device), "Path of the serial port.");
    text.key("baud_hz", servos.baud_hz, "Baud rate of the servos.");
    text.unknown(
        "calibration = \"my_arm.json\"",
        "Calibration file of LeRobot with the zeros of the servos, in ~/.cache/huggingface/lerobot/calibration.",
    );
    for (ix, (joint, id)) in arm.links.joints.iter().zip(&servos.ids).enumerate() {
        text.table(&format!("arm.servo.{}", bare_or_quoted(joint)));
        if ix == 0 {
            text.comment(&format!(
                "{GUESS}each joint has a servo, in the order of the IDs, with its zero in the middle of its range. `fieldrig doctor` pings them; move each joint by hand to check them."
            ));
        }
        text.line(&format!("id = {id}"));
        if ix == 0 {
            text.unknown(
                "zero_counts = 2048",
                "What the servo reports when the joint angle is 0.",
            );
            text.unknown(
                "reversed = true",
                "If the servo turns opposite to the joint.",
            );
        }
    }
}

fn write_motors(
    text: &mut RigText,
    arm: &ArmPlan,
    buses: &[FoundBus],
    motors: &[(usize, FoundMotor)],
) {
    for bus in buses {
        text.table(&format!("arm.bus.{}", bare_or_quoted(&bus.interface)));
        let bitrate_hz = bus.bitrate_hz.unwrap_or(1_000_000);
        text.key(
            "bitrate_hz",
            bitrate_hz,
            "Bit rate of the interface, bit/s.",
        );
        if !bus.restarts {
            let about = "The interface has no restart-ms, so it stays off after a bus-off until you restart it.";
            text.key("accept_no_restart", true, about);
        }
    }
    for (ix, (joint, (bus_ix, motor))) in arm.links.joints.iter().zip(motors).enumerate() {
        text.table(&format!("arm.motor.{}", bare_or_quoted(joint)));
        text.line(&format!("family = {}", quoted(motor.family)));
        text.line(&format!("bus = {}", quoted(&buses[*bus_ix].interface)));
        if ix == 0 {
            text.comment(&format!(
                "{GUESS}each joint has a motor, in the order of buses and IDs, without a gear and an offset. Move each joint by hand to check them."
            ));
        }
        text.line(&format!("id = {}", motor.id));
        write_family_keys(text, motor);
        if ix == 0 {
            text.unknown(
                "gear_ratio = 1.0",
                "Revolutions that the motor reports per revolution of the joint.",
            );
            text.unknown(
                "reversed = true",
                "If the motor turns opposite to the joint.",
            );
            text.unknown(
                "offset_rad = 0.0",
                "Joint angle at which the motor reports 0.",
            );
        }
    }
}

/// The keys that only motors of this family have: what the motor reports, and guesses for required
/// keys that it does not report.
fn write_family_keys(text: &mut RigText, motor: &FoundMotor) {
    let Some(family) = FAMILIES.iter().find(|family| family.name() == motor.family) else {
        return;
    };
    for key in family.keys() {
        let reported = motor.reported.iter().find(|(name, _)| *name == key.name);
        match (reported, key.required) {
            (Some((name, value)), _) => text.line(&format!("{name} = {}", setting(value))),
            (None, Some(meaning)) => {
                text.key(key.name, guess(&key), &format!("{GUESS}{meaning}."));
            }
            (None, None) => {}
        }
    }
}

fn setting(value: &SettingValue) -> String {
    match value {
        SettingValue::Whole(number) => number.to_string(),
        SettingValue::Number(value) => number(*value),
        SettingValue::Word(word) => quoted(word),
    }
}

/// An allowed value of a required key that a motor does not report.
fn guess(key: &MotorKey) -> String {
    match &key.allowed {
        AllowedValues::Whole(range) => range.start().to_string(),
        AllowedValues::Number(range) => {
            number(f64::from(COUNTS_PER_TURN_GUESS).clamp(*range.start(), *range.end()))
        }
        AllowedValues::Words(words) => quoted(words.first().copied().unwrap_or_default()),
    }
}

fn write_base(text: &mut RigText) {
    text.table("base");
    let about = "Another program sends the pose of the base, see docs/reference/udp.md. AprilTags can locate it, too: \"tags\".";
    text.key("driver", quoted("udp"), about);
    text.key(
        "address",
        quoted("127.0.0.1:7009"),
        "Address on which the poses are received.",
    );
}

/// The text of a rig file.
#[derive(Default)]
struct RigText(String);

impl RigText {
    fn line(&mut self, line: &str) {
        self.0.push_str(line);
        self.0.push('\n');
    }

    /// Begins a table.
    fn table(&mut self, name: &str) {
        self.line("");
        self.line(&format!("[{name}]"));
    }

    /// A key with its value, below its description.
    fn key(&mut self, name: &str, value: impl Display, about: &str) {
        self.comment(about);
        self.line(&format!("{name} = {value}"));
    }

    /// A key whose value is unknown, as a comment.
    fn unknown(&mut self, key_and_value: &str, about: &str) {
        self.comment(about);
        self.line(&format!("# {key_and_value}"));
    }

    /// A comment, with line breaks.
    fn comment(&mut self, text: &str) {
        let mut line = String::new();
        for word in text.split_whitespace() {
            if !line.is_empty() && line.chars().count() + 1 + word.chars().count() > MAX_LINE_CHARS
            {
                self.line(&line);
                line.clear();
            }
            line.push_str(if line.is_empty() { "# " } else { " " });
            line.push_str(word);
        }
        if !line.is_empty() {
            self.line(&line);
        }
    }
}

/// A text as a TOML string.
fn quoted(text: &str) -> String {
    toml::Value::from(text).to_string()
}

/// A name as a TOML key.
fn bare_or_quoted(name: &str) -> String {
    let is_bare = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if !name.is_empty() && name.chars().all(is_bare) {
        name.to_owned()
    } else {
        quoted(name)
    }
}

/// A number with at most four decimals.
fn number(value: f64) -> String {
    rounded(value, 4).to_string()
}

fn rounded(value: f64, n_decimals: i32) -> f64 {
    let factor = 10_f64.powi(n_decimals);
    // The sum removes the sign of -0.
    (value * factor).round() / factor + 0.0
}

/// A pose as an inline table. Six decimals keep the quaternion normalized.
fn pose(pose: &Transform) -> String {
    let numbers = |values: &[f64], n_decimals| {
        let values: Vec<_> = values
            .iter()
            .map(|value| rounded(*value, n_decimals).to_string())
            .collect();
        values.join(", ")
    };
    let [x, y, z] = pose.translation.vector.into();
    let quat_xyzw: [f64; 4] = pose.rotation.quaternion().coords.into();
    format!(
        "{{ xyz_m = [{}], quat_xyzw = [{}] }}",
        numbers(&[x, y, z], 4),
        numbers(&quat_xyzw, 6)
    )
}
