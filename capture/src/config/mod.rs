//! The rig file. This module converts TOML to checked types, and these types back to the effective
//! rig file, which reproduces a run.
//!
//! Every key is in `docs/reference/rig.md`. Unknown keys are errors. Flags override keys of the
//! same name. In the code, each table is a struct, and each key is a field with its default and
//! range (macro `keys!`).

mod arm;
mod base;
mod base_motion;
mod camera;
mod camera_info_file;
mod can;
mod comments;
mod error;
mod join;
mod key;
#[cfg(test)]
mod known_robot_tests;
mod lens;
mod motion;
mod pose;
mod required;
mod rig_file;
mod rig_path;
mod scanner;
mod schema;
#[cfg(test)]
pub(crate) mod schema_tests;
mod section;
mod servo_calibration_file;
mod servos;
mod sim;
mod table_schema;
#[cfg(test)]
mod tests;
mod train;
mod urdf_folder;

pub use arm::{Arm, ArmDriver};
pub use base::{Base, BaseDriver, BaseSim};
pub use base_motion::BaseMotion;
pub use camera::{
    Camera, CameraDriver, CameraSim, Depth, Parent, Realsense, TimeOffset, UnknownCalibration, V4l2,
};
pub use error::{ConfigError, SourceLocation};
pub use join::JoinConfig;
pub use motion::{ArmMotion, ArmSteering};
pub use required::{MissingKey, Need};
pub use rig_path::RigPath;
pub use scanner::{Scanner, ScannerDriver, ScannerSim};
pub use servos::{ArmSerial, ArmServo};
pub use sim::{Sim, SimTarget};
pub use train::{DEFAULT_SEED, MAX_BYTES_RANGE, MAX_SPLATS_RANGE, Methods, SEED_RANGE, Train};
pub use urdf_folder::UrdfFolder;

use std::path::{Path, PathBuf};

/// A checked rig.
#[derive(Clone, Debug, PartialEq)]
pub struct Rig {
    /// The arm, its robot description and how it may be moved.
    pub arm: Arm,
    /// Pose of the base and its source.
    pub base: Base,
    /// Cameras, ordered by name.
    pub cameras: Vec<Camera>,
    /// Range scanners, ordered by name.
    pub scanners: Vec<Scanner>,
    /// Which images become keyframes.
    pub join: JoinConfig,
    /// How the model is trained.
    pub train: Train,
    /// Settings of the simulation.
    pub sim: Sim,
    /// Path of the rig file.
    pub path: RigPath,
}

/// A value from the command line that overrides a key of the rig file.
#[derive(Clone, Debug, PartialEq)]
pub struct Override {
    key: &'static str,
    value: toml::Value,
}

impl Override {
    /// Creates an override of `key`, a dotted path as in `docs/reference/rig.md`, such as
    /// `train.seed`.
    #[must_use]
    pub fn new(key: &'static str, value: impl Into<toml::Value>) -> Self {
        Self {
            key,
            value: value.into(),
        }
    }
}

impl Rig {
    /// Whether base poses come from a device or a simulation, and may therefore have errors.
    #[must_use]
    pub fn has_moving_base(&self) -> bool {
        self.base.driver != BaseDriver::Fixed
    }

    /// Reads and checks a rig file, and the robot description and camera info files that it names.
    /// Paths in the rig become absolute.
    ///
    /// # Errors
    ///
    /// If a file cannot be read, the text is not TOML, a key is unknown or missing, a value is not
    /// allowed, or the robot description does not match. An unknown key is reported before any
    /// other problem with keys.
    pub fn load(path: &Path, overrides: &[Override]) -> Result<Self, ConfigError> {
        let text = read_file("the rig file", path)?;
        // Messages name the file without its folder, because the user has given the folder.
        let file = path.file_name().map_or_else(
            || path.display().to_string(),
            |name| name.to_string_lossy().into_owned(),
        );
        let folder = path.parent().unwrap_or(Path::new("")).to_owned();
        let mut urdf_folder = UrdfFolder::default();
        let read_urdf = |urdf: &str| {
            let path = folder.join(urdf);
            urdf_folder = UrdfFolder::of(&path);
            // An absolute path shows the folder in the message if the file does not exist.
            let path = std::path::absolute(&path).unwrap_or(path);
            read_file("the robot description", &path)
        };
        let mut rig = rig_file::read(&file, &text, overrides, Some(&folder), read_urdf)?;
        rig.path = RigPath::of(path);
        if let Some(meshes) = &rig.arm.mesh_folder {
            let meshes = folder.join(meshes);
            urdf_folder = UrdfFolder::at(&std::path::absolute(&meshes).unwrap_or(meshes));
        }
        // The effective rig file and its robot description are in another folder, or in a recording.
        if rig.arm.mesh_folder.is_some() || rig.arm.urdf_text.contains("<mesh") {
            let meshes = urdf_folder.path();
            rig.arm.mesh_folder = meshes.map(|meshes| meshes.to_string_lossy().into_owned());
        }
        rig.arm.urdf_folder = urdf_folder;
        if let Some(motion) = rig
            .arm
            .motion
            .as_mut()
            .filter(|motion| !motion.odrive_endpoints.is_empty())
        {
            // An absolute path stays valid in the effective rig file, which is in another folder.
            let path = folder.join(&motion.odrive_endpoints);
            let path = std::path::absolute(&path).map_err(|source| ConfigError::Read {
                description: "ODrive's endpoints",
                path,
                source,
            })?;
            motion.odrive_endpoints = path.to_string_lossy().into_owned();
        }
        for camera in rig
            .cameras
            .iter_mut()
            .filter(|camera| !camera.realsense.file.as_os_str().is_empty())
        {
            // The effective rig file is in another folder.
            let file = folder.join(&camera.realsense.file);
            camera.realsense.file = std::path::absolute(&file).unwrap_or(file);
        }
        Ok(rig)
    }

    /// Checks the text of a rig file and the robot description `urdf_text`. Messages use the name
    /// `file`.
    ///
    /// # Errors
    ///
    /// As for [`Rig::load`], except for errors of reading files.
    pub fn parse(
        file: &str,
        text: &str,
        urdf_text: &str,
        overrides: &[Override],
    ) -> Result<Self, ConfigError> {
        let mut rig = rig_file::read(file, text, overrides, None, |_| Ok(urdf_text.to_owned()))?;
        if let Some(meshes) = &rig.arm.mesh_folder {
            rig.arm.urdf_folder = UrdfFolder::at(Path::new(meshes));
        }
        Ok(rig)
    }

    /// The effective rig file with every key. The same rig can be read from it if the robot
    /// description is in the same folder.
    #[must_use]
    pub fn to_toml(&self) -> String {
        rig_file::write(self)
    }

    /// The effective rig file with the comments of `source`, the text of an earlier rig file of the
    /// same robot. A comment that marks a value as a guess is left out if the value has changed.
    #[must_use]
    pub fn to_toml_with_comments(&self, source: &str) -> String {
        let text = self.to_toml();
        comments::carried(source, &text).unwrap_or(text)
    }

    /// Whether the calibration is the same. The calibration consists of extrinsics, intrinsics,
    /// time offsets and depth of the cameras, and of the joint offsets.
    #[must_use]
    pub fn has_same_calibration(&self, other: &Self) -> bool {
        self.arm.joint_offsets == other.arm.joint_offsets
            && self.cameras.len() == other.cameras.len()
            && self
                .cameras
                .iter()
                .zip(&other.cameras)
                .all(|(one, other)| is_calibrated_equally(one, other))
    }

    /// Returns the same rig with a single scene model.
    #[must_use]
    pub fn with_method(&self, name: &str) -> Self {
        let methods = self.train.methods.with_single(name);
        Self {
            train: Train {
                methods,
                ..self.train.clone()
            },
            ..self.clone()
        }
    }

    /// Writes the effective rig file into a folder, and the robot description if the rig has one.
    /// Returns the path of the rig file.
    ///
    /// # Errors
    ///
    /// If a file cannot be written.
    pub fn write_resolved(&self, folder: &Path) -> std::io::Result<PathBuf> {
        let path = folder.join(drivers::recording::RIG_FILE);
        // The robot description is written first, so that a complete rig file can always be read.
        if self.arm.has_description() {
            let urdf = folder.join(drivers::recording::URDF_FILE);
            files::write(&urdf, &self.arm.urdf_text)?;
        }
        files::write(&path, self.to_toml())?;
        Ok(path)
    }
}

/// Whether all calibration of two cameras is the same.
fn is_calibrated_equally(one: &Camera, other: &Camera) -> bool {
    const TOLERANCE: f64 = 1e-9; // Writing and reading a pose may change its last bit.
    let difference = one.parent_from_camera.inverse() * other.parent_from_camera;
    one.name == other.name
        && one.parent == other.parent
        && difference.translation.vector.norm() < TOLERANCE
        && difference.rotation.angle() < TOLERANCE
        && one.unknown == other.unknown
        && one.intrinsics == other.intrinsics
        && one.stamp_to_mid_exposure == other.stamp_to_mid_exposure
        && one.readout_micros == other.readout_micros
        && one.depth == other.depth
}

fn read_file(description: &'static str, path: &Path) -> Result<String, ConfigError> {
    files::read_text(path).map_err(|source| ConfigError::Read {
        description,
        path: path.to_owned(),
        source,
    })
}
