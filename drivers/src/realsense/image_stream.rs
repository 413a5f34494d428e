//! Streams from a RealSense camera or a file and converts the frames of the library to stamped
//! images.

use super::filters::Filters;
use super::find::{self, FoundCamera};
use super::options;
use super::sdk::{Context, Device, Frame, Queue, bytes};
use super::stamps::{FrameTime, Stamps};
use super::streams::{self, ActiveStreams, Calibration};
use super::{Config, Problem};
use crate::{Error, Image, PixelFormat, clock};
use realsense_rust::frame::{FrameEx, ImageFrame};
use realsense_rust::kind::{Rs2FrameMetadata, Rs2StreamKind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Queue capacity for images of all streams. The queue holds a quarter of a second of two streams
/// at 30 Hz.
const N_WAITING: u8 = 16;
/// Polling interval for the end of a file.
const POLL: Duration = Duration::from_millis(100);
/// Polling interval while the streams stop.
const DRAIN_POLL: Duration = Duration::from_millis(10);
/// A file without any image after this time is treated as empty.
const MAX_STARTUP: Duration = Duration::from_secs(2);
/// Exposure times of depth are in microseconds.
const DEPTH_SECS_PER_COUNT: f64 = 1e-6;

/// The images of a streaming device.
#[derive(Debug)]
pub(super) struct ImageStream {
    camera: Arc<str>,
    stamps: Stamps,
    filters: Filters,
    counter: [FrameCounter; 2],
    /// An image that was read but is not due yet. It is used only for files.
    pending: Option<Image>,
    image_secs_per_count: f64,
    is_file: bool,
    started_at: Instant,
    last_image: Instant,
    has_image: bool,
    /// Number of images that were due before the file was opened. It is used only for files.
    n_before_open: u64,
    description: String,
    started: ActiveStreams,
    device: Device,
    /// This field is declared, and thus dropped, after the device whose streams write to the queue.
    queue: Queue,
    /// This field is declared, and thus dropped, after the devices that the context listed.
    _context: Context,
}

/// Frame numbers of one kind of image. One kind is color or infrared, and the other kind is depth.
#[derive(Clone, Copy, Debug, Default)]
struct FrameCounter {
    last_number: Option<u64>,
    n_unreported: u64,
}

/// Result of one wait.
pub(super) enum Next {
    Image(Image),
    NoImage,
    /// The next image of the file is due after this time.
    NotDue(Duration),
    /// The file has ended.
    End,
}

impl ImageStream {
    /// Opens the device of a configuration, applies the settings and starts the streams.
    pub(super) fn start(config: &Config) -> Result<Self, Problem> {
        let context = Context::new()?;
        let mut device = match &config.file {
            Some(path) => context.file(path)?,
            None => find::camera(&context, &config.serial)?,
        };
        let found = FoundCamera::of(&device);
        let queue = Queue::new(N_WAITING)?;
        let started = streams::start(config, &device, &queue)?;
        let mut description = format!("{}, {}", found.describe(), started.description);
        if config.file.is_none() {
            warn_of_device(&config.name, &found);
            let applied = options::apply(&config.settings, &mut device, started.image_sensor);
            // Started streams keep a camera busy, even after a failed start.
            let applied = applied.inspect_err(|_| started.stop(&device))?;
            description = format!("{description}; set and read back: {}", applied.join(", "));
        }
        let micros_per_count =
            options::exposure_micros_per_count(&device.sensors[started.image_sensor]);
        Ok(Self {
            camera: config.name.as_str().into(),
            stamps: Stamps::new(config),
            filters: Filters::new(&config.filters)?,
            counter: [FrameCounter::default(); 2],
            pending: None,
            image_secs_per_count: micros_per_count * 1e-6,
            is_file: config.file.is_some(),
            started_at: Instant::now(),
            last_image: Instant::now(),
            has_image: false,
            n_before_open: 0,
            description,
            started,
            device,
            queue,
            _context: context,
        })
    }

    /// Description of device, modes and settings for the log.
    pub(super) fn describe(&self) -> &str {
        &self.description
    }

    pub(super) fn calibration(&self) -> &Calibration {
        &self.started.calibration
    }

    /// Time since the last image.
    pub(super) fn time_since_image(&self) -> Duration {
        self.last_image.elapsed()
    }

    /// Returns the next image of any stream. An error means that the device was disconnected.
    pub(super) fn next(&mut self, deadline: Instant) -> Result<Next, Problem> {
        loop {
            if let Some(image) = self
                .pending
                .take_if(|image| self.stamps.is_due(image.stamp))
            {
                return Ok(Next::Image(self.deliver(image)));
            }
            let remaining = deadline.saturating_duration_since(Instant::now());
            if let Some(image) = &self.pending {
                let due_in = Duration::from_nanos(
                    image
                        .stamp
                        .0
                        .saturating_sub(clock::now().0)
                        .max(0)
                        .unsigned_abs(),
                );
                // The error contains the time after which the next call is useful.
                if remaining.is_zero() {
                    return Ok(Next::NotDue(due_in));
                }
                std::thread::sleep(remaining.min(due_in));
                continue;
            }
            // The end of the file is checked before the queue, so that all images read until the
            // end are in the queue.
            let has_stopped = self.is_file && self.device.has_stopped()?;
            match self.queue.wait(remaining.min(POLL))? {
                Some(frame) => {
                    let image = self.image(frame)?;
                    if image.is_none() {
                        continue;
                    }
                    self.pending = image;
                }
                None if has_stopped
                    && (self.has_image || self.started_at.elapsed() > MAX_STARTUP) =>
                {
                    self.warn_of_images_before_open("all");
                    return Ok(Next::End);
                }
                None if remaining <= POLL => return Ok(Next::NoImage),
                None => {}
            }
        }
    }

    /// Logs once how many images of a file were due before the file was opened.
    fn warn_of_images_before_open(&mut self, which: &str) {
        let n_before_open = std::mem::take(&mut self.n_before_open);
        if n_before_open > 0 {
            log::warn!(
                "camera {:?}: skipped {which} images of the .bag file ({n_before_open}): they were due before fieldrig opened the file",
                self.camera
            );
        }
    }

    fn deliver(&mut self, image: Image) -> Image {
        self.warn_of_images_before_open("the first");
        self.last_image = Instant::now();
        self.has_image = true;
        image
    }

    /// Copies a frame to an image. Returns `None` for duplicates.
    fn image(&mut self, frame: Frame) -> Result<Option<Image>, Problem> {
        // The arrival time is taken first, so that filters and copies do not delay the stamp.
        let arrival = clock::now();
        let is_depth = frame.stream_profile().kind() == Rs2StreamKind::Depth;
        let counter = &mut self.counter[usize::from(is_depth)];
        let number = frame.frame_number();
        match counter.last_number.replace(number) {
            // The library sometimes returns the last image of a stream again.
            Some(last) if last == number => return Ok(None),
            // If a number is lower than the previous number, the stream was restarted. A restart
            // loses no images.
            Some(last) if number > last => counter.n_unreported += number - last - 1,
            _ => {}
        }
        let (format, secs_per_count) = match (is_depth, &self.started.calibration.depth) {
            (true, Some(depth)) => (
                PixelFormat::DepthU16 {
                    meters_per_count: depth.meters_per_count,
                },
                DEPTH_SECS_PER_COUNT,
            ),
            (true, None) => return Ok(None),
            (false, _) => (self.started.format, self.image_secs_per_count),
        };
        let frame_time = FrameTime::of(&frame);
        #[expect(
            clippy::cast_precision_loss,
            reason = "an exposure lasts less than a day"
        )]
        let exposure_secs = frame
            .metadata(Rs2FrameMetadata::ActualExposure)
            .map(|counts| counts as f64 * secs_per_count);
        let image = Image {
            camera: Arc::clone(&self.camera),
            stamp: self.stamps.stamp(&frame_time, arrival),
            size_px: [0; 2],
            format,
            data: Arc::new([]),
            exposure_secs,
            n_skipped: std::mem::take(&mut counter.n_unreported),
        };
        // This check comes before the filters, because the filters take most of the time and the
        // playback has to catch up.
        if self.stamps.is_before_open(image.stamp) {
            self.n_before_open += 1;
            return Ok(None);
        }
        let image = if is_depth && !self.filters.is_empty() {
            with_pixels(image, &self.filters.apply(frame)?)
        } else {
            with_pixels(image, &frame)
        };
        image.map(Some).map_err(|error| Problem::Library {
            what: "deliver a complete image",
            reason: error.to_string(),
        })
    }
}

/// Copies the pixels of a frame into an image.
fn with_pixels<Kind>(image: Image, frame: &ImageFrame<Kind>) -> Result<Image, Error> {
    let side = |pixels: usize| u32::try_from(pixels).unwrap_or(u32::MAX);
    let size_px = [side(frame.width()), side(frame.height())];
    Image {
        size_px,
        data: bytes(frame).into(),
        ..image
    }
    .pack_rows(frame.stride())
}

fn warn_of_device(camera: &str, found: &FoundCamera) {
    if found.is_on_usb2() {
        log::warn!(
            "camera {camera:?}: it runs at USB 2, which carries few of its modes: use a USB 3 port and the cable that came with it"
        );
    }
    if found.has_old_firmware() {
        let requested = found.recommended_firmware.as_deref().unwrap_or_default();
        log::warn!(
            "camera {camera:?}: its firmware {} is older than the version that librealsense2 recommends ({requested})",
            found.firmware
        );
    }
}

impl Drop for ImageStream {
    /// Stops the streams while draining the queue. Stopping waits for the thread that reads the
    /// file, and this thread may wait for space in the queue. Without draining, this would be a
    /// deadlock.
    fn drop(&mut self) {
        let queue = &self.queue;
        let is_stopped = AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                while !is_stopped.load(Ordering::Relaxed) {
                    // These images are no longer needed.
                    let _ = queue.wait(DRAIN_POLL);
                }
            });
            self.started.stop(&self.device);
            is_stopped.store(true, Ordering::Relaxed);
        });
    }
}
