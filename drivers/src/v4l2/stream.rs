//! Streams from a V4L2 device and converts buffers to stamped images.

use super::abi::{FIELD_ANY, FIELD_NONE, PixFormat};
use super::controls::{self, AppliedSettings};
use super::device::{Device, FilledBuffer, Refused, Stream};
use super::format::{self, Mode};
use super::sequence::Sequence;
use super::{Config, Delivery, Problem, V4l2Format, find};
use crate::reconnecting::Failure;
use crate::{Error, Image, PixelFormat, V4l2Colors, clock};
use kinematics::Stamp;
use rustix::io::Errno;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Number of image buffers. Eight buffers hold a quarter of a second of images at 30 Hz. With fewer
/// buffers, images are lost when the caller pauses. More buffers take more kernel memory.
const N_BUFFERS: u32 = 8;
/// Maximum time by which a stamp may be earlier than the start of the stream, or later than the
/// current time. A stamp outside these limits comes from another clock, even if its flag states
/// that it is monotonic.
const MAX_STAMP_ERROR_SECS: f64 = 1.0;
/// Maximum duration of an exposure query, as a fraction of the time between two images. Some
/// cameras answer so slowly that images would be lost in the meantime.
const MAX_EXPOSURE_QUERY_FRAC: f64 = 0.25;

/// A streaming device.
#[derive(Debug)]
pub(super) struct V4l2Stream {
    stream: Stream,
    camera: Arc<str>,
    path: PathBuf,
    mode: String,
    format: PixelFormat,
    bytes_per_line: usize,
    applied: AppliedSettings,
    sequence: Sequence,
    started_at: Stamp,
    /// Number of lost images that are not reported yet.
    n_unreported: u64,
    /// Number of damaged images since the last call of [`Self::take_n_damaged`]. They also count as
    /// skipped.
    n_damaged: u64,
    last_image_at: Instant,
    has_warned_of_clock: bool,
}

impl V4l2Stream {
    /// Opens the device of a configuration and starts its stream.
    pub(super) fn start(config: &Config) -> Result<Self, Failure<Problem>> {
        let candidates = find::candidates(&config.device)?;
        // A depth camera has nodes for color, infrared and depth under one serial number. The node
        // with the most preferred format is used.
        match candidates.iter().min_by_key(|path| rank(config, path)) {
            Some(path) => Self::start_node(config, path),
            None => Err(Problem::NoDevice {
                device: config.device.clone(),
            }
            .into()),
        }
    }

    fn start_node(config: &Config, path: &Path) -> Result<Self, Failure<Problem>> {
        let device = open(config, path)?;
        let (mode, pix) = set_mode(config, path, &device)?;
        let colors = V4l2Colors {
            colorspace: pix.colorspace,
            ycbcr_enc: pix.ycbcr_enc,
            quantization: pix.quantization,
            is_hdtv: device.is_hdtv(),
        };
        if mode.format == V4l2Format::Z16 && config.meters_per_count.is_none() {
            return Err(Problem::NoDepthScale.into());
        }
        let format = mode
            .format
            .pixels(colors, config.meters_per_count.unwrap_or(0.0))
            .map_err(Failure::Final)?;
        controls::apply(&config.settings, &device)?;
        let requested = requested(config, Some(mode.format));
        // The time is taken before the stream starts, so that no stamp of the stream can be
        // earlier.
        let started_at = clock::now();
        let stream = device.stream(N_BUFFERS).map_err(|refused| {
            let bytes_per_sec = mode
                .format
                .bytes_per_sec(config.intrinsics.size_px, config.rate_hz);
            stream_problem(refused, path, requested.clone(), bytes_per_sec)
        })?;
        // The settings are confirmed here, because some cameras reset them when the stream starts.
        let applied = controls::confirm(&config.settings, stream.device())?;
        Ok(Self {
            stream,
            camera: config.name.as_str().into(),
            path: path.to_owned(),
            mode: requested,
            format,
            bytes_per_line: pix.bytes_per_line as usize,
            applied,
            sequence: Sequence::default(),
            started_at,
            n_unreported: 0,
            n_damaged: 0,
            last_image_at: Instant::now(),
            has_warned_of_clock: false,
        })
    }

    /// Description of node, mode and settings for the log.
    pub(super) fn describe(&self) -> String {
        let settings: Vec<_> = self
            .applied
            .read_back
            .iter()
            .map(|(name, value)| format!("{name} {value}"))
            .collect();
        format!(
            "{}, {}; read back: {}",
            self.path.display(),
            self.mode,
            settings.join(", ")
        )
    }

    pub(super) fn read_back(&self) -> &[(&'static str, i32)] {
        &self.applied.read_back
    }

    /// Number of damaged images since the last call.
    pub(super) fn take_n_damaged(&mut self) -> u64 {
        std::mem::take(&mut self.n_damaged)
    }

    /// Time since the last complete image.
    pub(super) fn time_since_image(&self) -> Duration {
        self.last_image_at.elapsed()
    }

    /// Discards images that arrived before the first request. They do not count as lost.
    pub(super) fn discard_queued(&mut self) -> Result<(), Problem> {
        for _ in 0..N_BUFFERS {
            let Some(filled) = self.stream.take().map_err(lost)? else {
                break;
            };
            self.stream.requeue(filled).map_err(lost)?;
        }
        // The discarded images must not appear as a gap before the first returned image.
        self.sequence = Sequence::default();
        Ok(())
    }

    /// Returns the next image. Returns `None` if no image arrives before the deadline. An error
    /// means that the device was disconnected.
    pub(super) fn next_image(
        &mut self,
        config: &Config,
        deadline: Instant,
    ) -> Result<Option<Image>, Problem> {
        loop {
            let Some(filled) = self.next_filled(config.delivery, deadline)? else {
                return Ok(None);
            };
            self.n_unreported += self.sequence.n_skipped_before(filled.sequence);
            let image =
                // The image is copied before its buffer goes back to the device. Copying takes a
                // fraction of the time between images. If buffers were held instead, the device
                // would run out of buffers.
                (!filled.is_damaged).then(|| self.image_of(&filled, config.intrinsics.size_px));
            self.stream.requeue(filled).map_err(lost)?;
            match image {
                Some(Ok(mut image)) => {
                    image.exposure_secs = self.exposure_secs(config.rate_hz);
                    image.n_skipped = std::mem::take(&mut self.n_unreported);
                    self.last_image_at = Instant::now();
                    return Ok(Some(image));
                }
                other => {
                    if let Some(Err(error)) = other {
                        log::debug!("{error}");
                    }
                    // A damaged image counts as lost, too, because it is never returned to the
                    // caller.
                    self.n_unreported += 1;
                    self.n_damaged += 1;
                    if Instant::now() >= deadline {
                        return Ok(None);
                    }
                }
            }
        }
    }

    /// Takes the next buffer to deliver, which is the oldest or the newest. If the newest buffer is
    /// taken, older buffers are requeued.
    fn next_filled(
        &mut self,
        delivery: Delivery,
        deadline: Instant,
    ) -> Result<Option<FilledBuffer>, Problem> {
        let mut taken: Option<FilledBuffer> = None;
        loop {
            match self.stream.take().map_err(lost)? {
                Some(newer) => {
                    // For `Newest`, the loop continues until the queue is empty, and requeues all
                    // buffers except the newest. The skipped images are counted in the order of
                    // their sequence numbers.
                    if let Some(older) = taken.replace(newer) {
                        self.n_unreported += self.sequence.n_skipped_before(older.sequence) + 1;
                        self.stream.requeue(older).map_err(lost)?;
                    }
                    if delivery == Delivery::Every {
                        return Ok(taken);
                    }
                }
                None if taken.is_some() => return Ok(taken),
                None => {
                    let timeout = deadline.saturating_duration_since(Instant::now());
                    if !self.stream.wait(timeout).map_err(lost)? && Instant::now() >= deadline {
                        return Ok(None);
                    }
                }
            }
        }
    }

    /// Copies an image out of shared memory and removes the padding of its rows.
    fn image_of(&mut self, filled: &FilledBuffer, size_px: [u32; 2]) -> Result<Image, Error> {
        let stamp = self.stamp_of(filled);
        Image {
            camera: Arc::clone(&self.camera),
            stamp,
            size_px,
            format: self.format,
            data: self.stream.bytes(filled).into(),
            exposure_secs: None,
            n_skipped: 0,
        }
        .pack_rows(self.bytes_per_line)
    }

    /// The stamp of the device, if it is on the monotonic clock of this computer. Otherwise, the
    /// current time. `stamp_to_mid_exposure_millis` of the rig file converts the stamp to
    /// mid-exposure.
    fn stamp_of(&mut self, filled: &FilledBuffer) -> Stamp {
        let now = clock::now();
        let stamp = Stamp(filled.stamp_nanos);
        // Some drivers report monotonic stamps but send stamps of the camera's own clock, which
        // starts at another time.
        let valid_range =
            self.started_at.plus_secs(-MAX_STAMP_ERROR_SECS)..now.plus_secs(MAX_STAMP_ERROR_SECS);
        if filled.is_monotonic && valid_range.contains(&stamp) {
            return stamp;
        }
        if !std::mem::replace(&mut self.has_warned_of_clock, true) {
            log::warn!(
                "camera {:?}: its stamps do not come from the monotonic clock; images are stamped on arrival",
                self.camera
            );
        }
        now
    }

    /// Exposure time, either fixed or read from the camera. If reading fails or takes too long, it
    /// is not read again.
    fn exposure_secs(&mut self, rate_hz: f64) -> Option<f64> {
        if !self.applied.reports_exposure {
            return self.applied.exposure_secs;
        }
        let started_at = Instant::now();
        let exposure_secs = controls::exposure_secs(self.stream.device());
        let elapsed = started_at.elapsed();
        if exposure_secs.is_none() || elapsed.as_secs_f64() * rate_hz > MAX_EXPOSURE_QUERY_FRAC {
            log::warn!(
                "camera {:?}: reading its exposure time failed or took too long ({elapsed:?}); it is no longer recorded",
                self.camera
            );
            self.applied.reports_exposure = false;
        }
        exposure_secs
    }
}

/// Converts the error of a stream that did not start. `ENOSPC` means that USB has no bandwidth left
/// (`usb_submit_urb`).
fn stream_problem(
    refused: Refused,
    path: &Path,
    mode: String,
    bytes_per_sec: Option<f64>,
) -> Problem {
    match refused {
        Refused::Begin(Errno::NOSPC) => Problem::Bandwidth {
            mode,
            bytes_per_sec,
        },
        Refused::Buffers(Errno::BUSY) | Refused::Begin(Errno::BUSY) => Problem::Busy {
            path: path.to_owned(),
        },
        Refused::Buffers(error) => Problem::Refused {
            what: "shared memory for images",
            source: error.into(),
        },
        Refused::Begin(error) => Problem::Refused {
            what: "the start of its stream",
            source: error.into(),
        },
    }
}

/// Converts an error of a streaming device to a disconnection.
fn lost(error: Errno) -> Problem {
    Problem::Unplugged {
        source: error.into(),
    }
}

fn open(config: &Config, path: &Path) -> Result<Device, Problem> {
    let device = Device::open(path).map_err(|error| match error {
        Errno::NOENT | Errno::NXIO | Errno::NODEV => Problem::NoDevice {
            device: config.device.clone(),
        },
        Errno::BUSY => Problem::Busy {
            path: path.to_owned(),
        },
        error => Problem::Open {
            path: path.to_owned(),
            source: error.into(),
        },
    })?;
    match device.identity() {
        Ok(identity) if identity.streams_images => Ok(device),
        _ => Err(Problem::NotACamera {
            path: path.to_owned(),
        }),
    }
}

/// Rank of the format that a node would send, in the order of preference. Nodes without a suitable
/// mode come last.
fn rank(config: &Config, path: &Path) -> usize {
    let modes = open(config, path)
        .map(|device| find::modes(&device))
        .unwrap_or_default();
    let mode = format::choose(
        &modes,
        config.format,
        config.intrinsics.size_px,
        config.rate_hz,
    );
    mode.map_or(usize::MAX, |mode| format::rank(mode.format))
}

/// Selects and sets a mode, and checks that the device uses exactly that mode.
fn set_mode(config: &Config, path: &Path, device: &Device) -> Result<(Mode, PixFormat), Problem> {
    let modes = find::modes(device);
    let size_px = config.intrinsics.size_px;
    let rate_hz = config.rate_hz;
    let mode =
        format::choose(&modes, config.format, size_px, rate_hz).ok_or_else(|| Problem::NoMode {
            requested: requested(config, config.format),
            offered: format::summary(&modes),
        })?;
    let refused = |error| match error {
        Errno::BUSY => Problem::Busy {
            path: path.to_owned(),
        },
        error => Problem::Refused {
            what: "the format",
            source: std::io::Error::from(error),
        },
    };
    let pix = device.set_format(mode.fourcc, size_px).map_err(refused)?;
    let got_hz = device.set_rate_hz(rate_hz).map_err(refused)?;
    // The kernel does not refuse an unsupported mode, but selects the closest supported mode. Lens
    // parameters are valid for only one size.
    let is_same = pix.fourcc == mode.fourcc && [pix.width, pix.height] == size_px;
    if !is_same || got_hz.is_some_and(|got_hz| !format::is_same_rate(got_hz, rate_hz)) {
        let format = V4l2Format::from_fourcc(pix.fourcc).map_or("another format", V4l2Format::name);
        let rate = got_hz.map_or(String::new(), |got_hz| format!(" at {got_hz:.2} Hz"));
        let got = format!("{format} {}x{}{rate}", pix.width, pix.height);
        return Err(Problem::OtherMode {
            requested: requested(config, Some(mode.format)),
            got,
        });
    }
    // Drivers may ignore the requested field order without an error.
    if ![FIELD_ANY, FIELD_NONE].contains(&pix.field) {
        log::warn!(
            "camera {:?}: it sends interlaced images; alternate rows are exposed at different times",
            config.name
        );
    }
    if got_hz.is_none() {
        log::warn!(
            "camera {:?}: its rate cannot be set; assuming rate_hz of the rig file",
            config.name
        );
    }
    Ok((mode.clone(), pix))
}

fn requested(config: &Config, format: Option<V4l2Format>) -> String {
    let [width, height] = config.intrinsics.size_px;
    format!(
        "{} {width}x{height} at {} Hz",
        format.map_or("color", V4l2Format::name),
        config.rate_hz
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bandwidth_error_suggests_fixes() {
        let reported = |refused, mode: &str, bytes| {
            stream_problem(refused, Path::new("/dev/video0"), mode.into(), bytes).to_string()
        };
        let bandwidth_error = reported(
            Refused::Begin(Errno::NOSPC),
            "yuyv 2560x1440 at 30 Hz",
            Some(221.2e6),
        );
        assert!(
            bandwidth_error
                .starts_with("USB has no bandwidth left for yuyv 2560x1440 at 30 Hz (221 MB/s): "),
            "{bandwidth_error}"
        );
        assert!(
            bandwidth_error.contains("mjpeg") && bandwidth_error.contains("another USB controller"),
            "{bandwidth_error}"
        );
        let compressed = reported(
            Refused::Begin(Errno::NOSPC),
            "mjpeg 2560x1440 at 30 Hz",
            None,
        );
        assert!(
            compressed.starts_with("USB has no bandwidth left for mjpeg 2560x1440 at 30 Hz: "),
            "{compressed}"
        );
        assert!(reported(Refused::Buffers(Errno::BUSY), "", None).contains("fuser -v /dev/video0"));
        assert!(
            reported(Refused::Begin(Errno::IO), "", None)
                .starts_with("it rejected the start of its stream: ")
        );
    }
}
