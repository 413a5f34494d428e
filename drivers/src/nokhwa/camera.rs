//! A nokhwa camera that reconnects after an outage and never blocks forever.

use super::gap_estimator::GapEstimator;
use super::worker::{Frame, Worker, WorkerEvent};
use super::{Config, Problem};
use crate::outage::Outage;
use crate::v4l2::Delivery;
use crate::{Camera, Error, Image};
use kinematics::Intrinsics;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

/// If no image comes for this long, or for the time of this many images, the call is abandoned.
const MAX_SILENCE: Duration = Duration::from_millis(1500);
const MAX_SILENT_IMAGES: f64 = 5.0;
/// Opening takes longer: cameras adjust the exposure first.
const MAX_OPENING: Duration = Duration::from_secs(8);
/// Pause between two attempts to reconnect.
const RETRY_PAUSE: Duration = Duration::from_millis(200);
/// Maximum number of threads that hang in a call and cannot be ended. After that, no new thread is started.
const MAX_ABANDONED: usize = 8;
/// How long to wait for a streaming thread to stop.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(1);

/// A streaming camera.
///
/// If the camera is disconnected or a call hangs, it is reopened for at most [`Config::reconnect_for`]. During that
/// time, [`Camera::next_image`] returns [`Error::Reconnecting`], afterwards the cause. Images are stamped on arrival.
/// The number of dropped images is estimated from the stamps.
#[derive(Debug)]
pub struct NokhwaCamera {
    config: Config,
    name: Arc<str>,
    connection: Connection,
    gap_estimator: GapEstimator,
    counts: Counts,
    /// Threads that were abandoned.
    abandoned: Vec<Weak<()>>,
    outage: Option<Outage>,
}

/// Statistics of a camera since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Number of delivered images.
    pub n_images: u64,
    /// Number of dropped images, estimated from stamps. All were reported in [`Image::n_skipped`].
    pub n_skipped: u64,
    /// Number of reconnections.
    pub n_reconnections: u32,
    /// Number of calls that hung and were abandoned.
    pub n_abandoned: u32,
}

#[derive(Debug)]
enum Connection {
    Connected {
        worker: Worker,
        alive: Weak<()>,
        /// Time of the last image, or of the start.
        last_image_at: Instant,
        is_streaming: bool,
    },
    Disconnected,
}

impl NokhwaCamera {
    /// Opens a camera and starts its stream.
    pub fn open(config: Config) -> Result<Self, Error> {
        let now = Instant::now();
        let mut camera = Self {
            name: config.name.as_str().into(),
            gap_estimator: GapEstimator::new(config.rate_hz),
            config,
            connection: Connection::Disconnected,
            counts: Counts::default(),
            abandoned: Vec::new(),
            outage: None,
        };
        camera.start().map_err(|problem| camera.error(problem))?;
        let Connection::Connected { worker, is_streaming, last_image_at, .. } = &mut camera.connection else {
            unreachable!("just started")
        };
        match worker.next(now + MAX_OPENING) {
            Some(WorkerEvent::Streaming(what)) => {
                (*is_streaming, *last_image_at) = (true, Instant::now());
                log::info!(
                    "camera {:?}: {what}; images are stamped on arrival, and dropped images are estimated from the stamps",
                    camera.config.name
                );
                Ok(camera)
            }
            Some(WorkerEvent::Failed(problem)) => Err(camera.error(problem)),
            Some(WorkerEvent::Frame(_)) => unreachable!("the first event is Streaming or Failed"),
            None => Err(camera.error(Problem::Hung { what: "open it", waited: MAX_OPENING })),
        }
    }

    /// Statistics since the camera was opened.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    fn error(&self, problem: Problem) -> Error {
        Error::Nokhwa { camera: self.config.name.clone(), problem: Box::new(problem) }
    }

    fn start(&mut self) -> Result<(), Problem> {
        self.abandoned.retain(|alive| alive.strong_count() > 0);
        if self.abandoned.len() >= MAX_ABANDONED {
            return Err(Problem::TooManyAbandoned { n_abandoned_threads: self.abandoned.len() });
        }
        let alive = Arc::new(());
        let weak = Arc::downgrade(&alive);
        let worker = Worker::start(&self.config, alive)?;
        self.connection =
            Connection::Connected { worker, alive: weak, last_image_at: Instant::now(), is_streaming: false };
        Ok(())
    }

    /// Waits once for an image of a camera that is connected or being opened.
    fn poll_image(&mut self, deadline: Instant) -> Result<Option<Image>, Error> {
        let Connection::Connected { worker, last_image_at, is_streaming, .. } = &mut self.connection else {
            return Ok(None);
        };
        let timeout = match is_streaming {
            true => MAX_SILENCE.max(Duration::from_secs_f64(MAX_SILENT_IMAGES / self.config.rate_hz)),
            false => MAX_OPENING,
        };
        let gives_up_at = *last_image_at + timeout;
        match worker.next(deadline.min(gives_up_at)) {
            Some(WorkerEvent::Frame(mut frame)) => {
                if self.config.delivery == Delivery::Newest {
                    while let Some(WorkerEvent::Frame(newer)) = worker.next(Instant::now()) {
                        frame = newer;
                    }
                }
                *last_image_at = Instant::now();
                Ok(Some(self.image_of(frame)))
            }
            Some(WorkerEvent::Streaming(what)) => {
                (*is_streaming, *last_image_at) = (true, Instant::now());
                let waited = self.outage.map_or(Duration::ZERO, |outage| outage.since.elapsed());
                log::info!("camera {:?}: reconnected after {waited:.1?}: {what}", self.config.name);
                self.counts.n_reconnections += 1;
                Ok(None)
            }
            Some(WorkerEvent::Failed(problem)) => self.handle_disconnect(problem).map(|()| None),
            None if Instant::now() >= gives_up_at => {
                let what = if *is_streaming { "get its next image" } else { "open it" };
                self.handle_disconnect(Problem::Hung { what, waited: timeout }).map(|()| None)
            }
            None => Ok(None),
        }
    }

    fn image_of(&mut self, frame: Frame) -> Image {
        let Frame { arrival, format, bytes } = frame;
        let n_skipped = self.gap_estimator.n_lost_before(arrival);
        self.outage = None;
        self.counts.n_images += 1;
        self.counts.n_skipped += n_skipped;
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

    /// Abandons the thread, which may still be running. Fails if the camera has been disconnected for too long.
    fn handle_disconnect(&mut self, problem: Problem) -> Result<(), Error> {
        if let Connection::Connected { alive, .. } = std::mem::replace(&mut self.connection, Connection::Disconnected)
            && matches!(problem, Problem::Hung { .. })
        {
            self.counts.n_abandoned += 1;
            self.abandoned.push(alive);
        }
        let is_new = self.outage.is_none();
        let Outage { since, n_tries, .. } = Outage::of(&mut self.outage);
        if is_new {
            log::warn!(
                "camera {:?}: {problem}; trying to reconnect for {:?}",
                self.config.name,
                self.config.reconnect_for
            );
            return Ok(());
        }
        let waited = since.elapsed();
        if waited < self.config.reconnect_for {
            log::debug!("camera {:?}: {problem}", self.config.name);
            return Ok(());
        }
        Err(self.error(Problem::Lost { waited, n_tries, last: Box::new(problem) }))
    }

    /// Tries once to reopen a disconnected camera, after the pause since the last attempt.
    fn reconnect(&mut self, deadline: Instant) -> Result<(), Error> {
        let (Connection::Disconnected, Some(outage)) = (&self.connection, &mut self.outage) else { return Ok(()) };
        let pause = if outage.n_tries == 0 { Duration::ZERO } else { RETRY_PAUSE };
        if !outage.wait_for_retry(pause, deadline) {
            return Ok(());
        }
        self.start().or_else(|problem| self.handle_disconnect(problem))
    }
}

impl Camera for NokhwaCamera {
    fn name(&self) -> &str {
        &self.config.name
    }

    fn intrinsics(&self) -> &Intrinsics {
        &self.config.intrinsics
    }

    fn next_image(&mut self, timeout: Duration) -> Result<Image, Error> {
        let deadline = Instant::now() + timeout;
        loop {
            match &self.connection {
                Connection::Disconnected => self.reconnect(deadline)?,
                Connection::Connected { .. } => {
                    if let Some(image) = self.poll_image(deadline)? {
                        return Ok(image);
                    }
                }
            }
            if Instant::now() >= deadline {
                let camera = self.config.name.clone();
                return Err(match self.outage {
                    Some(outage) => Error::Reconnecting { camera, waited: outage.since.elapsed() },
                    None => Error::NoImage { camera, waited: timeout },
                });
            }
        }
    }
}

impl Drop for NokhwaCamera {
    fn drop(&mut self) {
        let Connection::Connected { worker, alive, .. } =
            std::mem::replace(&mut self.connection, Connection::Disconnected)
        else {
            return;
        };
        drop(worker);
        // The camera can only be reopened after the thread has ended. A thread that hangs is abandoned.
        let until = Instant::now() + SHUTDOWN_TIMEOUT;
        while alive.strong_count() > 0 && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}
