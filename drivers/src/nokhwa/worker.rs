//! Thread that calls `nokhwa`, whose calls may never return.

use super::{Config, Problem};
use crate::v4l2::V4l2Format;
use crate::{PixelFormat, YuvColors, YuvLayout, YuvMatrix, YuvRange, clock, jpeg};
use kinematics::Stamp;
use nokhwa::Camera;
use nokhwa::utils::{
    ApiBackend, CameraFormat, CameraIndex, CameraInfo, FrameFormat, RequestedFormat,
    RequestedFormatType, Resolution,
};
use parking_lot::{Condvar, Mutex};
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

/// Capacity of the queue to the caller. It holds the images of a quarter of a second at 30 Hz.
const MAX_WAITING: usize = 8;
/// Color encoding assumed for YUV formats, since cameras do not report one.
const DEFAULT_COLORS: YuvColors = YuvColors {
    matrix: YuvMatrix::Bt601,
    range: YuvRange::Limited,
};
/// Formats by their names here and in nokhwa, in order of preference.
const FORMATS: [(V4l2Format, FrameFormat, PixelFormat); 5] = [
    (
        V4l2Format::Yuyv,
        FrameFormat::YUYV,
        PixelFormat::Yuv {
            layout: YuvLayout::Yuyv,
            colors: DEFAULT_COLORS,
        },
    ),
    (
        V4l2Format::Nv12,
        FrameFormat::NV12,
        PixelFormat::Yuv {
            layout: YuvLayout::Nv12,
            colors: DEFAULT_COLORS,
        },
    ),
    (V4l2Format::Mjpeg, FrameFormat::MJPEG, PixelFormat::Jpeg),
    (V4l2Format::Rgb, FrameFormat::RAWRGB, PixelFormat::Rgb8),
    (V4l2Format::Bgr, FrameFormat::RAWBGR, PixelFormat::Bgr8),
];

/// Event sent by the thread.
pub(super) enum WorkerEvent {
    /// The camera streams. Contains a description for the log.
    Streaming(String),
    Frame(Frame),
    /// The thread failed. This is its last event.
    Failed(Problem),
}

/// An image as received from nokhwa.
pub(super) struct Frame {
    pub(super) arrival: Stamp,
    pub(super) format: PixelFormat,
    pub(super) bytes: Vec<u8>,
}

/// A streaming thread.
#[derive(Debug)]
pub(super) struct Worker {
    shared: Arc<Shared>,
}

/// State shared by the thread and the caller.
#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    arrived: Condvar,
}

#[derive(Default)]
struct State {
    queue: VecDeque<WorkerEvent>,
    /// Whether the caller has stopped the worker.
    stop: bool,
}

impl std::fmt::Debug for State {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("State")
            .field("n_waiting", &self.queue.len())
            .field("stop", &self.stop)
            .finish()
    }
}

impl Worker {
    /// Starts a thread that opens the camera and streams. The thread holds `alive` until it ends.
    pub(super) fn start(config: &Config, alive: Arc<()>) -> Result<Self, Problem> {
        let shared = Arc::new(Shared::default());
        let config = config.clone();
        let sender = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name(format!("nokhwa {}", config.name))
            .spawn(move || {
                // This value is dropped when the thread ends, which the camera detects through its
                // weak reference. Joining the thread would block if a call hangs.
                let _alive = alive;
                if let Err(problem) = stream(&config, &sender) {
                    sender.send(WorkerEvent::Failed(problem));
                }
            });
        match thread {
            Ok(_) => Ok(Self { shared }),
            Err(error) => Err(Problem::Refused {
                requested: "its thread".to_owned(),
                reason: error.to_string(),
            }),
        }
    }

    /// Returns the oldest queued event. Returns `None` if no event arrives before the time `until`.
    pub(super) fn next(&self, until: Instant) -> Option<WorkerEvent> {
        let mut state = self.shared.state.lock();
        loop {
            if let Some(event) = state.queue.pop_front() {
                return Some(event);
            }
            let remaining = until.saturating_duration_since(Instant::now());
            if remaining.is_zero() {
                return None;
            }
            self.shared.arrived.wait_for(&mut state, remaining);
        }
    }

    /// Ends the thread as soon as its current call returns.
    pub(super) fn stop(&self) {
        self.shared.state.lock().stop = true;
    }
}

impl Shared {
    /// Queues an event and returns whether the caller is still listening. If the queue is full, the
    /// oldest image is dropped. The gap is later detected from the stamps. Other events are kept,
    /// because the caller would otherwise never learn that the camera is open.
    fn send(&self, event: WorkerEvent) -> bool {
        let mut state = self.state.lock();
        if state.queue.len() >= MAX_WAITING
            && let Some(ix) = state
                .queue
                .iter()
                .position(|queued| matches!(queued, WorkerEvent::Frame(_)))
        {
            state.queue.remove(ix);
        }
        state.queue.push_back(event);
        self.arrived.notify_all();
        !state.stop
    }
}

/// Streams until the caller stops listening. Any error ends it.
fn stream(config: &Config, shared: &Shared) -> Result<(), Problem> {
    let index = find(&config.device)?;
    let (mut camera, format) = open(config, index)?;
    let unplugged = |error: nokhwa::NokhwaError| Problem::Unplugged {
        reason: error.to_string(),
    };
    camera.open_stream().map_err(unplugged)?;
    let mut is_receiving = shared.send(WorkerEvent::Streaming(format!(
        "{}, {}",
        camera.info().human_name(),
        requested(config, format)
    )));
    while is_receiving {
        let buffer = camera.frame().map_err(unplugged)?;
        // The arrival time is taken before the copy, so that the copy does not count as latency.
        let arrival = clock::now();
        let bytes = trim(buffer.buffer(), format, config.intrinsics.size_px);
        is_receiving = shared.send(WorkerEvent::Frame(Frame {
            arrival,
            format: pixels(format),
            bytes,
        }));
    }
    Ok(())
}

/// Finds the camera by name. The search is repeated for every connection, because the numbers of
/// cameras may change.
fn find(device: &str) -> Result<CameraIndex, Problem> {
    if let Some(index) = number(device) {
        return Ok(CameraIndex::Index(index));
    }
    let mut cameras = nokhwa::query(ApiBackend::Auto).unwrap_or_default();
    // Some cameras have several nodes. The first node delivers images.
    cameras.sort_by_key(|camera| camera.index().as_index().unwrap_or(u32::MAX));
    let is_exact_match = |camera: &&CameraInfo| camera.human_name() == device;
    let is_partial_match =
        |camera: &&CameraInfo| !device.is_empty() && camera.human_name().contains(device);
    match cameras
        .iter()
        .find(is_exact_match)
        .or_else(|| cameras.iter().find(is_partial_match))
    {
        Some(camera) => Ok(camera.index().clone()),
        None => {
            let names = cameras
                .iter()
                .map(|camera| format!("{:?} ({})", camera.human_name(), camera.index()));
            let connected = names.collect::<Vec<_>>().join(", ");
            Err(Problem::NoDevice {
                device: device.to_owned(),
                connected: if connected.is_empty() {
                    "none".into()
                } else {
                    connected
                },
            })
        }
    }
}

/// Parses a number, the path of a node, or a link to a node.
fn number(device: &str) -> Option<u32> {
    let node = std::fs::canonicalize(device).ok();
    let node = node
        .as_ref()
        .and_then(|node| node.to_str())
        .unwrap_or(device);
    node.strip_prefix("/dev/video").unwrap_or(node).parse().ok()
}

/// Opens the camera in the requested format. If none was requested, opens it in the first format
/// that it supports.
fn open(config: &Config, index: CameraIndex) -> Result<(Camera, V4l2Format), Problem> {
    let rate_hz = config.rate_hz;
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "compared with the original below"
    )]
    let whole_hz = rate_hz.round() as u32;
    // nokhwa supports only integer rates. With a rounded rate, the estimated gaps would be wrong.
    if f64::from(whole_hz) != rate_hz {
        return Err(Problem::Rate { rate_hz });
    }
    let [width, height] = config.intrinsics.size_px;
    let mut reason = None;
    for (name, format, _) in FORMATS
        .iter()
        .filter(|(name, ..)| config.format.is_none_or(|requested| requested == *name))
    {
        let exact = CameraFormat::new(Resolution::new(width, height), *format, whole_hz);
        let formats = [*format];
        let request = RequestedFormat::with_formats(RequestedFormatType::Exact(exact), &formats);
        match Camera::new(index.clone(), request) {
            Ok(camera) => return Ok((camera, *name)),
            // The first error is that of the most preferred format, and usually the most useful
            // one.
            Err(error) => reason = reason.or(Some(error.to_string())),
        }
    }
    match (config.format, reason) {
        (Some(format), None) => Err(Problem::Format {
            format: format.name(),
        }),
        (format, reason) => Err(Problem::Refused {
            requested: format.map_or_else(
                || format!("{width}x{height} at {rate_hz} Hz"),
                |format| requested(config, format),
            ),
            reason: reason.unwrap_or_default(),
        }),
    }
}

fn requested(config: &Config, format: V4l2Format) -> String {
    let [width, height] = config.intrinsics.size_px;
    format!(
        "{} {width}x{height} at {} Hz",
        format.name(),
        config.rate_hz
    )
}

fn pixels(format: V4l2Format) -> PixelFormat {
    let of_name = FORMATS.iter().find(|(name, ..)| *name == format);
    of_name
        .expect("the camera was opened with one of these formats")
        .2
}

/// Removes the bytes after the image. On Linux, nokhwa returns the whole buffer even if the image
/// in it is shorter.
fn trim(buffer: &[u8], format: V4l2Format, size_px: [u32; 2]) -> Vec<u8> {
    let n_bytes = match pixels(format).raw_size(size_px) {
        Some([row_bytes, n_rows]) => row_bytes.saturating_mul(n_rows),
        None => jpeg::first_image_end(buffer).unwrap_or(buffer.len()),
    };
    buffer[..buffer.len().min(n_bytes)].to_vec()
}
