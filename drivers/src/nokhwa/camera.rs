//! A nokhwa camera that reconnects after an outage and never blocks forever.

use super::worker::{Frame, Worker, WorkerEvent};
use super::{Config, Problem};
use crate::gap_estimator::GapEstimator;
use crate::reconnecting::{CameraCounts, Failure, ReconnectPolicy, Reconnecting, ReopenableCamera};
use crate::v4l2::Delivery;
use crate::{Camera, Error, Image};
use kinematics::Intrinsics;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

/// A call is abandoned if no image arrives for this time. The next constant is the same limit in
/// image periods. The longer of the two limits applies.
const MAX_SILENCE: Duration = Duration::from_millis(1500);
const MAX_SILENT_IMAGES: f64 = 5.0;
/// Maximum time to open a camera. It is longer than [`MAX_SILENCE`], because cameras adjust the
/// exposure first.
const MAX_OPENING: Duration = Duration::from_secs(8);
/// Pause between two attempts to reconnect.
const RETRY_PAUSE: Duration = Duration::from_millis(200);
/// Maximum number of threads that hang in a call and cannot be ended. Beyond this number, no new
/// thread is started. Each thread holds memory and perhaps the camera. After this many failures,
/// further attempts are unlikely to succeed.
const MAX_ABANDONED: usize = 8;
/// Maximum time to wait until a streaming thread stops.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(1);

/// A streaming camera.
///
/// If the camera is disconnected or a call hangs, it is reopened for at most
/// [`Config::reconnect_for`]. During that time, [`Camera::next_image`] returns
/// [`Error::Reconnecting`]. Afterwards, it returns the cause. Images are stamped on arrival. The
/// number of dropped images is estimated from the stamps.
#[derive(Debug)]
pub struct NokhwaCamera(Reconnecting<NokhwaDevice>);

#[derive(Debug)]
struct NokhwaDevice {
    config: Config,
    name: Arc<str>,
    /// Number of calls that hung and were abandoned.
    n_abandoned: u32,
    /// Threads of abandoned calls.
    abandoned: Vec<Weak<()>>,
}

/// A thread that opens the camera and streams.
#[derive(Debug)]
struct NokhwaStream {
    worker: Worker,
    /// Alive until the thread ends.
    alive: Weak<()>,
    /// Description of the camera, once it streams.
    description: Option<String>,
    /// Time of the last image, or of the start.
    last_image_at: Instant,
    gap_estimator: GapEstimator,
    /// Whether the thread hangs in a call.
    is_abandoned: bool,
}

impl NokhwaCamera {
    /// Opens a camera and starts its stream.
    pub fn open(config: Config) -> Result<Self, Error> {
        let policy = ReconnectPolicy {
            camera: config.name.clone(),
            rate_hz: config.rate_hz,
            reconnect_for: config.reconnect_for,
            first_pause: Duration::ZERO,
            retry_pause: RETRY_PAUSE,
        };
        let name = config.name.as_str().into();
        let mut device = NokhwaDevice {
            config,
            name,
            n_abandoned: 0,
            abandoned: Vec::new(),
        };
        let stream = device
            .open_and_wait()
            .map_err(|failure| failure.into_error(|problem| device.error(problem)))?;
        log::info!(
            "camera {:?}: {}; images are stamped on arrival, and dropped images are estimated from the stamps",
            device.config.name,
            stream.description.as_deref().unwrap_or_default()
        );
        Ok(Self(Reconnecting::new(device, stream, policy)))
    }

    /// Statistics since the camera was opened. The number of dropped images is estimated from
    /// stamps.
    pub fn counts(&self) -> CameraCounts {
        self.0.counts()
    }

    /// Number of calls that hung and were abandoned.
    pub fn n_abandoned(&self) -> u32 {
        self.0.device().n_abandoned
    }
}

impl NokhwaDevice {
    fn error(&self, problem: Problem) -> Error {
        Error::Nokhwa {
            camera: self.config.name.clone(),
            problem: Box::new(problem),
        }
    }

    /// Opens the camera and waits until it streams.
    fn open_and_wait(&mut self) -> Result<NokhwaStream, Failure<Problem>> {
        let mut stream = self.open()?;
        while stream.description.is_none() {
            // No images come before the camera streams.
            self.next_image(&mut stream, Instant::now() + MAX_OPENING)?;
        }
        Ok(stream)
    }

    fn image_of(&self, frame: Frame, n_skipped: u64) -> Image {
        let Frame {
            arrival,
            format,
            bytes,
        } = frame;
        Image {
            camera: Arc::clone(&self.name),
            stamp: arrival,
            size_px: self.config.intrinsics.size_px,
            format,
            data: bytes.into(),
            exposure_secs: self.config.exposure_micros.map(|micros| micros * 1e-6),
            n_skipped,
        }
    }
}

impl ReopenableCamera for NokhwaDevice {
    type Stream = NokhwaStream;
    type Problem = Problem;

    /// Starts a thread that opens the camera, and does not wait for it.
    fn open(&mut self) -> Result<NokhwaStream, Failure<Problem>> {
        // If a call has returned late, its thread has ended and no longer counts.
        self.abandoned.retain(|alive| alive.strong_count() > 0);
        if self.abandoned.len() >= MAX_ABANDONED {
            return Err(Problem::TooManyAbandoned {
                n_abandoned_threads: self.abandoned.len(),
            }
            .into());
        }
        let thread = Arc::new(());
        Ok(NokhwaStream {
            alive: Arc::downgrade(&thread),
            // Only the thread holds a strong reference.
            worker: Worker::start(&self.config, thread)?,
            description: None,
            last_image_at: Instant::now(),
            gap_estimator: GapEstimator::new(self.config.rate_hz),
            is_abandoned: false,
        })
    }

    fn describe(&self, stream: &NokhwaStream) -> Option<String> {
        stream.description.clone()
    }

    fn next_image(
        &mut self,
        stream: &mut NokhwaStream,
        deadline: Instant,
    ) -> Result<Option<Image>, Failure<Problem>> {
        let (what, timeout) = match stream.description {
            Some(_) => (
                "get its next image",
                MAX_SILENCE.max(Duration::from_secs_f64(
                    MAX_SILENT_IMAGES / self.config.rate_hz,
                )),
            ),
            None => ("open it", MAX_OPENING),
        };
        let gives_up_at = stream.last_image_at + timeout;
        match stream.worker.next(deadline.min(gives_up_at)) {
            Some(WorkerEvent::Frame(mut frame)) => {
                if self.config.delivery == Delivery::Newest {
                    while let Some(event) = stream.worker.next(Instant::now()) {
                        match event {
                            WorkerEvent::Frame(newer) => frame = newer,
                            WorkerEvent::Streaming(description) => {
                                stream.description = Some(description);
                            }
                            // Images from before a failure are outdated.
                            WorkerEvent::Failed(problem) => return Err(problem.into()),
                        }
                    }
                }
                stream.last_image_at = Instant::now();
                let n_skipped = stream.gap_estimator.n_lost_before(frame.arrival);
                Ok(Some(self.image_of(frame, n_skipped)))
            }
            Some(WorkerEvent::Streaming(description)) => {
                stream.description = Some(description);
                stream.last_image_at = Instant::now();
                Ok(None)
            }
            Some(WorkerEvent::Failed(problem)) => Err(problem.into()),
            None if Instant::now() >= gives_up_at => {
                // Dropping the stream must not wait for a thread that hangs.
                stream.is_abandoned = true;
                self.n_abandoned += 1;
                self.abandoned.push(Weak::clone(&stream.alive));
                Err(Problem::Hung {
                    what,
                    waited: timeout,
                }
                .into())
            }
            None => Ok(None),
        }
    }

    fn lost(&self, waited: Duration, n_tries: u32, last: Problem) -> Error {
        self.error(Problem::Lost {
            waited,
            n_tries,
            last: Box::new(last),
        })
    }
}

impl Drop for NokhwaStream {
    /// Stops the thread. Waits for its end, because the camera can be opened again only after the
    /// thread has ended. Does not wait for a thread that hangs.
    fn drop(&mut self) {
        self.worker.stop();
        let until = Instant::now() + SHUTDOWN_TIMEOUT;
        while !self.is_abandoned && self.alive.strong_count() > 0 && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Camera for NokhwaCamera {
    fn name(&self) -> &str {
        &self.0.device().config.name
    }

    fn intrinsics(&self) -> &Intrinsics {
        &self.0.device().config.intrinsics
    }

    fn next_image(&mut self, timeout: Duration) -> Result<Image, Error> {
        self.0.next_image(timeout)
    }
}
