//! Such a camera as the rest of the program sees it: images while it is plugged in, waiting while it is not, and never for ever.

use super::gaps::Gaps;
use super::worker::{Frame, Told, Worker};
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
const MAX_HANGING: usize = 8;
/// How long a thread that streams may take to notice that it is to end.
const MAX_ENDING: Duration = Duration::from_secs(1);

/// A camera that streams.
///
/// One that is unplugged, or whose call hangs, is opened again for at most [`Config::reconnect_for`]: until then
/// [`Camera::next_image`] says [`Error::Reconnecting`], after that what it was. Images are stamped as they arrive, and how many
/// were lost is estimated from that.
#[derive(Debug)]
pub struct NokhwaCamera {
    config: Config,
    name: Arc<str>,
    link: Link,
    gaps: Gaps,
    counts: Counts,
    /// Threads that were left behind.
    left_behind: Vec<Weak<()>>,
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
    pub n_left_behind: u32,
}

#[derive(Debug)]
enum Link {
    Up {
        worker: Worker,
        alive: Weak<()>,
        /// Since when nothing came.
        quiet_since: Instant,
        streams: bool,
    },
    Down,
}

impl NokhwaCamera {
    /// Opens a camera and starts its stream.
    pub fn open(config: Config) -> Result<Self, Error> {
        let now = Instant::now();
        let mut camera = Self {
            name: config.name.as_str().into(),
            gaps: Gaps::new(config.rate_hz),
            config,
            link: Link::Down,
            counts: Counts::default(),
            left_behind: Vec::new(),
            outage: None,
        };
        camera.start().map_err(|problem| camera.error(problem))?;
        let Link::Up { worker, streams, quiet_since, .. } = &mut camera.link else { unreachable!("just started") };
        match worker.next(now + MAX_OPENING) {
            Some(Told::Streams(what)) => {
                (*streams, *quiet_since) = (true, Instant::now());
                log::info!(
                    "camera {:?}: {what}; stamped as images arrive, lost ones are estimated from that",
                    camera.config.name
                );
                Ok(camera)
            }
            Some(Told::Ended(problem)) => Err(camera.error(problem)),
            Some(Told::Frame(_)) => unreachable!("a thread says first that it streams"),
            None => Err(camera.error(Problem::Hangs { what: "open it", waited: MAX_OPENING })),
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
        self.left_behind.retain(|alive| alive.strong_count() > 0);
        if self.left_behind.len() >= MAX_HANGING {
            return Err(Problem::TooManyHang { n_hanging: self.left_behind.len() });
        }
        let alive = Arc::new(());
        let weak = Arc::downgrade(&alive);
        let worker = Worker::start(&self.config, alive)?;
        self.link = Link::Up { worker, alive: weak, quiet_since: Instant::now(), streams: false };
        Ok(())
    }

    /// One step of waiting for an image of a camera that is there or being opened.
    fn wait_for_image(&mut self, deadline: Instant) -> Result<Option<Image>, Error> {
        let Link::Up { worker, quiet_since, streams, .. } = &mut self.link else { return Ok(None) };
        let patience = match streams {
            true => MAX_SILENCE.max(Duration::from_secs_f64(MAX_SILENT_IMAGES / self.config.rate_hz)),
            false => MAX_OPENING,
        };
        let gives_up = *quiet_since + patience;
        match worker.next(deadline.min(gives_up)) {
            Some(Told::Frame(mut frame)) => {
                if self.config.delivery == Delivery::Newest {
                    while let Some(Told::Frame(newer)) = worker.next(Instant::now()) {
                        frame = newer;
                    }
                }
                *quiet_since = Instant::now();
                Ok(Some(self.image_of(frame)))
            }
            Some(Told::Streams(what)) => {
                (*streams, *quiet_since) = (true, Instant::now());
                let waited = self.outage.map_or(Duration::ZERO, |outage| outage.since.elapsed());
                log::info!("camera {:?}: there again after {waited:.1?}: {what}", self.config.name);
                self.counts.n_reconnections += 1;
                Ok(None)
            }
            Some(Told::Ended(problem)) => self.lose(problem).map(|()| None),
            None if Instant::now() >= gives_up => {
                let what = if *streams { "have its next image" } else { "open it" };
                self.lose(Problem::Hangs { what, waited: patience }).map(|()| None)
            }
            None => Ok(None),
        }
    }

    fn image_of(&mut self, frame: Frame) -> Image {
        let Frame { arrival, format, bytes } = frame;
        let n_skipped = self.gaps.n_lost_before(arrival);
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
    fn lose(&mut self, why: Problem) -> Result<(), Error> {
        if let Link::Up { alive, .. } = std::mem::replace(&mut self.link, Link::Down)
            && matches!(why, Problem::Hangs { .. })
        {
            self.counts.n_left_behind += 1;
            self.left_behind.push(alive);
        }
        let is_new = self.outage.is_none();
        let Outage { since, n_tries, .. } = Outage::of(&mut self.outage);
        if is_new {
            log::warn!("camera {:?}: {why}; looking for it for {:?}", self.config.name, self.config.reconnect_for);
            return Ok(());
        }
        let waited = since.elapsed();
        if waited < self.config.reconnect_for {
            log::debug!("camera {:?}: {why}", self.config.name);
            return Ok(());
        }
        Err(self.error(Problem::Lost { waited, n_tries, last: Box::new(why) }))
    }

    /// One try to open a lost camera again, not before the pause since the last one is over.
    fn reconnect(&mut self, deadline: Instant) -> Result<(), Error> {
        let (Link::Down, Some(outage)) = (&self.link, &mut self.outage) else { return Ok(()) };
        let pause = if outage.n_tries == 0 { Duration::ZERO } else { RETRY_PAUSE };
        if !outage.try_again(pause, deadline) {
            return Ok(());
        }
        self.start().or_else(|problem| self.lose(problem))
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
            match &self.link {
                Link::Down => self.reconnect(deadline)?,
                Link::Up { .. } => {
                    if let Some(image) = self.wait_for_image(deadline)? {
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
        let Link::Up { worker, alive, .. } = std::mem::replace(&mut self.link, Link::Down) else {
            return;
        };
        drop(worker);
        // Until it has, nobody else can open the camera; a thread that hangs is left behind.
        let until = Instant::now() + MAX_ENDING;
        while alive.strong_count() > 0 && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}
