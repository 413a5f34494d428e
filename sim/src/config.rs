//! Configuration of a simulated rig, with the scene, the cameras, the imperfections of the sensors,
//! and the end of the run.

use crate::Error;
use crate::twin::RobotConfig;
use kinematics::{Intrinsics, Lens, Transform, transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use targets::TargetSpec;

/// A simulated rig.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// Scene to build.
    pub scene: Scene,
    /// Seed of all random numbers. In lockstep, the same seed gives identical bits.
    pub seed: u64,
    /// Disables all sensor imperfections, which are noise, blur, rolling-shutter shear, holes,
    /// latency and dropped images. The lens and the range limits remain in effect.
    pub ideal: bool,
    /// Whether each color image is followed by its [`drivers::TruthImage`].
    pub truth: bool,
    /// Whether the ground truth of cameras with depth includes noise-free depth.
    pub truth_depth: bool,
    /// Factor on the speed of the scanning motion, 0.01 to 2. With a factor of 1, the camera moves
    /// at 0.1 to 0.25 m/s.
    pub speed: f64,
    /// Whether the camera only rotates about the vertical axis. Such a scan does not determine the
    /// whole hand-eye transform.
    pub azimuth_only: bool,
    /// The rig stops after this simulated time, seconds.
    pub duration_secs: Option<f64>,
    /// The rig stops after the first camera has delivered this many color images.
    pub n_images: Option<u64>,
    /// Names of the arm's joints from base to flange.
    pub joint_names: Vec<String>,
    /// Joint names in the order of the joint readings.
    pub reading_order: Vec<String>,
    /// Offsets that must be added to the joint readings to get the true positions, in the order of
    /// the readings, radians. The list is empty if the readings are right.
    pub joint_offsets: Vec<f64>,
    /// The cameras. Their names are unique.
    pub cameras: Vec<CameraConfig>,
    /// The range scanners. Their names are unique.
    pub scanners: Vec<ScannerConfig>,
    /// Reporting of a moving base.
    pub base: BaseConfig,
    /// Brightness of all lamps while the arm's camera is inside the cabinet, relative to the
    /// brightness outside. A value of 1 has no effect.
    pub light_inside_frac: f64,
    /// Printed calibration targets in the scene. Their names are unique.
    pub targets: Vec<TargetConfig>,
    /// The robot of a rig file. `None` selects the robot of the scene.
    pub robot: Option<RobotConfig>,
}

/// A calibration target, printed on a flat plate.
#[derive(Clone, Debug, PartialEq)]
pub struct TargetConfig {
    /// Name in the rig file.
    pub name: String,
    /// Specification, such as `charuco:5x7:34mm:26mm:5X5_100`.
    pub spec: String,
    /// Frame that the board is attached to.
    pub parent: TargetParent,
    /// Pose of the board frame. On the print, x points right, y points down, and z points into the
    /// plate.
    pub parent_from_board: Transform,
}

/// Frame that a printed target is attached to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TargetParent {
    /// The world. The target is stationary.
    World,
    /// The arm's flange. The arm carries the target.
    Flange,
    /// A hand that holds the target at many places in front of a camera, one after the other. The
    /// pose of the board follows from the hand, and [`TargetConfig::parent_from_board`] is not
    /// used.
    Hand {
        /// Index of the camera in [`Config::cameras`].
        camera_ix: usize,
    },
}

impl Config {
    /// Whether the arm carries a target, so that images of all cameras depend on its joints.
    pub(crate) fn has_carried_target(&self) -> bool {
        self.targets
            .iter()
            .any(|target| target.parent == TargetParent::Flange)
    }
}

impl TargetConfig {
    /// The parsed specification.
    pub(crate) fn target(&self) -> Result<TargetSpec, Error> {
        self.spec.parse().map_err(|source| Error::Target {
            target: self.name.clone(),
            source,
        })
    }
}

/// Poses reported by a scene's moving base.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BaseConfig {
    /// Poses per second.
    pub rate_hz: f64,
    /// Root mean square error of the reported position at the end of the walk, meters. The walk
    /// ends after one lap or at the last station. The error grows with the square root of the
    /// distance.
    pub drift_m: f64,
    /// Root mean square error of the reported orientation at the end of the walk, radians.
    pub drift_rad: f64,
}

impl Default for BaseConfig {
    fn default() -> Self {
        Self {
            rate_hz: 100.0,
            drift_m: 0.02,
            drift_rad: 0.0175,
        }
    }
}

/// A simulated range scanner that rotates about its z axis, fixed to the base.
#[derive(Clone, Debug, PartialEq)]
pub struct ScannerConfig {
    /// Name in the rig file.
    pub name: String,
    /// Revolutions per second.
    pub rate_hz: f64,
    /// Pose on the base: x forward, z up.
    pub base_from_scanner: Transform,
    /// Number of rings, spaced evenly over the elevation range.
    pub n_rings: u32,
    /// Elevation of the lowest and highest ring, radians above the sensor's xy plane.
    pub elevation_rad: [f64; 2],
    /// Number of rays per ring and revolution.
    pub n_columns: u32,
    /// Minimum range, meters. Closer surfaces give no echo.
    pub min_m: f64,
    /// Maximum range, meters. Surfaces farther away give no echo.
    pub max_m: f64,
    /// Standard deviation of the range, meters.
    pub noise_sigma_m: f64,
    /// Fraction of echoes that are dropped.
    pub dropped_frac: f64,
}

impl ScannerConfig {
    /// A scanner with sixteen rings at 10 Hz, on the back of the quadruped.
    pub fn sixteen_rings(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            rate_hz: 10.0,
            base_from_scanner: Transform::translation(-0.2, 0.0, 0.2),
            n_rings: 16,
            elevation_rad: [-0.2618, 0.2618],
            n_columns: 900,
            min_m: 0.4,
            max_m: 50.0,
            noise_sigma_m: 0.02,
            dropped_frac: 0.01,
        }
    }
}

/// The available scenes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scene {
    /// A Panda on a table between two walls, with a furry toy, a tag cube and a wooden block.
    StaticArm,
    /// A quadruped walks around a wooden pedestal with a glass bowl in a laboratory of 15 x 10 m.
    MobileBase,
    /// A Panda on a quadruped in front of a switchboard cabinet. The base first stands 2 m away,
    /// and then close to the cabinet, where the arm moves the camera into it.
    MobileArm,
}

impl Scene {
    /// All scenes.
    pub const ALL: [Self; 3] = [Self::StaticArm, Self::MobileBase, Self::MobileArm];

    /// Whether the robot has an arm.
    pub fn has_arm(self) -> bool {
        self != Self::MobileBase
    }

    /// Whether the robot's base moves and reports its pose.
    pub fn has_moving_base(self) -> bool {
        self != Self::StaticArm
    }

    /// Name in the rig file.
    pub fn name(self) -> &'static str {
        match self {
            Self::StaticArm => "static-arm",
            Self::MobileBase => "mobile-base",
            Self::MobileArm => "mobile-arm",
        }
    }

    /// Returns the scene with this name in the rig file.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|scene| scene.name() == name)
    }
}

/// Frame that a camera is attached to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parent {
    /// The arm's flange. The camera moves with the arm.
    Flange,
    /// The robot's base.
    Base,
    /// The world. The camera is stationary.
    World,
}

/// One simulated camera.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraConfig {
    /// Name in the rig file.
    pub name: String,
    /// True lens parameters and image size.
    pub intrinsics: Intrinsics,
    /// Images per second.
    pub rate_hz: f64,
    /// Frame that the camera is attached to.
    pub parent: Parent,
    /// Camera pose in the parent frame.
    pub parent_from_camera: Transform,
    /// Errors of the image stamps.
    pub stamps: StampConfig,
    /// Imperfections of the color images.
    pub sensor: SensorConfig,
    /// Depth images, if the camera has them.
    pub depth: Option<DepthConfig>,
}

/// Errors of image stamps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StampConfig {
    /// Time that must be added to a stamp to get mid-exposure, seconds.
    pub to_mid_exposure_secs: f64,
    /// Rate error of the clock. The clock gains this fraction of the time since the start.
    pub drift_frac: f64,
}

/// Imperfections of color images. Exposure and white balance are locked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorConfig {
    /// Standard deviation of the noise at mid gray (128), on a scale of 0 to 255.
    pub noise_sigma: f64,
    /// Fraction of the noise variance at mid gray that is shot noise, which grows with brightness.
    /// The rest is read noise.
    pub shot_frac: f64,
    /// Exposure time, microseconds. It causes blur only if `blur_samples` is above 1.
    pub exposure_micros: f64,
    /// Number of instants that are averaged over the exposure time. With 1, there is no motion
    /// blur.
    pub blur_samples: u32,
    /// Time from the exposure of the first row to the exposure of the last row, microseconds. It is
    /// 0 for a global shutter.
    pub readout_micros: f64,
    /// Time from the end of the readout to the delivery, milliseconds.
    pub latency_millis: f64,
    /// Fraction of images that the device drops.
    pub dropped_frac: f64,
    /// Rendered pixels per image pixel along each side, 1 to 4. With 1, rendering is fast and
    /// images are aliased. With 2, images are smooth.
    pub supersample: u32,
}

impl Default for SensorConfig {
    fn default() -> Self {
        Self {
            noise_sigma: 2.0,
            shot_frac: 0.7,
            exposure_micros: 1000.0,
            blur_samples: 1,
            readout_micros: 15_000.0,
            latency_millis: 20.0,
            dropped_frac: 0.0,
            supersample: 1,
        }
    }
}

/// Imperfections and limits of depth images. A depth image has the stamp of the color image. All
/// its pixels are exposed at the same time.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthConfig {
    /// Factor that must be applied to the readings to get the true depth.
    pub factor: f64,
    /// Separate depth sensor. If `None`, depth is registered to the color image.
    pub sensor: Option<DepthSensor>,
    /// Standard deviation of the noise at 1 m, meters. It grows with the square of the depth.
    pub noise_sigma_m: f64,
    /// Fraction of pixels without depth, most of them at depth discontinuities.
    pub hole_frac: f64,
    /// Minimum depth, meters. Closer surfaces have no depth.
    pub min_m: f64,
    /// Maximum depth, meters. Surfaces farther away have no depth.
    pub max_m: f64,
    /// Meters per count of the delivered image.
    pub meters_per_count: f64,
}

/// A depth sensor next to the color sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthSensor {
    /// Lens parameters and size of the depth images.
    pub intrinsics: Intrinsics,
    /// Its pose in the frame of the color camera.
    pub camera_from_depth: Transform,
}

impl Default for DepthConfig {
    fn default() -> Self {
        Self {
            factor: 1.0,
            sensor: None,
            noise_sigma_m: 0.0015,
            hole_frac: 0.02,
            min_m: 0.1,
            max_m: 6.0,
            meters_per_count: 1e-4,
        }
    }
}

impl CameraConfig {
    /// A wrist RGB-D camera like a `RealSense` D435i, with 640x480 at 15 Hz. It is tilted and on a
    /// bracket next to the flange.
    pub fn wrist(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            intrinsics: Intrinsics {
                size_px: [640, 480],
                focal_px: [614.6, 614.2],
                principal_px: [323.7, 236.4],
                lens: Lens::Pinhole,
                rectified: false,
            },
            rate_hz: 15.0,
            parent: Parent::Flange,
            parent_from_camera: wrist_extrinsics(50.0),
            stamps: StampConfig::default(),
            sensor: SensorConfig::default(),
            depth: Some(DepthConfig::default()),
        }
    }

    /// A wrist RGB-D camera like a `RealSense` L515, for upright objects in front of the arm. It
    /// has 1280x720 color at 4 Hz, and 640x480 depth with its own lens and pose. It is tilted by 80
    /// degrees.
    pub fn mobile_wrist(name: &str) -> Self {
        Self {
            intrinsics: pinhole([1280, 720], [905.3, 904.7], [648.2, 355.1]),
            rate_hz: 4.0,
            parent_from_camera: wrist_extrinsics(80.0),
            depth: Some(DepthConfig {
                sensor: Some(DepthSensor {
                    intrinsics: pinhole([640, 480], [461.2, 461.5], [324.6, 236.9]),
                    camera_from_depth: Transform::translation(0.001, -0.0141, -0.004),
                }),
                noise_sigma_m: 0.0025,
                min_m: 0.15,
                max_m: 2.6,
                meters_per_count: 0.00025,
                ..DepthConfig::default()
            }),
            ..Self::wrist(name)
        }
    }
}

fn pinhole(size_px: [u32; 2], focal_px: [f64; 2], principal_px: [f64; 2]) -> Intrinsics {
    Intrinsics {
        size_px,
        focal_px,
        principal_px,
        lens: Lens::Pinhole,
        rectified: false,
    }
}

/// The bracket of the wrist camera, as `flange_from_camera`. The camera is next to the flange, and
/// is tilted to look past it.
///
/// With the tilt, the arm can view the scene from low elevations without reaching its joint limits.
fn wrist_extrinsics(tilt_degrees: f64) -> Transform {
    let quarter = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
    let tilt = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), tilt_degrees.to_radians());
    Transform::from_parts(Translation3::new(0.06, 0.0, 0.045), quarter * tilt)
}

impl Default for Config {
    fn default() -> Self {
        Self {
            scene: Scene::StaticArm,
            seed: 1,
            ideal: false,
            truth: true,
            truth_depth: false,
            speed: 1.0,
            azimuth_only: false,
            duration_secs: None,
            n_images: None,
            joint_names: (1..=7).map(|ix| format!("panda_joint{ix}")).collect(),
            reading_order: (1..=7).map(|ix| format!("panda_joint{ix}")).collect(),
            joint_offsets: Vec::new(),
            cameras: vec![CameraConfig::wrist("wrist")],
            scanners: Vec::new(),
            base: BaseConfig::default(),
            light_inside_frac: 1.0,
            targets: Vec::new(),
            robot: None,
        }
    }
}

impl Config {
    /// Whether the robot has an arm.
    pub(crate) fn has_arm(&self) -> bool {
        match &self.robot {
            Some(_) => !self.joint_names.is_empty(),
            None => self.scene.has_arm(),
        }
    }

    /// Whether the robot's base moves and reports its pose.
    pub(crate) fn has_moving_base(&self) -> bool {
        match &self.robot {
            Some(robot) => robot.has_moving_base,
            None => self.scene.has_moving_base(),
        }
    }

    /// Index of the joint, counted from the base, for each value of a reading.
    pub(crate) fn joint_ixs(&self) -> Result<Vec<usize>, Error> {
        self.reading_order
            .iter()
            .map(|name| self.joint_ix(name))
            .collect()
    }

    fn joint_ix(&self, name: &str) -> Result<usize, Error> {
        self.joint_names
            .iter()
            .position(|known| known == name)
            .ok_or_else(|| Error::UnknownJoint {
                joint: name.to_owned(),
                known: self.joint_names.clone(),
            })
    }

    /// Checks all numbers before they reach MuJoCo, which aborts the process on invalid numbers.
    pub fn check(&self) -> Result<(), Error> {
        check("sim", "speed", self.speed, 0.01, 2.0)?;
        if let Some(secs) = self.duration_secs {
            check("sim", "duration_secs", secs, 0.0, 1e6)?;
        }
        self.check_joints()?;
        check("sim", "light_inside_frac", self.light_inside_frac, 0.0, 4.0)?;
        self.base.check()?;
        self.check_cameras()?;
        self.check_scanners()?;
        self.check_targets()
    }

    fn check_joints(&self) -> Result<(), Error> {
        let expected = match &self.robot {
            // A robot description may have any number of joints.
            Some(_) => self.joint_names.len(),
            None if self.scene.has_arm() => N_JOINTS,
            None => 0,
        };
        if self.joint_names.len() != expected {
            return Err(Error::NJoints {
                got: self.joint_names.len(),
                expected,
            });
        }
        self.joint_ixs()?;
        // An empty list means that all offsets are zero. A partial list is probably a mistake.
        if !self.joint_offsets.is_empty() && self.joint_offsets.len() != expected {
            return Err(Error::NJoints {
                got: self.joint_offsets.len(),
                expected,
            });
        }
        self.joint_offsets
            .iter()
            .try_for_each(|offset| check("arm", "joint_offsets", *offset, -1.0, 1.0))
    }

    fn check_cameras(&self) -> Result<(), Error> {
        // An arm can be brought up before its cameras.
        if self.cameras.is_empty() && self.robot.is_none() {
            return Err(Error::NoCamera);
        }
        for (ix, camera) in self.cameras.iter().enumerate() {
            // Samples name their camera, so two cameras of the same name would be
            // indistinguishable.
            if self.cameras[..ix]
                .iter()
                .any(|other| other.name == camera.name)
            {
                return Err(Error::DuplicateName {
                    devices: "cameras",
                    name: camera.name.clone(),
                });
            }
            camera.check()?;
            if camera.parent == Parent::Flange && !self.has_arm() {
                return Err(Error::NoFlange {
                    camera: camera.name.clone(),
                });
            }
        }
        Ok(())
    }

    fn check_scanners(&self) -> Result<(), Error> {
        for (ix, scanner) in self.scanners.iter().enumerate() {
            if self.scanners[..ix]
                .iter()
                .any(|other| other.name == scanner.name)
            {
                return Err(Error::DuplicateName {
                    devices: "range scanners",
                    name: scanner.name.clone(),
                });
            }
            scanner.check()?;
        }
        Ok(())
    }

    /// A target in a hand needs the camera in front of which it is moved. Range scanners are
    /// rejected, because they would see the target at another place.
    fn check_hand(&self, target: &str, camera_ix: usize) -> Result<(), Error> {
        if camera_ix < self.cameras.len() && self.scanners.is_empty() {
            return Ok(());
        }
        Err(Error::TargetInHand {
            target: target.to_owned(),
        })
    }

    fn check_targets(&self) -> Result<(), Error> {
        for target in &self.targets {
            target.target()?;
            check_pose(&target.name, "parent_from_board", &target.parent_from_board)?;
            if let TargetParent::Hand { camera_ix } = target.parent {
                self.check_hand(&target.name, camera_ix)?;
            }
            if target.parent == TargetParent::Flange && !self.has_arm() {
                return Err(Error::TargetWithoutFlange {
                    target: target.name.clone(),
                });
            }
        }
        Ok(())
    }
}

impl BaseConfig {
    fn check(&self) -> Result<(), Error> {
        check("base", "rate_hz", self.rate_hz, 1.0, 1000.0)?;
        check("base", "drift_m", self.drift_m, 0.0, 10.0)?;
        check("base", "drift_rad", self.drift_rad, 0.0, 1.0)
    }
}

impl ScannerConfig {
    fn check(&self) -> Result<(), Error> {
        let of = &self.name;
        check(of, "rate_hz", self.rate_hz, 0.1, 50.0)?;
        check(of, "n_rings", self.n_rings.into(), 1.0, 256.0)?;
        check(of, "n_columns", self.n_columns.into(), 4.0, 4096.0)?;
        check(of, "lowest elevation", self.elevation_rad[0], -1.57, 1.57)?;
        // The lower limit is the lowest elevation, so that the range is not empty.
        check(
            of,
            "highest elevation",
            self.elevation_rad[1],
            self.elevation_rad[0],
            1.57,
        )?;
        check(of, "min_m", self.min_m, 0.0, 100.0)?;
        check(of, "max_m", self.max_m, self.min_m, 1000.0)?;
        check(of, "noise_sigma_m", self.noise_sigma_m, 0.0, 1.0)?;
        check(of, "dropped_frac", self.dropped_frac, 0.0, 0.9)?;
        check_pose(of, "base_from_scanner", &self.base_from_scanner)
    }
}

/// Moving joints of the simulated arm.
pub const N_JOINTS: usize = 7;

impl CameraConfig {
    fn check(&self) -> Result<(), Error> {
        check_lens(&self.name, &self.intrinsics)?;
        check(&self.name, "rate_hz", self.rate_hz, 0.01, 200.0)?;
        check_pose(&self.name, "parent_from_camera", &self.parent_from_camera)?;
        check(
            &self.name,
            "stamp_to_mid_exposure",
            self.stamps.to_mid_exposure_secs,
            -1.0,
            1.0,
        )?;
        check(
            &self.name,
            "clock_drift",
            self.stamps.drift_frac,
            -0.01,
            0.01,
        )?;
        let sensor = &self.sensor;
        check(&self.name, "noise_sigma", sensor.noise_sigma, 0.0, 100.0)?;
        check(&self.name, "shot_frac", sensor.shot_frac, 0.0, 1.0)?;
        // An exposure ends before the next exposure begins.
        check(
            &self.name,
            "exposure_micros",
            sensor.exposure_micros,
            0.0,
            1e6 / self.rate_hz,
        )?;
        check(
            &self.name,
            "blur_samples",
            f64::from(sensor.blur_samples),
            1.0,
            64.0,
        )?;
        // The readout must also fit between two images.
        check(
            &self.name,
            "readout_micros",
            sensor.readout_micros,
            0.0,
            1e6 / self.rate_hz,
        )?;
        check(
            &self.name,
            "latency_millis",
            sensor.latency_millis,
            0.0,
            10_000.0,
        )?;
        check(&self.name, "dropped_frac", sensor.dropped_frac, 0.0, 0.9)?;
        check(
            &self.name,
            "supersample",
            f64::from(sensor.supersample),
            1.0,
            4.0,
        )?;
        if let Some(depth) = &self.depth {
            if let Some(sensor) = &depth.sensor {
                check_lens(&self.name, &sensor.intrinsics)?;
            }
            check(&self.name, "depth factor", depth.factor, 0.5, 2.0)?;
            check(
                &self.name,
                "depth noise_sigma_m",
                depth.noise_sigma_m,
                0.0,
                1.0,
            )?;
            check(&self.name, "hole_frac", depth.hole_frac, 0.0, 0.9)?;
            check(&self.name, "depth min_m", depth.min_m, 0.0, 100.0)?;
            check(&self.name, "depth max_m", depth.max_m, depth.min_m, 1000.0)?;
            check(
                &self.name,
                "meters_per_count",
                depth.meters_per_count,
                1e-6,
                0.1,
            )?;
        }
        Ok(())
    }
}

fn check_lens(of: &str, lens: &Intrinsics) -> Result<(), Error> {
    let Intrinsics {
        size_px,
        focal_px,
        principal_px,
        ..
    } = lens;
    for axis in 0..2 {
        let size = f64::from(size_px[axis]);
        check(of, "size_px", size, 16.0, 4096.0)?;
        check(of, "focal_px", focal_px[axis], 0.2 * size, 20.0 * size)?;
        check(of, "principal_px", principal_px[axis], 0.0, size)?;
    }
    Ok(())
}

fn check_pose(of: &str, key: &'static str, pose: &Transform) -> Result<(), Error> {
    transform::to_xyz_xyzw(pose)
        .into_iter()
        .try_for_each(|number| check(of, key, number, -100.0, 100.0))
}

/// Rejects numbers outside `lower..=upper`, and NaN.
fn check(of: &str, key: &'static str, got: f64, lower: f64, upper: f64) -> Result<(), Error> {
    // The condition is false for NaN, so NaN is rejected.
    if got >= lower && got <= upper {
        return Ok(());
    }
    Err(Error::OutOfRange {
        of: of.to_owned(),
        key,
        got,
        lower,
        upper,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn default_config_is_valid_and_errors_name_the_key() {
        let mut config = Config::default();
        assert!(config.check().is_ok());
        config.cameras[0].sensor.readout_micros = f64::NAN;
        let message = config.check().expect_err("NaN").to_string();
        assert!(
            message.contains("readout_micros") && message.contains("wrist"),
            "{message}"
        );
        config = Config::default();
        config.cameras.push(CameraConfig::wrist("wrist"));
        let message = config.check().expect_err("two cameras").to_string();
        assert_eq!(message, "two cameras are named \"wrist\"");
        config = Config::default();
        config.scanners = vec![ScannerConfig::sixteen_rings("lidar"); 2];
        let message = config.check().expect_err("two scanners").to_string();
        assert_eq!(message, "two range scanners are named \"lidar\"");
        config = Config::default();
        let (name, spec) = ("wall".to_owned(), "chessboard:9x6:25".to_owned());
        let parent_from_board = Transform::identity();
        config.targets.push(TargetConfig {
            name,
            spec,
            parent: TargetParent::World,
            parent_from_board,
        });
        let message = config.check().expect_err("no unit").to_string();
        assert!(
            message.contains("wall") && message.contains("no unit"),
            "{message}"
        );
    }

    /// Rig files allow a depth range of up to 100 m to 1000 m for all cameras.
    #[test]
    fn depth_range_is_that_of_rig_files() {
        let check = |min_m, max_m| with_depth_range(min_m, max_m).check();
        assert!(check(100.0, 1000.0).is_ok());
        let message = check(0.1, 1001.0).expect_err("too far").to_string();
        assert!(message.contains("depth max_m"), "{message}");
    }

    fn with_depth_range(min_m: f64, max_m: f64) -> Config {
        let mut config = Config::default();
        config.cameras[0].depth = Some(DepthConfig {
            min_m,
            max_m,
            ..DepthConfig::default()
        });
        config
    }
}
