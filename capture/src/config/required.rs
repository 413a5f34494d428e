//! Keys that a rig file may omit until a command needs them.
//!
//! A robot is brought up piece by piece: first the arm, then a camera, then its calibration. Rig
//! files may therefore have no cameras, and cameras no calibration. Commands that use images with
//! poses call [`Rig::require`]. Its errors name the missing key and the command that finds its
//! value.

use super::{ArmDriver, Camera, CameraDriver, Rig};
use crate::calibration_commands::{CalibrationCommand, where_the_target_is_from};
use messages::BadInput;
use std::borrow::Cow;

/// What a command needs to know about the cameras of a rig.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Need<'a> {
    /// At least one camera, and the intrinsics and the extrinsics of every camera.
    PosedImages,
    /// The intrinsics of the camera with this name.
    Intrinsics(&'a str),
}

/// A key that is missing in a rig file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MissingKey {
    /// Dotted path of the key.
    pub key: String,
    /// How to find its value, usually a command.
    pub remedy: Cow<'static, str>,
    /// Whether the value is known as soon as the camera is opened. Cameras may store their lenses,
    /// and the simulator assumes missing values.
    pub is_reported: bool,
}

impl Rig {
    /// The keys that are missing for a need, in the order of the cameras.
    #[must_use]
    pub fn missing_keys(&self, need: Need<'_>) -> Vec<MissingKey> {
        match need {
            Need::PosedImages if self.cameras.is_empty() => vec![MissingKey {
                key: "camera".to_owned(),
                remedy: "add a table [camera.NAME]; `fieldrig devices` lists the connected cameras"
                    .into(),
                is_reported: false,
            }],
            Need::PosedImages => self
                .cameras
                .iter()
                .flat_map(|camera| {
                    self.missing_intrinsics(camera)
                        .into_iter()
                        .chain(self.missing_extrinsics(camera))
                })
                .collect(),
            Need::Intrinsics(name) => self
                .cameras
                .iter()
                .filter(|camera| &*camera.name == name)
                .filter_map(|camera| self.missing_intrinsics(camera))
                .collect(),
        }
    }

    /// Checks that the rig has everything for a need.
    ///
    /// # Errors
    ///
    /// If a key is missing. The error names all missing keys, and how to find their values.
    pub fn require(&self, need: Need<'_>) -> Result<(), BadInput> {
        refuse(&self.missing_keys(need))
    }

    /// Like [`Rig::require`], before the devices are opened: values that cameras will report need
    /// not be known yet.
    ///
    /// # Errors
    ///
    /// If another key is missing.
    pub fn require_before_opening(&self, need: Need<'_>) -> Result<(), BadInput> {
        let mut missing = self.missing_keys(need);
        missing.retain(|missing| !missing.is_reported);
        refuse(&missing)
    }

    fn missing_extrinsics(&self, camera: &Camera) -> Option<MissingKey> {
        if !camera.unknown.parent_from_camera {
            return None;
        }
        // The arm carries the camera or the target.
        let remedy = if self.arm.driver == ArmDriver::None || self.has_moving_base() {
            let parent = camera.parent.name();
            format!(
                "measure the pose of the optical frame (x right, y down, z forward) in the frame {parent}"
            )
        } else {
            self.found_by(CalibrationCommand::HandEye, camera)
        };
        Some(MissingKey {
            key: format!("camera.{}.parent_from_camera", camera.name),
            remedy: remedy.into(),
            is_reported: camera.driver == CameraDriver::Sim,
        })
    }

    fn missing_intrinsics(&self, camera: &Camera) -> Option<MissingKey> {
        let remedy = if camera.reports_lenses() {
            Cow::Borrowed("it is stored in the camera, which this command does not open")
        } else {
            self.found_by(CalibrationCommand::Intrinsics, camera).into()
        };
        camera.unknown.intrinsics.then(|| MissingKey {
            key: format!("camera.{}.intrinsics", camera.name),
            remedy,
            is_reported: camera.reports_lenses() || camera.driver == CameraDriver::Sim,
        })
    }

    /// The command that finds a missing calibration.
    fn found_by(&self, command: CalibrationCommand, camera: &Camera) -> String {
        format!(
            "`{}` finds it, {}",
            command.line(&self.path.argument(), &camera.name),
            where_the_target_is_from()
        )
    }
}

impl Camera {
    /// The keys that name the devices of the camera, as far as its driver needs them and they are
    /// missing. A rig file may omit them as long as all devices are simulated.
    #[must_use]
    pub fn missing_devices(&self) -> Vec<MissingKey> {
        let (needs_device, depth) = match self.driver {
            CameraDriver::V4l2 => (true, self.depth.as_ref()),
            CameraDriver::Nokhwa => (true, None),
            // Without a serial number, the only connected RealSense camera is opened.
            CameraDriver::Realsense | CameraDriver::Sim => (false, None),
        };
        let name = &self.name;
        let color = (needs_device && self.device.is_empty()).then(|| "device".to_owned());
        let depth = depth
            .filter(|depth| depth.device.is_empty())
            .map(|_| "depth.device".to_owned());
        color
            .into_iter()
            .chain(depth)
            .map(|key| MissingKey {
                key: format!("camera.{name}.{key}"),
                remedy: "set it to the device that `fieldrig devices` prints for the camera".into(),
                is_reported: false,
            })
            .collect()
    }

    /// Checks that the rig file names the devices that the driver of the camera opens.
    ///
    /// # Errors
    ///
    /// If a key is missing. The error names all missing keys, and how to list the devices.
    pub fn require_devices(&self) -> Result<(), BadInput> {
        refuse(&self.missing_devices())
    }
}

/// An error that lists missing keys, unless there are none.
fn refuse(missing: &[MissingKey]) -> Result<(), BadInput> {
    if missing.is_empty() {
        return Ok(());
    }
    let keys: Vec<String> = missing.iter().map(MissingKey::to_string).collect();
    Err(BadInput(keys.join("; ")))
}

impl std::fmt::Display for MissingKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { key, remedy, .. } = self;
        write!(f, "{key} is missing: {remedy}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const URDF: &str = r#"<robot name="one"><link name="base"/><link name="tool"/>
        <joint name="j" type="revolute"><parent link="base"/><child link="tool"/><axis xyz="0 0 1"/>
        <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"#;
    const ARM: &str = "[arm]\ndriver = \"udp\"\nurdf = \"one.urdf\"\nflange_link = \"tool\"\n";
    const CAMERA: &str = "[camera.wrist]\ndriver = \"v4l2\"\nsize_px = [640, 480]\nrate_hz = 30\nparent = \"flange\"\n";
    const LENS: &str = "intrinsics = { focal_px = [600, 600], principal_px = [320, 240] }\n";

    fn rig(text: &str) -> Rig {
        Rig::parse("rig.toml", text, URDF, &[]).expect("a valid rig")
    }

    fn refused(rig: &Rig) -> String {
        rig.require(Need::PosedImages)
            .expect_err("a key is missing")
            .to_string()
    }

    #[test]
    fn an_arm_without_cameras_is_a_rig_that_lacks_a_camera_for_posed_images() {
        let rig = rig(ARM);
        assert!(rig.cameras.is_empty());
        let refused = refused(&rig);
        assert!(
            refused.contains("camera is missing") && refused.contains("fieldrig devices"),
            "{refused}"
        );
    }

    #[test]
    fn missing_calibration_names_the_keys_and_the_commands_that_find_them() {
        let rig = rig(&format!("{ARM}{CAMERA}"));
        let refused = refused(&rig);
        for words in [
            "camera.wrist.intrinsics is missing: `fieldrig calibrate intrinsics RIG.toml camera wrist target charuco:",
            "camera.wrist.parent_from_camera is missing: `fieldrig calibrate hand-eye RIG.toml camera wrist target charuco:",
            "`fieldrig calibrate target out target.pdf`",
        ] {
            assert!(refused.contains(words), "{refused}");
        }
        assert!(rig.require(Need::Intrinsics("wrist")).is_err());
    }

    #[test]
    fn commands_name_the_rig_file_that_was_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("my rig.toml");
        std::fs::write(&path, format!("{ARM}{CAMERA}")).expect("written");
        std::fs::write(folder.path().join("one.urdf"), URDF).expect("written");
        let refused = refused(&Rig::load(&path, &[]).expect("a valid rig"));
        let rig = format!("'{}'", path.display());
        for command in ["intrinsics", "hand-eye"] {
            let begin = format!("`fieldrig calibrate {command} {rig} camera wrist ");
            let end = format!(" write_rig {rig}`");
            assert!(
                refused.contains(&begin) && refused.contains(&end),
                "{refused}"
            );
        }
        assert!(!refused.contains("SPEC"), "{refused}");
    }

    #[test]
    fn calibrated_cameras_lack_nothing() {
        let calibrated = rig(&format!(
            "{ARM}{CAMERA}{LENS}parent_from_camera = {{ xyz_m = [0, 0, 0.1] }}\n"
        ));
        assert!(calibrated.require(Need::PosedImages).is_ok());
        // The identity is a pose, too, if the file gives it.
        let at_flange = rig(&format!("{ARM}{CAMERA}{LENS}parent_from_camera = {{}}\n"));
        assert!(at_flange.require(Need::PosedImages).is_ok());
        let without_pose = rig(&format!("{ARM}{CAMERA}{LENS}"));
        assert!(without_pose.require(Need::Intrinsics("wrist")).is_ok());
        assert!(without_pose.require(Need::PosedImages).is_err());
        assert!(!without_pose.has_same_calibration(&at_flange));
    }

    #[test]
    fn cameras_need_a_device_only_if_their_driver_cannot_choose_one() {
        let depth = "[camera.wrist.depth]\nmeters_per_count = 0.001\n";
        let keys = |driver: &str, more: &str| -> Vec<String> {
            let text = format!("{ARM}{CAMERA}{more}").replace("v4l2", driver);
            let missing = rig(&text).cameras[0].missing_devices();
            missing.into_iter().map(|missing| missing.key).collect()
        };
        let [color, depth_too] = ["camera.wrist.device", "camera.wrist.depth.device"];
        assert_eq!(keys("v4l2", ""), [color]);
        assert_eq!(keys("v4l2", depth), [color, depth_too]);
        assert_eq!(keys("nokhwa", depth), [color]);
        assert_eq!(
            keys("v4l2", &format!("device = \"cam\"\n{depth}")),
            [depth_too]
        );
        assert_eq!(keys("realsense", depth), [""; 0]);
        assert_eq!(keys("sim", depth), [""; 0]);
        let refused = rig(&format!("{ARM}{CAMERA}")).cameras[0].require_devices();
        let refused = refused.expect_err("no device").to_string();
        assert_eq!(
            refused,
            "camera.wrist.device is missing: set it to the device that `fieldrig devices` prints for the camera"
        );
    }

    #[test]
    fn cameras_that_report_their_lens_need_it_only_while_they_are_closed() {
        let text = format!("{ARM}{CAMERA}parent_from_camera = {{}}\n").replace("v4l2", "realsense");
        let rig = rig(&text);
        assert!(rig.require_before_opening(Need::PosedImages).is_ok());
        let refused = refused(&rig);
        assert!(refused.contains("stored in the camera"), "{refused}");
    }

    #[test]
    fn a_pose_that_no_command_finds_must_be_measured() {
        let text = format!("[arm]\ndriver = \"none\"\n{CAMERA}{LENS}").replace("flange", "world");
        let refused = refused(&rig(&text));
        assert!(refused.contains("measure the pose"), "{refused}");
    }

    #[test]
    fn effective_rig_files_omit_unknown_calibration() {
        let depth = "[camera.wrist.depth]\ndevice = \"/dev/video1\"\nsize_px = [320, 240]\n";
        for text in [
            ARM.to_owned(),
            format!("{ARM}{CAMERA}{depth}"),
            format!("{ARM}{CAMERA}rectified = true\n"),
            format!("{ARM}{CAMERA}{LENS}{depth}"),
            format!("{ARM}{CAMERA}{depth}").replace("v4l2", "realsense"),
        ] {
            let rig = rig(&text);
            let written = rig.to_toml();
            assert!(!written.contains("parent_from_camera"), "{written}");
            let again = Rig::parse("rig.toml", &written, URDF, &[]).expect("a valid rig");
            assert_eq!(again, rig, "{written}");
        }
    }
}
