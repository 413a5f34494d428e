//! Selects and opens the streams requested by a rig file, and reads their calibration.

use super::sdk::{Device, Mode, Modes, Queue};
use super::{Config, Problem, Stream, lens};
use crate::{PixelFormat, YuvColors, YuvLayout, YuvMatrix, YuvRange};
use kinematics::{Intrinsics, Transform};
use realsense_rust::kind::Rs2Option;
use realsense_sys as sys;
use std::collections::BTreeSet;

/// YUV encoding as in librealsense2 (`src/proc/color-formats-converter.cpp`), which is BT.601 with
/// limited range.
const YUV_COLORS: YuvColors = YuvColors {
    matrix: YuvMatrix::Bt601,
    range: YuvRange::Limited,
};
/// Image formats in order of preference. Native formats of the camera come before formats that the
/// library converts.
const FORMATS: [(sys::rs2_format, &str, PixelFormat); 5] = [
    (
        sys::rs2_format_RS2_FORMAT_YUYV,
        "yuyv",
        PixelFormat::Yuv {
            layout: YuvLayout::Yuyv,
            colors: YUV_COLORS,
        },
    ),
    (
        sys::rs2_format_RS2_FORMAT_UYVY,
        "uyvy",
        PixelFormat::Yuv {
            layout: YuvLayout::Uyvy,
            colors: YUV_COLORS,
        },
    ),
    (sys::rs2_format_RS2_FORMAT_RGB8, "rgb", PixelFormat::Rgb8),
    (sys::rs2_format_RS2_FORMAT_BGR8, "bgr", PixelFormat::Bgr8),
    (sys::rs2_format_RS2_FORMAT_Y8, "gray", PixelFormat::Gray8),
];
/// Index of the left of two infrared cameras.
const LEFT: i32 = 1;

/// Calibration stored in a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// Lens parameters of the images that are not depth.
    pub intrinsics: Intrinsics,
    /// Calibration of depth, if it is enabled.
    pub depth: Option<DepthCalibration>,
}

/// Calibration of the depth images of a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthCalibration {
    /// Lens parameters.
    pub intrinsics: Intrinsics,
    /// Pose of the depth camera in the frame of the other images.
    pub camera_from_depth: Transform,
    /// Meters per count.
    pub meters_per_count: f64,
}

/// Running streams. [`ActiveStreams::stop`] stops them.
#[derive(Debug)]
pub(super) struct ActiveStreams {
    pub(super) calibration: Calibration,
    /// Pixel format of the images that are not depth.
    pub(super) format: PixelFormat,
    /// Sensor of the images that are not depth.
    pub(super) image_sensor: usize,
    /// Sensors that are running.
    sensors: BTreeSet<usize>,
    /// Description of the modes for the log.
    pub(super) description: String,
    /// Lists of modes into which the running modes point.
    _modes: Vec<Modes>,
}

/// A requested stream.
struct StreamRequest {
    name: &'static str,
    stream: sys::rs2_stream,
    size_px: [u32; 2],
    /// Formats in order of preference.
    formats: Vec<sys::rs2_format>,
}

impl StreamRequest {
    fn fits(&self, mode: &Mode, rate_hz: Option<f64>) -> bool {
        mode.size_px == self.size_px
            // The library reports rates as integers, so 29.97 Hz is 30.
            && rate_hz.is_none_or(|rate_hz| (f64::from(mode.rate_hz) - rate_hz).abs() < 0.5)
            && self.formats.contains(&mode.format)
            && self.is_of_stream(mode)
    }

    /// Whether a mode belongs to this stream. If there are two infrared cameras, only the left
    /// camera matches, because depth is in its frame.
    fn is_of_stream(&self, mode: &Mode) -> bool {
        let is_infrared = mode.stream == sys::rs2_stream_RS2_STREAM_INFRARED;
        mode.stream == self.stream && (!is_infrared || mode.index <= LEFT)
    }

    /// Best mode among all sensors, as the index of the sensor and the index of the mode in this
    /// sensor.
    fn choose(&self, config: &Config, modes: &[Modes]) -> Result<(usize, usize), Problem> {
        // A file has only one rate, which follows from its stamps.
        let rate_hz = config.file.is_none().then_some(config.rate_hz);
        let mode_at = |(sensor, mode): (usize, usize)| &modes[sensor].modes[mode];
        indices_of_all(modes)
            .into_iter()
            .filter(|indices| self.fits(mode_at(*indices), rate_hz))
            .min_by_key(|indices| self.rank(mode_at(*indices)))
            .ok_or_else(|| self.no_mode(modes, rate_hz))
    }

    /// Place of the format of a mode in the order of preference.
    fn rank(&self, mode: &Mode) -> Option<usize> {
        self.formats
            .iter()
            .position(|format| *format == mode.format)
    }

    /// The problem that no mode fits, with the modes that the camera offers for this stream.
    fn no_mode(&self, modes: &[Modes], rate_hz: Option<f64>) -> Problem {
        // A set removes duplicates, because several sensors or formats of the library may describe
        // the same mode.
        let offered: BTreeSet<String> = modes
            .iter()
            .flat_map(|modes| &modes.modes)
            .filter(|mode| self.is_of_stream(mode))
            .map(describe)
            .collect();
        let offered: Vec<_> = offered.into_iter().collect();
        let [width, height] = self.size_px;
        let rate = rate_hz.map_or(String::new(), |rate_hz| format!(" at {rate_hz} Hz"));
        Problem::NoMode {
            requested: format!("{} {width}x{height}{rate}", self.name),
            offered: if offered.is_empty() {
                format!("no {}", self.name)
            } else {
                offered.join(", ")
            },
        }
    }
}

/// Index of the sensor and of the mode of all modes.
fn indices_of_all(modes: &[Modes]) -> Vec<(usize, usize)> {
    let mut indices = Vec::new();
    for (sensor, modes) in modes.iter().enumerate() {
        for mode in 0..modes.modes.len() {
            indices.push((sensor, mode));
        }
    }
    indices
}

/// Opens the requested streams and starts them into a queue.
pub(super) fn start(
    config: &Config,
    device: &Device,
    queue: &Queue,
) -> Result<ActiveStreams, Problem> {
    // The modes of all sensors are needed first, because color and depth may be streams of one
    // sensor or of two sensors.
    let modes: Vec<Modes> = device
        .sensors
        .iter()
        .map(|sensor| sensor.modes())
        .collect::<Result<_, _>>()?;
    let (name, stream) = match config.stream {
        Stream::Color => ("color", sys::rs2_stream_RS2_STREAM_COLOR),
        Stream::Infrared => ("infrared", sys::rs2_stream_RS2_STREAM_INFRARED),
    };
    let formats = FORMATS.map(|(format, ..)| format).to_vec();
    let image = StreamRequest {
        name,
        stream,
        size_px: config.size_px,
        formats,
    }
    .choose(config, &modes)?;
    let depth = config.depth_size_px.map(|size_px| {
        StreamRequest {
            name: "depth",
            stream: sys::rs2_stream_RS2_STREAM_DEPTH,
            size_px,
            formats: vec![sys::rs2_format_RS2_FORMAT_Z16],
        }
        .choose(config, &modes)
    });
    let depth = depth.transpose()?;
    let mode_at = |(sensor, mode): (usize, usize)| &modes[sensor].modes[mode];
    // The calibration depends on the mode. It is read before the streams start, so that nothing has
    // to be stopped if reading fails.
    let calibration = Calibration {
        intrinsics: lens::intrinsics(&mode_at(image).intrinsics()?, name)?,
        depth: depth
            .map(|depth| depth_calibration(device, depth, mode_at(depth), mode_at(image)))
            .transpose()?,
    };
    // Everything below refers to modes by the indices of sensor and mode.
    let chosen: Vec<_> = std::iter::once(image).chain(depth).collect();
    let description: Vec<_> = chosen
        .iter()
        .map(|indices| describe(mode_at(*indices)))
        .collect();
    let started = ActiveStreams {
        calibration,
        format: FORMATS
            .iter()
            .find(|(format, ..)| *format == mode_at(image).format)
            .expect("the mode was chosen from these formats")
            .2,
        image_sensor: image.0,
        sensors: chosen.iter().map(|(sensor, _)| *sensor).collect(),
        description: description.join(" and "),
        _modes: Vec::new(),
    };
    // All modes of a sensor must be opened in one call, because a second call fails. Depth and
    // infrared share a sensor.
    for sensor in &started.sensors {
        let sensor_modes: Vec<_> = chosen
            .iter()
            .filter(|indices| indices.0 == *sensor)
            .map(|indices| mode_at(*indices))
            .collect();
        device.sensors[*sensor]
            .open(&sensor_modes)
            .inspect_err(|_| started.stop(device))?;
    }
    started
        // If one sensor fails, the others must be stopped, or the camera stays busy.
        .run(device, queue, config.file.is_some())
        .inspect_err(|_| started.stop(device))?;
    Ok(ActiveStreams {
        // The running modes point into the lists, so the lists are kept as long as the streams run.
        _modes: modes,
        ..started
    })
}

impl ActiveStreams {
    /// Starts all open sensors. A file sends its first images to the sensors that start first, so
    /// it is paused until all are started.
    fn run(&self, device: &Device, queue: &Queue, is_file: bool) -> Result<(), Problem> {
        if is_file {
            device.set_paused(true)?;
        }
        self.sensors
            .iter()
            .try_for_each(|sensor| device.sensors[*sensor].start(queue))?;
        if is_file {
            device.set_paused(false)?;
        }
        Ok(())
    }

    /// Stops the streams. `device` must be the device on which they were started.
    pub(super) fn stop(&self, device: &Device) {
        self.sensors
            .iter()
            .for_each(|sensor| device.sensors[*sensor].stop());
    }
}

fn depth_calibration(
    device: &Device,
    (sensor, _): (usize, usize),
    depth: &Mode,
    image: &Mode,
) -> Result<DepthCalibration, Problem> {
    let calibration_problem = |reason: String| Problem::Library {
        what: "get the calibration of depth",
        reason,
    };
    let extrinsics = depth
        .profile()?
        .extrinsics(&image.profile()?)
        .map_err(|error| calibration_problem(error.to_string()))?;
    let scale = device.sensors[sensor]
        .options
        .get_option(Rs2Option::DepthUnits);
    let scale =
        scale.ok_or_else(|| calibration_problem("it does not report depth units".into()))?;
    // The shortest decimal of the single-precision value is parsed, so that the scale is 0.001 and
    // not 0.001000000047.
    let meters_per_count = scale
        .to_string()
        .parse()
        .map_err(|_| calibration_problem("its depth units are not a number".into()))?;
    Ok(DepthCalibration {
        intrinsics: lens::intrinsics(&depth.intrinsics()?, "depth")?,
        camera_from_depth: lens::transform(&extrinsics.0),
        meters_per_count,
    })
}

fn describe(mode: &Mode) -> String {
    let [width, height] = mode.size_px;
    let format = match mode.format {
        sys::rs2_format_RS2_FORMAT_Z16 => "z16",
        other => FORMATS
            .iter()
            .find(|(format, ..)| *format == other)
            .map_or("another format", |(_, name, _)| name),
    };
    format!("{format} {width}x{height} at {} Hz", mode.rate_hz)
}
