//! The keys in `[camera.NAME]`.

use super::key::{Choice, Key, Keys, choices, entry, keys, table_of};
use super::lens::PLACEHOLDER_INTRINSICS;
use super::section::Section;
use super::table_schema::TableSchema;
use drivers::realsense::{Filter, Pace, Stream};
use drivers::v4l2::{Delivery, V4l2Format};
use kinematics::{Intrinsics, Stamp, Transform};
use serde_json::json;
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::sync::Arc;
use toml::Table;

/// Range of control values. The limits of the camera are checked when it is opened.
const CONTROL_RANGE: RangeInclusive<i32> = -1_000_000..=1_000_000;

keys! {
    /// One color camera, optionally with depth.
    #[derive(Clone, Debug, PartialEq)]
    pub struct Camera {
        /// Name of its table in the rig file: letters, digits, `_` and `-`.
        pub name: Arc<str> => "".into();
        /// Driver of the camera.
        pub driver: CameraDriver, required "realsense, v4l2, nokhwa or sim";
        /// Path or serial number of the camera, as `fieldrig devices` prints it.
        pub device: String = String::new();
        /// Images per second.
        pub rate_hz: f64, in 0.01..=1000.0, required "images per second";
        /// Exposure time, microseconds, at most one frame period. Without this key, the exposure is
        /// automatic, and known only if the camera reports it with each image.
        pub exposure_micros: Option<f64>, in 0.0..=period_micros(rate_hz), within 0.0..=LONGEST_PERIOD_MICROS;
        /// Time from the exposure of the first row to that of the last row, microseconds, at most
        /// one frame period. It is 0 for a global shutter. Without this key, it is unknown.
        pub readout_micros: Option<f64>, in 0.0..=period_micros(rate_hz), within 0.0..=LONGEST_PERIOD_MICROS;
        /// Time that is added to a stamp to get mid-exposure. Without this table, it is unknown.
        pub stamp_to_mid_exposure: Option<TimeOffset> as "stamp_to_mid_exposure_millis";
        /// Frame to which the camera is attached.
        pub parent: Parent, required "flange, base or world";
        /// Extrinsics: pose of the optical frame in the frame of `parent`.
        pub parent_from_camera: Transform = Transform::identity();
        /// Lens and size of the color images.
        pub intrinsics: Intrinsics = PLACEHOLDER_INTRINSICS;
        /// Covariance of focal lengths, principal point and distortion coefficients, row by row. An
        /// empty list means that it is unknown.
        pub intrinsics_covariance: Vec<f64> = Vec::new();
        /// Whether the robot is masked in the images. Without this key, it is masked if the camera
        /// is not on the flange.
        pub mask_robot: Option<bool>;
        /// How far the mask extends beyond the robot, meters. Set it to the error of
        /// `parent_from_camera`, if that is larger.
        pub mask_margin_m: f64 = 0.01, in 0.0..=0.5;
        /// Depth images, if the camera delivers them.
        pub depth: Option<Depth> => None;
        /// Calibration that the rig file omits.
        pub unknown: UnknownCalibration => UnknownCalibration::default();
        /// Settings of cameras with the driver `v4l2` or `nokhwa`.
        pub v4l2: V4l2;
        /// Settings of cameras with the driver `realsense`.
        pub realsense: Realsense;
        /// Imperfections of a simulated camera.
        pub sim: CameraSim;
    }

    /// Settings of a camera with the driver `v4l2`, besides its exposure.
    #[derive(Clone, Debug, PartialEq)]
    pub struct V4l2 {
        /// Pixel format. Without this key, the best available format.
        pub format: Option<V4l2Format>;
        /// Gain in counts of the camera. Without this key, automatic.
        pub gain: Option<i32>, in CONTROL_RANGE;
        /// Brightness in counts of the camera. Without this key, unchanged.
        pub brightness: Option<i32>, in CONTROL_RANGE;
        /// Color temperature, kelvin. Without this key, automatic.
        pub white_balance_kelvin: Option<i32>, in 1000..=20_000;
        /// Which of the waiting images is delivered next.
        pub delivery: Delivery = Delivery::Every;
        /// How long to search for a disconnected camera, seconds.
        pub reconnect_secs: f64 = 30.0, in 0.0..=86_400.0;
    }

    /// Settings of a camera with the driver `realsense`, besides its exposure.
    #[derive(Clone, Debug, PartialEq)]
    pub struct Realsense {
        /// Recorded file that is played back instead of a camera.
        pub file: PathBuf = PathBuf::new();
        /// Speed and stamps of the playback.
        pub pace: Pace = Pace::default();
        /// Offset added to the stamps of the file with the pace `clock`, nanoseconds.
        pub clock_offset_nanos: i64 = 0, in -i64::MAX..=i64::MAX;
        /// Stream of the images that are not depth.
        pub stream: Stream = Stream::default();
        /// Gain in counts of the camera. Without this key, automatic.
        pub gain: Option<i32>, in CONTROL_RANGE;
        /// Brightness in counts of the camera. Without this key, unchanged.
        pub brightness: Option<i32>, in CONTROL_RANGE;
        /// Color temperature, kelvin. Without this key, automatic.
        pub white_balance_kelvin: Option<i32>, in 1000..=20_000;
        /// Name of a preset of the depth camera. Without this key, unchanged.
        pub preset: Option<String>;
        /// Power of the projector or laser in units of the camera. Without this key, unchanged.
        pub laser_power: Option<f64>, in 0.0..=1000.0;
        /// Depth filters in the order of their application, without duplicates.
        pub filters: Vec<Filter> = Vec::new();
        /// How long to search for a disconnected camera, seconds.
        pub reconnect_secs: f64 = 30.0, in 0.0..=86_400.0;
    }

    /// A measured time offset.
    #[derive(Clone, Debug, PartialEq)]
    pub struct TimeOffset {
        /// Time added to the stamps of the device, milliseconds.
        pub value_millis: f64 as "value", in -1000.0..=1000.0, required "milliseconds from the stamp to mid-exposure";
        /// Standard deviation of the value, milliseconds.
        pub sigma_millis: f64 as "sigma" = 0.0, in 0.0..=1000.0;
        /// Description of how the offset was measured.
        pub source: String = String::new();
    }

    /// Depth images of a camera.
    #[derive(Clone, Debug, PartialEq)]
    pub struct Depth {
        /// Device of the depth images with the driver `v4l2`.
        pub device: String = String::new();
        /// Meters per count if the device does not report it.
        pub meters_per_count: Option<f64>, in 1e-6..=0.1;
        /// Lens and size of the depth images.
        pub intrinsics: Intrinsics = PLACEHOLDER_INTRINSICS;
        /// Pose of the optical frame of the depth images in the optical frame of the color images.
        pub camera_from_depth: Transform = Transform::identity();
        /// Scale factor for the readings.
        pub factor: f64 = 1.0, in 0.5..=2.0;
        /// Minimum depth after scaling, meters. Smaller readings are discarded.
        pub min_m: f64 = 0.1, in 0.0..=100.0;
        /// Maximum depth after scaling, meters. Larger readings are discarded.
        pub max_m: f64 = 6.0, in min_m..=1000.0, within 0.0..=1000.0;
    }

    /// Errors of a simulated camera.
    #[derive(Clone, Debug, PartialEq)]
    pub struct CameraSim {
        /// Standard deviation of the noise at mid-gray, 8-bit levels.
        pub noise_sigma: f64 = 2.0, in 0.0..=100.0;
        /// Fraction of the noise variance that is shot noise.
        pub shot_frac: f64 = 0.7, in 0.0..=1.0;
        /// Instants averaged over the exposure; 1 means no motion blur.
        pub blur_samples: u32 = 1, in 1..=64;
        /// Time from the end of the readout to delivery, milliseconds.
        pub latency_millis: f64 = 20.0, in 0.0..=10_000.0;
        /// Fraction of images that are lost.
        pub dropped_frac: f64 = 0.0, in 0.0..=0.9;
        /// Rendered samples per pixel along each axis.
        pub supersample: u32 = 1, in 1..=4;
        /// Standard deviation of the depth noise at 1 m, meters; it grows with the square of the
        /// depth.
        pub depth_noise_sigma_m: f64 = 0.0015, in 0.0..=1.0;
        /// Fraction of depth pixels without a reading.
        pub depth_hole_frac: f64 = 0.02, in 0.0..=0.9;
        /// Meters per count of the depth images.
        pub meters_per_count: f64 = 1e-4, in 1e-6..=0.1;
        /// True calibration. Only values that differ from the rest of the rig file are set.
        pub truth: CameraTruth;
    }

    /// True calibration of a simulated camera. If a value is absent, the value in the rest of the
    /// rig file is true.
    #[derive(Clone, Debug, Default, PartialEq)]
    pub struct CameraTruth {
        /// True `parent_from_camera`.
        pub parent_from_camera: Option<Transform>;
        /// True lens of the color images. The size of the images is that of the rig file.
        pub intrinsics: Option<Intrinsics>;
        /// True time from the stamps to mid-exposure, milliseconds.
        pub stamp_to_mid_exposure_millis: f64 = 0.0, in -1000.0..=1000.0;
        /// Rate error of the clock that stamps the images, parts per million.
        pub clock_drift_ppm: f64 = 0.0, in -10_000.0..=10_000.0;
        /// True `readout_micros`.
        pub readout_micros: Option<f64>, in 0.0..=1e6;
        /// True `depth.camera_from_depth`.
        pub camera_from_depth: Option<Transform>;
        /// True `depth.factor`.
        pub depth_factor: f64 = 1.0, in 0.5..=2.0;
    }
}

impl Camera {
    /// Whether the camera stores its lenses and reports them when it is opened.
    #[must_use]
    pub fn reports_lenses(&self) -> bool {
        self.driver == CameraDriver::Realsense
    }

    /// Mid-exposure time of an image with this device stamp.
    pub(crate) fn mid_exposure(&self, device_stamp: Stamp) -> Stamp {
        let offset = self.stamp_to_mid_exposure.as_ref();
        offset.map_or(device_stamp, |offset| {
            device_stamp.plus_secs(offset.value_millis * 1e-3)
        })
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

/// The frame to which a camera is attached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parent {
    /// The flange of the arm, [`Arm::flange_link`](super::Arm::flange_link).
    Flange,
    /// The base of the robot.
    Base,
    /// The world: the camera does not move.
    World,
}

impl Parent {
    /// Name of the frame in rig files.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Flange => "flange",
            Self::Base => "base",
            Self::World => "world",
        }
    }

    /// The frame with this name.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        let all = [Self::Flange, Self::Base, Self::World];
        all.into_iter().find(|parent| parent.name() == name)
    }
}

/// Calibration values that are missing in the rig file. RealSense cameras report their lenses when
/// they are opened, and calibration finds the rest. Until then, the rig contains placeholders that
/// must not be used. [`Rig::require`](super::Rig::require) rejects them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UnknownCalibration {
    /// Whether [`Camera::parent_from_camera`] is unknown. The placeholder is the identity.
    pub parent_from_camera: bool,
    /// Whether [`Camera::intrinsics`] are unknown, except for the size and `rectified`.
    pub intrinsics: bool,
    /// Whether [`Depth::intrinsics`] are unknown, except for the size.
    pub depth_intrinsics: bool,
    /// Whether [`Depth::camera_from_depth`] is unknown.
    pub camera_from_depth: bool,
}

choices! {
    CameraDriver { Realsense = "realsense", V4l2 = "v4l2", Nokhwa = "nokhwa", Sim = "sim" }
    Parent { Flange = "flange", Base = "base", World = "world" }
    Delivery { Every = "every", Newest = "newest" }
    Pace { RealTime = "real_time", Fast = "fast", Clock = "clock" }
    Stream { Color = "color", Infrared = "infrared" }
    Filter { Spatial = "spatial", Temporal = "temporal", HoleFilling = "hole_filling" }
}

impl Choice for V4l2Format {
    const NAMES: &'static [(&'static str, Self)] = &Self::COLOR_FORMATS;
}

/// The time from one image to the next at the lowest frame rate.
const LONGEST_PERIOD_MICROS: f64 = 1e8;

/// The time from one image to the next at this frame rate.
fn period_micros(rate_hz: Option<f64>) -> f64 {
    1e6 / rate_hz.unwrap_or(1.0)
}

/// Schema of the table of a camera.
pub(super) fn schema() -> TableSchema {
    let mut camera = table_of::<Camera>();
    let mut depth = table_of::<Depth>();
    for (table, images) in [(&mut camera, "color images"), (&mut depth, "depth images")] {
        let about = format!("Width and height of the {images}, pixels.");
        table.add("size_px", &about, <[u32; 2]>::schema(()));
        let about = format!("Whether the {images} are already undistorted.");
        table.add_with_default("rectified", &about, bool::schema(()), false.write());
        let about =
            format!("Lens of the {images}: a table, or the path of a camera info file of ROS.");
        let alternatives = json!({ "anyOf": [Intrinsics::schema(()), String::schema(())] });
        table.add("intrinsics", &about, alternatives);
    }
    camera.require("size_px");
    camera.table("depth", "Depth images of the camera.", depth);
    camera
}

pub(super) fn read(name: &str, mut keys: Section<'_>) -> Option<Camera> {
    keys.check_name(name);
    let mut unknown = UnknownCalibration {
        parent_from_camera: !keys.has("parent_from_camera"),
        intrinsics: !keys.has("intrinsics"),
        ..UnknownCalibration::default()
    };
    // Size and `rectified` are keys of the camera and not of its lens. They are read separately and
    // then combined with the lens.
    let size_px = keys.required::<[u32; 2]>("size_px", (), "width and height of the images");
    let rectified = keys.get("rectified", ()).unwrap_or(false);
    let camera = Camera::read_keys(&mut keys);
    let lens = camera
        .as_ref()
        .map_or(PLACEHOLDER_INTRINSICS, |camera| camera.intrinsics.clone());
    let intrinsics = Intrinsics {
        size_px: size_px.unwrap_or(lens.size_px),
        rectified,
        ..lens
    };
    let depth = keys
        .optional_section("depth")
        .map(|keys| depth(keys, &intrinsics, &mut unknown));
    keys.end();
    let mut camera = Camera {
        name: name.into(),
        intrinsics,
        depth: depth.flatten(),
        ..camera?
    };
    if let Some(lens) = &mut camera.sim.truth.intrinsics {
        // The true lens belongs to the same images.
        lens.size_px = camera.intrinsics.size_px;
        lens.rectified = camera.intrinsics.rectified;
    }
    if !camera.reports_lenses() {
        // Depth of other cameras is registered to the color images unless the rig file has values.
        unknown.depth_intrinsics &= unknown.intrinsics;
        unknown.camera_from_depth = false;
    }
    camera.unknown = unknown;
    Some(camera)
}

fn depth(
    mut keys: Section<'_>,
    color: &Intrinsics,
    unknown: &mut UnknownCalibration,
) -> Option<Depth> {
    unknown.depth_intrinsics = !keys.has("intrinsics");
    unknown.camera_from_depth = !keys.has("camera_from_depth");
    let size_px = keys.get("size_px", ()).unwrap_or(color.size_px);
    let rectified = keys.get("rectified", ()).unwrap_or(color.rectified);
    let depth = Depth::read_keys(&mut keys);
    keys.end();
    let depth = depth?;
    let lens = if !unknown.depth_intrinsics {
        depth.intrinsics
    } else if size_px == color.size_px {
        // Depth of the same size as the color image is registered to it.
        color.clone()
    } else {
        // Depth of another size is assumed to have the same field of view.
        color.resized(size_px)
    };
    Some(Depth {
        intrinsics: Intrinsics {
            size_px,
            rectified,
            ..lens
        },
        ..depth
    })
}

/// Writes the keys of a camera, without unknown calibration.
pub(super) fn write(camera: &Camera) -> Table {
    let Camera {
        intrinsics,
        unknown,
        ..
    } = camera;
    let mut table = camera.write_keys();
    table.extend(entry("size_px", &intrinsics.size_px));
    table.extend(entry("rectified", &intrinsics.rectified));
    // A placeholder in the effective rig file would look like a calibration.
    if unknown.intrinsics {
        table.remove("intrinsics");
    }
    if unknown.parent_from_camera {
        table.remove("parent_from_camera");
    }
    if let Some(depth) = &camera.depth {
        table.insert("depth".to_owned(), write_depth(depth, *unknown).into());
    }
    table
}

fn write_depth(depth: &Depth, unknown: UnknownCalibration) -> Table {
    let mut table = depth.write_keys();
    table.extend(entry("size_px", &depth.intrinsics.size_px));
    table.extend(entry("rectified", &depth.intrinsics.rectified));
    if unknown.depth_intrinsics {
        table.remove("intrinsics");
    }
    if unknown.camera_from_depth {
        table.remove("camera_from_depth");
    }
    table
}
