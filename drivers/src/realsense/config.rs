//! What a rig file says of a RealSense camera.

use std::path::PathBuf;
use std::time::Duration;

/// A RealSense camera as the rig file has it.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// Name in the rig file.
    pub name: String,
    /// Serial number; empty takes the only one that is plugged in.
    pub serial: String,
    /// A recorded file that is played in the place of a camera.
    pub file: Option<PathBuf>,
    /// When images of a file come.
    pub pace: Pace,
    /// With [`Pace::Clock`]: what is added to the stamps of the file, nanoseconds.
    pub clock_offset_nanos: i64,
    /// Which stream gives the images that are not depth.
    pub stream: Stream,
    /// Their width and height, pixels.
    pub size_px: [u32; 2],
    /// Images a second.
    pub rate_hz: f64,
    /// Width and height of depth, pixels; `None` takes no depth.
    pub depth_size_px: Option<[u32; 2]>,
    /// How the camera is set up.
    pub settings: Settings,
    /// What the library does to depth, in this order.
    pub filters: Vec<Filter>,
    /// How long a camera that was lost is looked for.
    pub reconnect_for: Duration,
}

/// When the images of a file come, and on which clock their stamps are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pace {
    /// As from a camera: the first at once, and that is its stamp; the others as long after it as they were recorded.
    #[default]
    RealTime,
    /// As fast as they are taken, with the stamps of the file.
    Fast,
    /// With the stamps of the file and [`Config::clock_offset_nanos`], which are of this computer's monotonic clock, and each when
    /// that time has come: for simulations that play other devices beside the file.
    Clock,
}

/// A stream of images that are not depth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Stream {
    /// The colour camera.
    #[default]
    Color,
    /// The left (D4xx) or only infrared camera, which depth is registered to.
    Infrared,
}

/// How a camera is set up; what is left open is automatic where the camera can do that, else left as it is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Settings {
    /// Exposure time of [`Config::stream`], microseconds; `None` lets the camera choose at the rate it was asked for.
    pub exposure_micros: Option<f64>,
    /// Gain, counts of the camera.
    pub gain: Option<i32>,
    /// White balance, kelvin.
    pub white_balance_kelvin: Option<i32>,
    /// Brightness, counts of the camera.
    pub brightness: Option<i32>,
    /// Preset of the depth camera, by the name that the camera gives it.
    pub preset: Option<String>,
    /// Power of the projector or laser, in the camera's units (D4xx: milliwatts); 0 switches it off.
    pub laser_power: Option<f64>,
}

/// A filter of the library on depth images, as it is set up there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Filter {
    /// Smooths over neighbouring pixels, edges kept.
    Spatial,
    /// Smooths over earlier images: what moves leaves traces.
    Temporal,
    /// Fills pixels without a reading from their left: invented depth.
    HoleFilling,
}
