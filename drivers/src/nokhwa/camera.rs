//! Such a camera as the rest of the program sees it: images while it is plugged in, waiting while it is not, and never for ever.

use super::gap_estimator::GapEstimator;
use super::worker::{Frame, Worker, WorkerEvent};
use super::{Config, Problem};
use crate::outage::Outage;
use crate::v4l2::Delivery;
use crate::{Camera, Error, Image};
use kinematics::Intrinsics;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

/// A call for an image that has not come back for so long, or for so many images, is left behind.
const MAX_SILENCE: Duration = Duration::from_millis(1500);
const MAX_SILENT_IMAGES: f64 = 5.0;
/// Opening takes longer: cameras measure the light first.
const MAX_OPENING: Duration = Duration::from_secs(8);
/// Between two tries to find a lost camera again.
const RETRY_PAUSE: Duration = Duration::from_millis(200);
/// Threads that hang in a call and cannot be ended: past these no further one is begun.
const MAX_ABANDONED: usize = 8;
/// How long a thread that streams may take to notice that it is to end.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(1);

/// A camera that streams.
///
/// One that is unplugged, or whose call hangs, is opened again for at most [`Config::reconnect_for`]: until then
/// [`Camera::next_image`] says [`Error::Reconnecting`], after that what it was. Images are stamped as they arrive, and how many
/// were lost is estimated from that.
#[derive(Debug)]
pub struct NokhwaCamera {
    config: Config,
    name: Arc<str>,
    connection: Connection,
    gap_estimator: GapEstimator,
    counts: Counts,
    /// Threads that were left behind.
    abandoned: Vec<Weak<()>>,
    outage: Option<Outage>,
}

/// What became of the camera since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Images delivered.
    pub n_images: u64,
    /// Images lost, estimated from stamps; all were told in [`Image::n_skipped`].
    pub n_skipped: u64,
    /// Times that it was found again.
    pub n_reconnections: u32,
    /// Calls that hung and were left behind.
    pub n_abandoned: u32,
}

#[derive(Debug)]
enum Connection {
    Connected {
        worker: Worker,
        alive: Weak<()>,
        /// Since when nothing came.
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
                    "camera {:?}: {what}; stamped as images arrive, lost ones are estimated from that",
                    camera.config.name
                );
                Ok(camera)
            }
            Some(WorkerEvent::Failed(problem)) => Err(camera.error(problem)),
            Some(WorkerEvent::Frame(_)) => unreachable!("a thread says first that it streams"),
            None => Err(camera.error(Problem::Hung { what: "open it", waited: MAX_OPENING })),
        }
    }

    /// What became of it so far.
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

    /// One step of waiting for an image of a camera that is there or being opened.
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
                log::info!("camera {:?}: there again after {waited:.1?}: {what}", self.config.name);
                self.counts.n_reconnections += 1;
                Ok(None)
            }
            Some(WorkerEvent::Failed(problem)) => self.handle_disconnect(problem).map(|()| None),
            None if Instant::now() >= gives_up_at => {
                let what = if *is_streaming { "have its next image" } else { "open it" };
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

    /// Leaves the thread to itself; whether that is for good it does not tell. Fails when the camera has been lost for too long.
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
            log::warn!("camera {:?}: {problem}; looking for it for {:?}", self.config.name, self.config.reconnect_for);
            return Ok(());
        }
        let waited = since.elapsed();
        if waited < self.config.reconnect_for {
            log::debug!("camera {:?}: {problem}", self.config.name);
            return Ok(());
        }
        Err(self.error(Problem::Lost { waited, n_tries, last: Box::new(problem) }))
    }

    /// One try to open a lost camera again, not before the pause since the last one is over.
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
        // Until it has, nobody else can open the camera; a thread that hangs is left behind.
        let until = Instant::now() + SHUTDOWN_TIMEOUT;
        while alive.strong_count() > 0 && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}
