//! What a simulated rig is made of: scene, cameras, how real their flaws are, and when it ends.

use crate::Error;
use kinematics::{Intrinsics, Lens, Transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};

/// A simulated rig.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// Which scene is built.
    pub scene: Scene,
    /// Keys every random number; the same seed gives the same bits in lockstep.
    pub seed: u64,
    /// Switches every flaw of the sensors off: noise, blur, shear, holes, latency, dropped images. Lens and range limits stay.
    pub ideal: bool,
    /// Whether each colour image is followed by its [`drivers::TruthImage`].
    pub truth: bool,
    /// Whether the truth of cameras with depth carries the noise-free depth.
    pub truth_depth: bool,
    /// Factor on the speed of the scanning motion, above 0 to 2; at 1 the camera moves at 0.1 to 0.25 m/s.
    pub speed: f64,
    /// Whether the camera only turns about the vertical axis: a scan that does not show the whole hand-eye transform.
    pub azimuth_only: bool,
    /// The rig ends after this simulated time, seconds.
    pub duration_secs: Option<f64>,
    /// The rig ends once the first camera has delivered this many colour images.
    pub n_images: Option<u64>,
    /// Names of the arm's joints from base to flange.
    pub joint_names: Vec<String>,
    /// The same names in the order of the joint readings.
    pub reading_order: Vec<String>,
    /// The cameras, each with its own name.
    pub cameras: Vec<CameraConfig>,
}

/// The scenes that can be built.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scene {
    /// A Panda on a table between two walls; a furry toy, a tag cube and a wooden block.
    StaticArm,
}

impl Scene {
    /// Every scene.
    pub const ALL: [Self; 1] = [Self::StaticArm];

    /// Name in the rig file.
    pub fn name(self) -> &'static str {
        match self {
            Self::StaticArm => "static-arm",
        }
    }

    /// The scene of this name in the rig file.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|scene| scene.name() == name)
    }
}

/// Frame that a camera is fixed to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parent {
    /// The arm's flange: the camera moves with it.
    Flange,
    /// The world: the camera stands still.
    World,
}

/// One simulated camera.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraConfig {
    /// Name in the rig file.
    pub name: String,
    /// True lens parameters and image size; depth is registered to them.
    pub intrinsics: Intrinsics,
    /// Images a second.
    pub rate_hz: f64,
    /// What the camera is fixed to.
    pub parent: Parent,
    /// Pose on the parent.
    pub parent_from_camera: Transform,
    /// Flaws of the colour images.
    pub sensor: SensorConfig,
    /// Depth images, where the camera has them.
    pub depth: Option<DepthConfig>,
}

/// Flaws of colour images. Exposure and white balance are locked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorConfig {
    /// Standard deviation of the noise at mid grey (128), in steps of 255.
    pub noise_sigma: f64,
    /// Share of the noise variance at mid grey that is shot noise (grows with brightness); the rest is read noise.
    pub shot_frac: f64,
    /// Exposure time, microseconds. It only blurs when `blur_samples` is above 1.
    pub exposure_micros: f64,
    /// Instants averaged over the exposure time; 1 gives no motion blur.
    pub blur_samples: u32,
    /// Time from the first row's exposure to the last row's, microseconds; 0 for a global shutter.
    pub readout_micros: f64,
    /// From the end of the readout to the delivery, milliseconds.
    pub latency_millis: f64,
    /// Share of the images that the device loses.
    pub dropped_frac: f64,
    /// Rendered pixels a pixel along each side, 1 to 4: 1 is cheap and jagged, 2 is smooth.
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

/// Flaws and limits of depth images, which come with the stamp of the colour image and a global shutter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthConfig {
    /// Standard deviation at 1 m, metres; grows with the square of the depth.
    pub noise_sigma_m: f64,
    /// Share of the pixels without depth, most of them where depth jumps.
    pub hole_frac: f64,
    /// Nearer surfaces have no depth, metres.
    pub min_m: f64,
    /// Further surfaces have no depth, metres.
    pub max_m: f64,
    /// Metres per count of the delivered image.
    pub metres_per_count: f64,
}

impl Default for DepthConfig {
    fn default() -> Self {
        Self { noise_sigma_m: 0.0015, hole_frac: 0.02, min_m: 0.1, max_m: 6.0, metres_per_count: 1e-4 }
    }
}

impl CameraConfig {
    /// A wrist RGB-D camera like a `RealSense` D435i, 640x480 at 15 Hz, tilted on a bracket beside the flange.
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
            parent_from_camera: wrist_mount(),
            sensor: SensorConfig::default(),
            depth: Some(DepthConfig::default()),
        }
    }
}

/// The bracket of the wrist camera, as `flange_from_camera`: beside the flange, tilted by 50 degrees to look past it.
///
/// The tilt lets the arm look at the scene from low elevations without reaching its joint limits.
fn wrist_mount() -> Transform {
    let quarter = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
    let tilt = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 50f64.to_radians());
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
            cameras: vec![CameraConfig::wrist("wrist")],
        }
    }
}

impl Config {
    /// Which joint, counted from the base, each number of a reading is of.
    pub(crate) fn joint_ixs(&self) -> Result<Vec<usize>, Error> {
        let find = |name: &String| {
            let unknown = || Error::UnknownJoint { joint: name.clone(), known: self.joint_names.clone() };
            self.joint_names.iter().position(|known| known == name).ok_or_else(unknown)
        };
        self.reading_order.iter().map(find).collect()
    }

    /// Says what is wrong with the numbers before MuJoCo, which would abort the process, sees them.
    pub fn check(&self) -> Result<(), Error> {
        check("sim", "speed", self.speed, 0.01, 2.0)?;
        if let Some(secs) = self.duration_secs {
            check("sim", "duration_secs", secs, 0.0, 1e6)?;
        }
        if self.joint_names.len() != N_JOINTS {
            return Err(Error::NJoints { got: self.joint_names.len(), expected: N_JOINTS });
        }
        self.joint_ixs()?;
        if self.cameras.is_empty() {
            return Err(Error::NoCamera);
        }
        for (ix, camera) in self.cameras.iter().enumerate() {
            if self.cameras[..ix].iter().any(|other| other.name == camera.name) {
                return Err(Error::SameName { camera: camera.name.clone() });
            }
            camera.check()?;
        }
        Ok(())
    }
}

/// Moving joints of the simulated arm.
pub const N_JOINTS: usize = 7;

impl CameraConfig {
    fn check(&self) -> Result<(), Error> {
        let Intrinsics { size_px, focal_px, principal_px, .. } = &self.intrinsics;
        for axis in 0..2 {
            let size = f64::from(size_px[axis]);
            check(&self.name, "size_px", size, 16.0, 4096.0)?;
            check(&self.name, "focal_px", focal_px[axis], 0.2 * size, 20.0 * size)?;
            check(&self.name, "principal_px", principal_px[axis], 0.0, size)?;
        }
        check(&self.name, "rate_hz", self.rate_hz, 0.01, 200.0)?;
        let pose =
            self.parent_from_camera.translation.vector.iter().chain(self.parent_from_camera.rotation.coords.iter());
        for number in pose {
            check(&self.name, "parent_from_camera", *number, -100.0, 100.0)?;
        }
        let sensor = &self.sensor;
        check(&self.name, "noise_sigma", sensor.noise_sigma, 0.0, 100.0)?;
        check(&self.name, "shot_frac", sensor.shot_frac, 0.0, 1.0)?;
        check(&self.name, "exposure_micros", sensor.exposure_micros, 0.0, 1e6 / self.rate_hz)?;
        check(&self.name, "blur_samples", f64::from(sensor.blur_samples), 1.0, 64.0)?;
        check(&self.name, "readout_micros", sensor.readout_micros, 0.0, 1e6 / self.rate_hz)?;
        check(&self.name, "latency_millis", sensor.latency_millis, 0.0, 10_000.0)?;
        check(&self.name, "dropped_frac", sensor.dropped_frac, 0.0, 0.9)?;
        check(&self.name, "supersample", f64::from(sensor.supersample), 1.0, 4.0)?;
        if let Some(depth) = &self.depth {
            check(&self.name, "depth noise_sigma_m", depth.noise_sigma_m, 0.0, 1.0)?;
            check(&self.name, "hole_frac", depth.hole_frac, 0.0, 0.9)?;
            check(&self.name, "depth min_m", depth.min_m, 0.0, 10.0)?;
            check(&self.name, "depth max_m", depth.max_m, depth.min_m, 100.0)?;
            check(&self.name, "metres_per_count", depth.metres_per_count, 1e-6, 0.1)?;
        }
        Ok(())
    }
}

/// Refuses numbers outside `lower..=upper`, and NaN.
fn check(of: &str, key: &'static str, got: f64, lower: f64, upper: f64) -> Result<(), Error> {
    if got >= lower && got <= upper {
        return Ok(());
    }
    Err(Error::OutOfRange { of: of.to_owned(), key, got, lower, upper })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_rig_is_valid_and_bad_numbers_are_named() {
        let mut config = Config::default();
        assert!(config.check().is_ok());
        config.cameras[0].sensor.readout_micros = f64::NAN;
        let message = config.check().expect_err("NaN").to_string();
        assert!(message.contains("readout_micros") && message.contains("wrist"), "{message}");
        config = Config::default();
        config.cameras.push(CameraConfig::wrist("wrist"));
        assert!(matches!(config.check(), Err(Error::SameName { .. })));
    }
}
