//! The rig file: TOML -> checked types, and back to the effective rig file that reproduces a run.
//!
//! Every key is in `docs/reference/rig.md`. Unknown keys are errors; flags override keys of the same name.

mod can;
mod error;
mod motion;
mod read;
mod section;
#[cfg(test)]
mod tests;
mod values;
mod write;

pub use error::{ConfigError, SourceLocation};
pub use motion::ArmMotion;

use drivers::can::{BusConfig, MotorConfig};
use drivers::realsense::{Filter, Pace, Stream};
use drivers::tags::{Family, TagPlacement};
use drivers::v4l2::{Delivery, V4l2Format};
use kinematics::{Intrinsics, Stamp, Transform};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Range of `max_splats`, as a key and as a flag.
pub const MAX_SPLATS_RANGE: RangeInclusive<u64> = 1..=100_000_000;
/// Range of `max_bytes`, as a key and as a flag.
pub const MAX_BYTES_RANGE: RangeInclusive<u64> = 1_000_000..=1 << 50;
/// Range of seeds, as keys and as a flag; TOML integers are at most `i64::MAX`.
pub const SEED_RANGE: RangeInclusive<u64> = 0..=i64::MAX.cast_unsigned();
/// Seed if neither a key nor a flag sets one.
pub const DEFAULT_SEED: u64 = 1;

/// A checked rig.
#[derive(Clone, Debug, PartialEq)]
pub struct Rig {
    pub arm: Arm,
    pub base: Base,
    /// Cameras, ordered by name.
    pub cameras: Vec<Camera>,
    /// Range scanners, ordered by name.
    pub scanners: Vec<Scanner>,
    pub join: JoinConfig,
    pub train: Train,
    pub sim: Sim,
}

/// The arm that carries the cameras, or that they see.
#[derive(Clone, Debug, PartialEq)]
pub struct Arm {
    pub driver: ArmDriver,
    /// Network address of the device; empty if the driver needs none.
    pub address: String,
    /// The URDF text.
    pub urdf_text: String,
    /// Moving joints in the order of the joint states.
    pub joints: Vec<String>,
    /// Offsets added to the joint states, in their order, rad or m; empty if there are none.
    pub joint_offsets: Vec<f64>,
    pub base_link: String,
    pub flange_link: String,
    pub max_speed_rad_s: f64,
    /// Rate at which motors on CAN buses are polled, Hz.
    pub rate_hz: f64,
    /// CAN buses.
    pub buses: Vec<BusConfig>,
    /// Motors on the buses, in the order of `joints`.
    pub motors: Vec<MotorConfig>,
    /// How the arm may be moved; `None` if it is only read.
    pub motion: Option<ArmMotion>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArmDriver {
    /// The rig has no arm.
    None,
    Franka,
    Can,
    Udp,
    Sim,
}

/// Pose of the base and its source.
#[derive(Clone, Debug, PartialEq)]
pub struct Base {
    pub driver: BaseDriver,
    /// Address on which the driver `udp` listens.
    pub address: SocketAddr,
    pub world_from_base: Transform,
    /// Poses per second if the base moves.
    pub rate_hz: f64,
    /// Whether the pose is re-estimated at each station.
    pub realign: bool,
    /// Poses with larger standard deviations are skipped, meters and radians.
    pub max_sigma_m: f64,
    pub max_sigma_rad: f64,
    /// The tags that the driver `tags` detects, by ID.
    pub tag_family: Family,
    pub tags: BTreeMap<u32, TagPlacement>,
    /// Error of a simulated base's poses at the end of its path, root mean square, meters and radians.
    pub drift_m: f64,
    pub drift_rad: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BaseDriver {
    Fixed,
    Tags,
    Rgbd,
    Udp,
    Sim,
}

/// A range scanner that rotates about its z axis.
#[derive(Clone, Debug, PartialEq)]
pub struct Scanner {
    pub name: Arc<str>,
    pub driver: ScannerDriver,
    /// Address on which the driver `udp` listens.
    pub address: SocketAddr,
    /// Rotations per second.
    pub rate_hz: f64,
    /// Pose on the base: x forward, z up.
    pub base_from_scanner: Transform,
    /// Ranges outside these limits are ignored, meters.
    pub min_m: f64,
    pub max_m: f64,
    pub sim: ScannerSim,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScannerDriver {
    Udp,
    Sim,
}

/// Scan pattern and errors of a simulated scanner.
#[derive(Clone, Debug, PartialEq)]
pub struct ScannerSim {
    pub rings: u32,
    pub columns: u32,
    pub min_elevation_rad: f64,
    pub max_elevation_rad: f64,
    pub noise_sigma_m: f64,
    pub dropped_frac: f64,
}

/// One color camera, optionally with depth.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    pub name: Arc<str>,
    pub driver: CameraDriver,
    /// Path or serial number; empty if the driver needs none.
    pub device: String,
    pub rate_hz: f64,
    /// `None`: automatic; the camera reports the exposure time with each image if it can.
    pub exposure_micros: Option<f64>,
    /// Time from the first to the last row; `None` if unknown, 0 for a global shutter.
    pub readout_micros: Option<f64>,
    /// Time added to a stamp to get mid-exposure; `None` if unknown.
    pub stamp_to_mid_exposure: Option<TimeOffset>,
    pub parent: Parent,
    pub parent_from_camera: Transform,
    pub intrinsics: Intrinsics,
    pub depth: Option<Depth>,
    pub v4l2: V4l2,
    pub realsense: Realsense,
    pub sim: CameraSim,
}

impl Camera {
    /// Mid-exposure time of an image with this device stamp.
    pub fn mid_exposure(&self, device_stamp: Stamp) -> Stamp {
        let offset = self.stamp_to_mid_exposure.as_ref();
        offset.map_or(device_stamp, |offset| device_stamp.plus_secs(offset.value_millis * 1e-3))
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraDriver {
    Realsense,
    V4l2,
    Nokhwa,
    Sim,
}

/// Settings of a camera with the driver `v4l2`, besides its exposure.
#[derive(Clone, Debug, PartialEq)]
pub struct V4l2 {
    /// `None`: the best available format.
    pub format: Option<V4l2Format>,
    /// Raw value of the camera; `None` here and below leaves the setting unchanged or automatic.
    pub gain: Option<i32>,
    pub brightness: Option<i32>,
    pub white_balance_kelvin: Option<i32>,
    pub delivery: Delivery,
    /// How long to search for a disconnected camera, seconds.
    pub reconnect_secs: f64,
}

/// Settings of a camera with the driver `realsense`, besides its exposure.
#[derive(Clone, Debug, PartialEq)]
pub struct Realsense {
    /// Recorded file that is played back instead of a camera; empty for a camera.
    pub file: PathBuf,
    pub pace: Pace,
    /// Offset added to the stamps of the file with the pace `clock`.
    pub clock_offset_nanos: i64,
    pub stream: Stream,
    /// `None` here and below leaves the setting to the camera.
    pub gain: Option<i32>,
    pub brightness: Option<i32>,
    pub white_balance_kelvin: Option<i32>,
    pub preset: Option<String>,
    pub laser_power: Option<f64>,
    pub filters: Vec<Filter>,
    /// How long to search for a disconnected camera, seconds.
    pub reconnect_secs: f64,
    /// Calibration that the camera reports when it is opened.
    pub unknown: UnknownCalibration,
}

/// Which calibration values are missing in the rig file until the camera reports them; their placeholders must not be
/// used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UnknownCalibration {
    pub intrinsics: bool,
    pub depth_intrinsics: bool,
    pub camera_from_depth: bool,
}

/// The frame to which a camera is attached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parent {
    Flange,
    Base,
    World,
}

/// A measured time offset, milliseconds.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeOffset {
    pub value_millis: f64,
    pub sigma_millis: f64,
    /// How it was measured.
    pub source: String,
}

/// Depth images of a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Depth {
    /// Device of the depth images with the driver `v4l2`; empty if the driver needs none.
    pub device: String,
    /// Meters per count if the device does not report it.
    pub meters_per_count: Option<f64>,
    pub intrinsics: Intrinsics,
    /// Pose of the optical frame of the depth images in that of the color images.
    pub camera_from_depth: Transform,
    /// Scale factor for the readings.
    pub factor: f64,
    /// Readings outside these limits, after scaling, are ignored, meters.
    pub min_m: f64,
    pub max_m: f64,
}

/// Errors of a simulated camera.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraSim {
    pub noise_sigma: f64,
    pub shot_frac: f64,
    pub blur_samples: u32,
    pub latency_millis: f64,
    pub dropped_frac: f64,
    pub supersample: u32,
    pub depth_noise_sigma_m: f64,
    pub depth_hole_frac: f64,
    pub meters_per_count: f64,
}

/// Which images become keyframes, and how many are kept.
#[derive(Clone, Debug, PartialEq)]
pub struct JoinConfig {
    pub start_keyframes: usize,
    pub max_keyframes: usize,
    pub max_bytes: u64,
    pub min_translation_m: f64,
    pub min_rotation_rad: f64,
    pub fixed_interval_millis: f64,
    pub fixed_keyframes: usize,
    pub min_sharpness_frac: f64,
    pub max_blur_px: f64,
    pub max_shear_px: f64,
    pub min_luma_frac: f64,
    pub max_luma_frac: f64,
    pub max_clipped_frac: f64,
    pub default_depth_m: f64,
    pub max_gap_millis: f64,
    pub max_wait_millis: f64,
    pub max_range_scans: usize,
}

/// Names of scene models in a rig file: at least one, without duplicates.
#[derive(Clone, Debug)]
pub struct Methods {
    names: Vec<String>,
    location: SourceLocation,
}

impl PartialEq for Methods {
    fn eq(&self, other: &Self) -> bool {
        self.names == other.names
    }
}

impl Methods {
    /// The names, in the order of the file.
    #[must_use]
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// Looks up the methods by their names.
    ///
    /// # Errors
    ///
    /// If a name is not among `known`, with its place in the rig file.
    pub fn resolve<T: Copy>(&self, known: &[(&str, T)]) -> Result<Vec<T>, ConfigError> {
        let find = |name: &String| {
            known.iter().find(|(known, _)| known == name).map(|(_, method)| *method).ok_or_else(|| {
                let names: Vec<_> = known.iter().map(|(name, _)| format!("{name:?}")).collect();
                ConfigError::InvalidValue {
                    at: self.location.clone(),
                    key: "train.method".into(),
                    got: format!("{name:?}"),
                    allowed: format!("{}, or a list of these without duplicates", names.join(", ")),
                }
            })
        };
        self.names.iter().map(find).collect()
    }
}

/// How the model is trained.
#[derive(Clone, Debug, PartialEq)]
pub struct Train {
    /// The scene models to train; trainers know the names.
    pub methods: Methods,
    pub max_splats: Option<u64>,
    pub max_bytes: Option<u64>,
    pub seed: u64,
    pub sh_degree: u32,
    pub scale: f64,
}

/// Settings of the simulation, which is used with `--sim` and by drivers named `sim`.
#[derive(Clone, Debug, PartialEq)]
pub struct Sim {
    pub scene: String,
    pub seed: u64,
    pub ideal: bool,
    /// The simulation waits for the trainer and always gives the same samples.
    pub lockstep: bool,
    pub speed: f64,
    /// The camera rotates only about the vertical axis.
    pub azimuth_only: bool,
    pub duration_secs: Option<f64>,
    pub n_images: Option<u64>,
    pub truth: bool,
    pub truth_depth: bool,
    /// Brightness of the lights once the arm's camera is inside the cabinet, relative to outside.
    pub light_inside_frac: f64,
}

/// A value from the command line that overrides a key of the rig file.
#[derive(Clone, Debug, PartialEq)]
pub struct Override {
    key: &'static str,
    value: toml::Value,
}

impl Override {
    /// `key` is a dotted path, as in `docs/reference/rig.md`.
    pub fn new(key: &'static str, value: impl Into<toml::Value>) -> Self {
        Self { key, value: value.into() }
    }
}

impl Rig {
    /// Whether base poses come from a device, including its errors.
    pub fn has_moving_base(&self) -> bool {
        self.base.driver != BaseDriver::Fixed
    }

    /// Reads and checks a rig file and the robot description that it names.
    pub fn load(path: &Path, overrides: &[Override]) -> Result<Self, ConfigError> {
        let text = read_file("the rig file", path)?;
        let file =
            path.file_name().map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned());
        let folder = path.parent().unwrap_or(Path::new("")).to_owned();
        let mut rig =
            read::rig(&file, &text, overrides, |urdf| read_file("the robot description", &folder.join(urdf)))?;
        if let Some(motion) = rig.arm.motion.as_mut().filter(|motion| !motion.odrive_endpoints.is_empty()) {
            // An absolute path is valid wherever the effective rig file is.
            let path = folder.join(&motion.odrive_endpoints);
            let path = std::path::absolute(&path).map_err(|source| ConfigError::Read {
                description: "ODrive's endpoints",
                path,
                source,
            })?;
            motion.odrive_endpoints = path.to_string_lossy().into_owned();
        }
        for camera in rig.cameras.iter_mut().filter(|camera| !camera.realsense.file.as_os_str().is_empty()) {
            // The effective rig file is in another folder.
            let file = folder.join(&camera.realsense.file);
            camera.realsense.file = std::path::absolute(&file).unwrap_or(file);
        }
        Ok(rig)
    }

    /// Checks the text of a rig file and the robot description `urdf_text`; `file` is the name used in messages.
    pub fn parse(file: &str, text: &str, urdf_text: &str, overrides: &[Override]) -> Result<Self, ConfigError> {
        read::rig(file, text, overrides, |_| Ok(urdf_text.to_owned()))
    }

    /// The effective rig file with every key, from which the same rig can be read. It expects the robot description
    /// next to it.
    pub fn to_toml(&self) -> String {
        write::rig(self)
    }

    /// Whether the calibration is the same: extrinsics, intrinsics, time offsets and depth of the cameras, and joint
    /// offsets.
    pub fn has_same_calibration(&self, other: &Self) -> bool {
        const TOLERANCE: f64 = 1e-9; // Reading a pose back may change its last bit.
        let is_same = |one: &Camera, other: &Camera| {
            let difference = one.parent_from_camera.inverse() * other.parent_from_camera;
            one.name == other.name
                && one.parent == other.parent
                && difference.translation.vector.norm() < TOLERANCE
                && difference.rotation.angle() < TOLERANCE
                && one.intrinsics == other.intrinsics
                && one.stamp_to_mid_exposure == other.stamp_to_mid_exposure
                && one.readout_micros == other.readout_micros
                && one.depth == other.depth
        };
        self.arm.joint_offsets == other.arm.joint_offsets
            && self.cameras.len() == other.cameras.len()
            && self.cameras.iter().zip(&other.cameras).all(|(one, other)| is_same(one, other))
    }

    /// The same rig with a single scene model.
    #[must_use]
    pub fn with_method(&self, name: &str) -> Self {
        let methods = Methods { names: vec![name.to_owned()], location: self.train.methods.location.clone() };
        Self { train: Train { methods, ..self.train.clone() }, ..self.clone() }
    }

    /// Writes the effective rig file and the robot description into a folder; returns the path of the rig file.
    pub fn write_resolved(&self, folder: &Path) -> std::io::Result<PathBuf> {
        let path = folder.join(drivers::recording::RIG_FILE);
        std::fs::write(folder.join(drivers::recording::URDF_FILE), &self.arm.urdf_text)?;
        std::fs::write(&path, self.to_toml())?;
        Ok(path)
    }
}

fn read_file(description: &'static str, path: &Path) -> Result<String, ConfigError> {
    std::fs::read_to_string(path).map_err(|source| ConfigError::Read { description, path: path.to_owned(), source })
}
