//! Configuration of a RealSense camera.

use std::path::PathBuf;
use std::time::Duration;

/// A RealSense camera as configured in the rig file.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// Name in the rig file.
    pub name: String,
    /// Serial number. If it is empty, the only connected camera is used.
    pub serial: String,
    /// Recorded file to play back instead of a camera.
    pub file: Option<PathBuf>,
    /// Timing of images played back from a file.
    pub pace: Pace,
    /// Offset that is added to the stamps of the file, nanoseconds. It is used only with
    /// [`Pace::Clock`].
    pub clock_offset_nanos: i64,
    /// Stream of the images that are not depth.
    pub stream: Stream,
    /// Width and height of these images, pixels.
    pub size_px: [u32; 2],
    /// Images per second.
    pub rate_hz: f64,
    /// Width and height of depth images, pixels. `None` if depth is not streamed.
    pub depth_size_px: Option<[u32; 2]>,
    /// Settings of the camera.
    pub settings: Settings,
    /// Depth filters of the library, in order.
    pub filters: Vec<Filter>,
    /// Maximum time for reconnecting to a camera.
    pub reconnect_for: Duration,
}

/// Delivery times of the images of a file, and the clock of their stamps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pace {
    /// Images are delivered as by a live camera. The first image comes immediately and is stamped
    /// on arrival. Later images follow at the recorded intervals.
    #[default]
    RealTime,
    /// Images are delivered as fast as the caller takes them, with the stamps of the file.
    Fast,
    /// Stamps are the stamps of the file plus [`Config::clock_offset_nanos`], on the monotonic
    /// clock of this computer. Each image is delivered at the time of its stamp. Simulations use
    /// this pace to emulate other devices in parallel with the file.
    Clock,
}

/// A stream of images that are not depth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Stream {
    /// The color camera.
    #[default]
    Color,
    /// The only infrared camera, or the left infrared camera of a D4xx. Depth is in the frame of
    /// this camera.
    Infrared,
}

/// Camera settings. A missing setting is set to automatic if the camera supports it. Otherwise, the
/// setting is left unchanged.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Settings {
    /// Exposure time of [`Config::stream`], microseconds. `None` selects automatic exposure that
    /// does not lower the rate.
    pub exposure_micros: Option<f64>,
    /// Gain, in units of the camera.
    pub gain: Option<i32>,
    /// White balance, kelvin.
    pub white_balance_kelvin: Option<i32>,
    /// Brightness, in units of the camera.
    pub brightness: Option<i32>,
    /// Name of a preset of the depth camera.
    pub preset: Option<String>,
    /// Power of the projector or laser, in units of the camera. The unit of a D4xx is milliwatts. A
    /// power of 0 turns the projector or laser off.
    pub laser_power: Option<f64>,
}

/// A depth filter of the library, with its default parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Filter {
    /// Edge-preserving smoothing across neighboring pixels.
    Spatial,
    /// Smoothing over time. Moving objects leave trails.
    Temporal,
    /// Fills pixels without depth from their left neighbors. The result is not measured depth.
    HoleFilling,
}
