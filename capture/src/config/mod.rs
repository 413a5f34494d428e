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
}

/// The arm that carries the cameras, or that they see.
#[derive(Clone, Debug, PartialEq)]
pub struct Arm {
    /// Source of the joint states.
    pub driver: ArmDriver,
    /// Network address of the device; empty if the driver needs none.
    pub address: String,
    /// The URDF text.
    pub urdf_text: String,
    /// Moving joints in the order of the joint states.
    pub joints: Vec<String>,
    /// Offsets added to the joint states, in their order, rad or m, each from -1 to 1; empty if there are none.
    pub joint_offsets: Vec<f64>,
    /// Link of the URDF that is the base of the robot.
    pub base_link: String,
    /// Link of the URDF to which cameras with the parent [`Parent::Flange`] are attached.
    pub flange_link: String,
    /// Speed limit for all joints when the arm is moved, rad/s or m/s, 0.001 to 10.
    pub max_speed_rad_s: f64,
    /// Rate at which motors on CAN buses are polled and commanded, Hz, 1 to 2000.
    pub rate_hz: f64,
    /// CAN buses.
    pub buses: Vec<BusConfig>,
    /// Motors on the buses, in the order of `joints`.
    pub motors: Vec<MotorConfig>,
    /// How the arm may be moved; `None` if it is only read.
    pub motion: Option<ArmMotion>,
}

/// Source of the joint states.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArmDriver {
    /// The rig has no arm.
    None,
    /// A Franka arm over FCI.
    Franka,
    /// Motors on CAN buses.
    Can,
    /// Datagrams from another program.
    Udp,
    /// The simulator.
    Sim,
}

/// Pose of the base and its source.
#[derive(Clone, Debug, PartialEq)]
pub struct Base {
    /// Source of the base pose.
    pub driver: BaseDriver,
    /// Address on which [`BaseDriver::Udp`] listens.
    pub address: SocketAddr,
    /// Pose of a fixed base; the identity in simulation.
    pub world_from_base: Transform,
    /// Pose rate of a simulated base, Hz, 1 to 1000.
    pub rate_hz: f64,
    /// Whether the pose is re-estimated at each station.
    pub realign: bool,
    /// Measured poses with a larger root mean square position error are discarded, meters, 0.0001 to 100.
    pub max_sigma_m: f64,
    /// The same for the orientation, radians, 0.0001 to 3.2.
    pub max_sigma_rad: f64,
    /// Family of the tags that [`BaseDriver::Tags`] detects.
    pub tag_family: Family,
    /// These tags and their poses in the world, by ID.
    pub tags: BTreeMap<u32, TagPlacement>,
    /// Position error of a simulated base at the end of its path, root mean square, meters, 0 to 10.
    pub drift_m: f64,
    /// The same for the orientation, radians, 0 to 1.
    pub drift_rad: f64,
}

/// Source of the base pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BaseDriver {
    /// The base does not move.
    Fixed,
    /// AprilTags in the images of cameras on the base or the arm.
    Tags,
    /// Reserved: color and depth images. It cannot be opened.
    Rgbd,
    /// Datagrams from another program.
    Udp,
    /// The simulator.
    Sim,
}

/// A range scanner that rotates about its z axis.
#[derive(Clone, Debug, PartialEq)]
pub struct Scanner {
    /// Name of its table in the rig file: letters, digits, `_` and `-`.
    pub name: Arc<str>,
    /// Source of the scans.
    pub driver: ScannerDriver,
    /// Address on which [`ScannerDriver::Udp`] listens.
    pub address: SocketAddr,
    /// Rotations per second, 0.1 to 50.
    pub rate_hz: f64,
    /// Pose on the base: x forward, z up.
    pub base_from_scanner: Transform,
    /// Shorter ranges are discarded, meters, 0 to 100.
    pub min_m: f64,
    /// Longer ranges are discarded, meters, `min_m` to 1000.
    pub max_m: f64,
    /// Scan pattern and errors in simulation.
    pub sim: ScannerSim,
}

/// Source of range scans.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScannerDriver {
    /// Datagrams from another program.
    Udp,
    /// The simulator.
    Sim,
}

/// Scan pattern and errors of a simulated scanner.
#[derive(Clone, Debug, PartialEq)]
pub struct ScannerSim {
    /// Number of rings, evenly spaced in elevation, 1 to 256.
    pub rings: u32,
    /// Directions per ring and scan, 4 to 4096.
    pub columns: u32,
    /// Elevation of the lowest ring, radians, -1.57 to 1.57.
    pub min_elevation_rad: f64,
    /// Elevation of the highest ring, radians, `min_elevation_rad` to 1.57.
    pub max_elevation_rad: f64,
    /// Standard deviation of the range, meters, 0 to 1.
    pub noise_sigma_m: f64,
    /// Fraction of returns that are lost, 0 to 0.9.
    pub dropped_frac: f64,
}

/// One color camera, optionally with depth.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Name of its table in the rig file: letters, digits, `_` and `-`.
    pub name: Arc<str>,
    /// Driver of the camera.
    pub driver: CameraDriver,
    /// Path or serial number; empty if the driver needs none.
    pub device: String,
    /// Frame rate, Hz, 0.01 to 1000.
    pub rate_hz: f64,
    /// Exposure time, microseconds, at most one frame period. `None`: automatic; the camera reports the exposure time
    /// with each image if it can.
    pub exposure_micros: Option<f64>,
    /// Time from the first to the last row, microseconds, at most one frame period; `None` if unknown, 0 for a global
    /// shutter.
    pub readout_micros: Option<f64>,
    /// Time added to a stamp to get mid-exposure; `None` if unknown.
    pub stamp_to_mid_exposure: Option<TimeOffset>,
    /// Frame to which the camera is attached.
    pub parent: Parent,
    /// Extrinsics: pose of the optical frame in the frame of `parent`.
    pub parent_from_camera: Transform,
    /// Lens and size of the color images.
    pub intrinsics: Intrinsics,
    /// Depth images, if the camera delivers them.
    pub depth: Option<Depth>,
    /// Settings of [`CameraDriver::V4l2`] and [`CameraDriver::Nokhwa`].
    pub v4l2: V4l2,
    /// Settings of [`CameraDriver::Realsense`].
    pub realsense: Realsense,
    /// Imperfections of [`CameraDriver::Sim`].
    pub sim: CameraSim,
}

impl Camera {
    /// Mid-exposure time of an image with this device stamp.
    pub(crate) fn mid_exposure(&self, device_stamp: Stamp) -> Stamp {
        let offset = self.stamp_to_mid_exposure.as_ref();
        offset.map_or(device_stamp, |offset| device_stamp.plus_secs(offset.value_millis * 1e-3))
    }
}

/// Driver of a camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraDriver {
    /// A RealSense camera through librealsense2, or a file that it recorded.
    Realsense,
    /// A V4L2 device.
    V4l2,
    /// A webcam through nokhwa.
    Nokhwa,
    /// The simulator.
    Sim,
}

/// Settings of a camera with the driver `v4l2`, besides its exposure.
#[derive(Clone, Debug, PartialEq)]
pub struct V4l2 {
    /// Pixel format. `None`: the best available format.
    pub format: Option<V4l2Format>,
    /// Gain in counts of the camera, -1,000,000 to 1,000,000. `None`: automatic.
    pub gain: Option<i32>,
    /// Brightness in counts of the camera, -1,000,000 to 1,000,000. `None`: unchanged.
    pub brightness: Option<i32>,
    /// Color temperature, kelvin, 1000 to 20,000. `None`: automatic.
    pub white_balance_kelvin: Option<i32>,
    /// Which of the waiting images is delivered next.
    pub delivery: Delivery,
    /// How long to search for a disconnected camera, seconds, 0 to 86,400.
    pub reconnect_secs: f64,
}

/// Settings of a camera with the driver `realsense`, besides its exposure.
#[derive(Clone, Debug, PartialEq)]
pub struct Realsense {
    /// Recorded file that is played back instead of a camera; empty for a camera.
    pub file: PathBuf,
    /// Speed and stamps of the playback.
    pub pace: Pace,
    /// Offset added to the stamps of the file with [`Pace::Clock`], nanoseconds.
    pub clock_offset_nanos: i64,
    /// Stream of the images that are not depth.
    pub stream: Stream,
    /// Gain in counts of the camera, -1,000,000 to 1,000,000. `None`: automatic.
    pub gain: Option<i32>,
    /// Brightness in counts of the camera, -1,000,000 to 1,000,000. `None`: unchanged.
    pub brightness: Option<i32>,
    /// Color temperature, kelvin, 1000 to 20,000. `None`: automatic.
    pub white_balance_kelvin: Option<i32>,
    /// Preset of the depth camera, by the name that the camera gives it. `None`: unchanged.
    pub preset: Option<String>,
    /// Power of the projector or laser in units of the camera, 0 to 1000. `None`: unchanged.
    pub laser_power: Option<f64>,
    /// Depth filters in the order of their application, without duplicates.
    pub filters: Vec<Filter>,
    /// How long to search for a disconnected camera, seconds, 0 to 86,400.
    pub reconnect_secs: f64,
    /// Calibration that the camera reports when it is opened.
    pub unknown: UnknownCalibration,
}

/// Which calibration values are missing in the rig file until the camera reports them; their placeholders must not be
/// used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UnknownCalibration {
    /// [`Camera::intrinsics`], except the size.
    pub intrinsics: bool,
    /// [`Depth::intrinsics`], except the size.
    pub depth_intrinsics: bool,
    /// [`Depth::camera_from_depth`].
    pub camera_from_depth: bool,
}

/// The frame to which a camera is attached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parent {
    /// The flange of the arm, [`Arm::flange_link`].
    Flange,
    /// The base of the robot.
    Base,
    /// The world: the camera does not move.
    World,
}

/// A measured time offset.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeOffset {
    /// Time added to the stamps of the device, milliseconds, -1000 to 1000.
    pub value_millis: f64,
    /// Standard deviation of the value, milliseconds, 0 to 1000.
    pub sigma_millis: f64,
    /// How it was measured; may be empty.
    pub source: String,
}

/// Depth images of a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Depth {
    /// Device of the depth images with the driver `v4l2`; empty if the driver needs none.
    pub device: String,
    /// Meters per count if the device does not report it, 0.000001 to 0.1.
    pub meters_per_count: Option<f64>,
    /// Lens and size of the depth images.
    pub intrinsics: Intrinsics,
    /// Pose of the optical frame of the depth images in that of the color images.
    pub camera_from_depth: Transform,
    /// Scale factor for the readings, 0.5 to 2.
    pub factor: f64,
    /// Smaller readings, after scaling, are discarded, meters, 0 to 100.
    pub min_m: f64,
    /// Larger readings, after scaling, are discarded, meters, `min_m` to 1000.
    pub max_m: f64,
}

/// Errors of a simulated camera.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraSim {
    /// Standard deviation of the noise at mid-gray, 8-bit levels, 0 to 100.
    pub noise_sigma: f64,
    /// Fraction of the noise variance that is shot noise, 0 to 1.
    pub shot_frac: f64,
    /// Instants averaged over the exposure, 1 to 64; 1 means no motion blur.
    pub blur_samples: u32,
    /// Time from the end of the readout to delivery, milliseconds, 0 to 10,000.
    pub latency_millis: f64,
    /// Fraction of images that are lost, 0 to 0.9.
    pub dropped_frac: f64,
    /// Rendered samples per pixel along each axis, 1 to 4.
    pub supersample: u32,
    /// Standard deviation of depth at 1 m, meters, 0 to 1; grows with the square of the depth.
    pub depth_noise_sigma_m: f64,
    /// Fraction of depth pixels without a reading, 0 to 0.9.
    pub depth_hole_frac: f64,
    /// Meters per count of the depth images, 0.000001 to 0.1.
    pub meters_per_count: f64,
}

/// Which images become keyframes, and how many are kept.
#[derive(Clone, Debug, PartialEq)]
pub struct JoinConfig {
    /// Number of keyframes with which training starts, 1 to 100,000.
    pub start_keyframes: usize,
    /// Maximum number of keyframes in the store, 8 to 1,000,000.
    pub max_keyframes: usize,
    /// Maximum host memory of the keyframes in the store, bytes, 1,000,000 to 2^50.
    pub max_bytes: u64,
    /// Minimum distance to every keyframe of the same camera, meters, 0.000001 to 100; this or the rotation suffices.
    pub min_translation_m: f64,
    /// Minimum rotation relative to every keyframe of the same camera, radians, 0.000001 to 3.2.
    pub min_rotation_rad: f64,
    /// Interval between keyframes of a camera that cannot move, milliseconds, 0 to 1e9.
    pub fixed_interval_millis: f64,
    /// Maximum number of keyframes of such a camera, 1 to 1,000,000.
    pub fixed_keyframes: usize,
    /// Minimum sharpness relative to the median of the last images of the camera, 0 to 1.
    pub min_sharpness_frac: f64,
    /// Maximum predicted motion blur, pixels, 0 to 1000.
    pub max_blur_px: f64,
    /// Maximum predicted rolling-shutter shear, pixels, 0 to 1000.
    pub max_shear_px: f64,
    /// Minimum mean brightness, 0 to 1.
    pub min_luma_frac: f64,
    /// Maximum mean brightness, 0 to 1.
    pub max_luma_frac: f64,
    /// Maximum fraction of black or white pixels, 0 to 1.
    pub max_clipped_frac: f64,
    /// Scene depth assumed for a camera without depth, meters, 0.01 to 1000.
    pub default_depth_m: f64,
    /// Maximum gap between two samples over which poses are interpolated, milliseconds, 0.1 to 10,000.
    pub max_gap_millis: f64,
    /// Maximum time that an image waits for other samples, milliseconds, 1 to 60,000.
    pub max_wait_millis: f64,
    /// Maximum number of range scans kept beside the keyframes, 0 to 1,000,000.
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
    /// Maximum number of splats, in [`MAX_SPLATS_RANGE`]. `None`: the trainer's default.
    pub max_splats: Option<u64>,
    /// Maximum GPU memory of the model, bytes, in [`MAX_BYTES_RANGE`]. `None`: unlimited.
    pub max_bytes: Option<u64>,
    /// Random seed, in [`SEED_RANGE`].
    pub seed: u64,
    /// Maximum degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u32,
    /// Width and height of training images relative to the undistorted camera images, 0.05 to 1.
    pub scale: f64,
}

/// Settings of the simulation, which is used with `--sim` and by drivers named `sim`.
#[derive(Clone, Debug, PartialEq)]
pub struct Sim {
    /// Name of the scene; the simulator knows the names.
    pub scene: String,
    /// Random seed, in [`SEED_RANGE`].
    pub seed: u64,
    /// Whether sensor imperfections and the drift of the base are off.
    pub ideal: bool,
    /// Whether the simulation waits for its consumer and always gives the same samples.
    pub lockstep: bool,
    /// Speed factor of the scanning motion, 0.01 to 2.
    pub speed: f64,
    /// Whether the camera rotates only about the vertical axis.
    pub azimuth_only: bool,
    /// Simulated time after which the samples end, seconds, 0.001 to 1e6. `None`: unlimited.
    pub duration_secs: Option<f64>,
    /// Number of color images of the first camera after which the samples end, 1 to 1e9. `None`: unlimited.
    pub n_images: Option<u64>,
    /// Whether ground truth is delivered with the images.
    pub truth: bool,
    /// Whether the ground truth includes depth without noise.
    pub truth_depth: bool,
    /// Brightness of the lights while a camera on the flange is inside the cabinet, relative to outside, 0 to 4.
    pub light_inside_frac: f64,
}

/// A value from the command line that overrides a key of the rig file.
#[derive(Clone, Debug, PartialEq)]
pub struct Override {
    key: &'static str,
    value: toml::Value,
}

impl Override {
    /// An override of `key`, a dotted path as in `docs/reference/rig.md`, such as `train.seed`.
    #[must_use]
    pub fn new(key: &'static str, value: impl Into<toml::Value>) -> Self {
        Self { key, value: value.into() }
    }
}

impl Rig {
    /// Whether base poses come from a device, including its errors.
    #[must_use]
    pub fn has_moving_base(&self) -> bool {
        self.base.driver != BaseDriver::Fixed
    }

    /// Reads and checks a rig file and the robot description that it names. Paths in the rig become absolute.
    ///
    /// # Errors
    ///
    /// If a file cannot be read, the text is not TOML, a key is unknown or missing, a value is not allowed, or the
    /// robot description does not match. An unknown key is reported before any other problem with keys.
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
    ///
    /// # Errors
    ///
    /// As [`Rig::load`], without those of files.
    pub fn parse(file: &str, text: &str, urdf_text: &str, overrides: &[Override]) -> Result<Self, ConfigError> {
        read::rig(file, text, overrides, |_| Ok(urdf_text.to_owned()))
    }

    /// The effective rig file with every key, from which the same rig can be read. It expects the robot description
    /// next to it.
    #[must_use]
    pub fn to_toml(&self) -> String {
        write::rig(self)
    }

    /// Whether the calibration is the same: extrinsics, intrinsics, time offsets and depth of the cameras, and joint
    /// offsets.
    #[must_use]
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
    ///
    /// # Errors
    ///
    /// If a file cannot be written.
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
