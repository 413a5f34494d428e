//! A RealSense camera as the rest of the program sees it: images while it is plugged in, waiting while it is not.

use super::find;
use super::running::{Next, Running};
use super::sdk::Context;
use super::{Calibration, Config, Pace, Problem};
use crate::outage::{Outage, n_between};
use crate::{Camera, Error, Image};
use kinematics::{Intrinsics, Stamp};
use std::time::{Duration, Instant};

/// Between two tries to find a lost camera again; after a reset it is away for some seconds.
const RETRY_PAUSE: Duration = Duration::from_millis(500);
/// A stream that is silent for this long, or for so many images, is begun anew: cameras hang.
const MAX_SILENCE: Duration = Duration::from_secs(2);
const MAX_SILENT_IMAGES: f64 = 10.0;
/// A camera that is there and does not stream after so many tries is reset, and once more after as many.
const TRIES_BEFORE_RESET: u32 = 3;

/// A RealSense camera that streams colour or infrared and, where that is asked for, depth; or a file that plays one.
///
/// A camera that is unplugged, or hangs, is opened again with the same settings, for at most [`Config::reconnect_for`], and reset
/// where that does not help: until then [`Camera::next_image`] says [`Error::Reconnecting`], after that what it was. Dropping it
/// ends the streams.
#[derive(Debug)]
pub struct RealsenseCamera {
    config: Config,
    link: Link,
    calibration: Calibration,
    counts: Counts,
    /// Stamps of the last images, depth last, across reconnections.
    last: [Option<Stamp>; 2],
    /// Set from a loss to the next image.
    outage: Option<Outage>,
    /// Resets since it was lost.
    n_resets: u32,
}

/// What became of the camera since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Images delivered, depth among them.
    pub n_images: u64,
    /// Images lost, all of which were told in [`Image::n_skipped`].
    pub n_skipped: u64,
    /// Times that it was found again.
    pub n_reconnections: u32,
    /// Times that it was reset.
    pub n_resets: u32,
}

#[derive(Debug)]
enum Link {
    Up(Box<Running>),
    Down,
}

impl RealsenseCamera {
    /// Opens a camera or a file, sets it up as the rig file says, and starts its streams.
    pub fn open(config: Config) -> Result<Self, Error> {
        let running = Running::start(&config)
            .map_err(|problem| Error::Realsense { camera: config.name.clone(), problem: Box::new(problem) })?;
        log::info!("camera {:?}: {}", config.name, running.describe());
        Ok(Self {
            calibration: running.calibration().clone(),
            config,
            link: Link::Up(Box::new(running)),
            counts: Counts::default(),
            last: [None; 2],
            outage: None,
            n_resets: 0,
        })
    }

    /// What the camera knows about its lenses.
    pub fn calibration(&self) -> &Calibration {
        &self.calibration
    }

    /// What became of it so far.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// One step of waiting for an image of a camera that is there.
    fn wait_for_image(&mut self, deadline: Instant) -> Result<Option<Image>, Error> {
        let Link::Up(running) = &mut self.link else { return Ok(None) };
        match running.next(deadline) {
            Ok(Next::Image(image)) => return Ok(Some(self.count(image))),
            Ok(Next::End) => return Err(Error::Ended { camera: self.config.name.clone() }),
            Ok(Next::Later(left)) => return Err(Error::NotDue { camera: self.config.name.clone(), left }),
            Ok(Next::Nothing) => {}
            Err(problem) => return self.lose(problem).map(|()| None),
        }
        let waited = running.silent_for();
        let is_camera = self.config.file.is_none();
        if is_camera && waited > MAX_SILENCE.max(Duration::from_secs_f64(MAX_SILENT_IMAGES / self.config.rate_hz)) {
            self.lose(Problem::Silent { waited })?;
        }
        Ok(None)
    }

    fn count(&mut self, mut image: Image) -> Image {
        let last = self.last[usize::from(image.is_depth())].replace(image.stamp);
        let is_first_again = matches!(&self.link, Link::Up(running) if running.n_images() == 1);
        if let (true, Some(last)) = (is_first_again, last) {
            image.n_skipped = image.n_skipped.max(n_between(last, image.stamp, self.config.rate_hz));
        }
        (self.outage, self.n_resets) = (None, 0);
        self.counts.n_images += 1;
        self.counts.n_skipped += image.n_skipped;
        image
    }

    /// Lets go of the device before it is looked for. A file has no second try.
    fn lose(&mut self, why: Problem) -> Result<(), Error> {
        if self.config.file.is_some() {
            return Err(Error::Realsense { camera: self.config.name.clone(), problem: Box::new(why) });
        }
        let outage = Outage::of(&mut self.outage);
        self.link = Link::Down;
        if outage.n_tries > 0 {
            return self.give_up_if_late(outage, why);
        }
        log::warn!("camera {:?}: {why}; looking for it for {:?}", self.config.name, self.config.reconnect_for);
        Ok(())
    }

    /// The error of a camera that was lost for longer than the rig file allows.
    fn give_up_if_late(&self, Outage { since, n_tries, .. }: Outage, why: Problem) -> Result<(), Error> {
        let (camera, waited) = (self.config.name.clone(), since.elapsed());
        if waited < self.config.reconnect_for {
            log::debug!("camera {camera:?}: {why}");
            return Ok(());
        }
        let problem = Problem::Lost { waited, n_tries, n_resets: self.n_resets, last: Box::new(why) };
        Err(Error::Realsense { camera, problem: Box::new(problem) })
    }

    /// One try to open a lost camera again, not before the pause since the last one is over.
    fn reconnect(&mut self, deadline: Instant) -> Result<(), Error> {
        let (Link::Down, Some(outage)) = (&self.link, &mut self.outage) else { return Ok(()) };
        if !outage.try_again(RETRY_PAUSE, deadline) {
            return Err(Error::Reconnecting { camera: self.config.name.clone(), waited: outage.since.elapsed() });
        }
        if outage.n_tries.is_multiple_of(TRIES_BEFORE_RESET) && reset(&self.config) {
            self.n_resets += 1;
            self.counts.n_resets += 1;
            return Ok(());
        }
        let outage = *outage;
        match Running::start(&self.config) {
            Ok(running) => {
                let (camera, waited) = (&self.config.name, outage.since.elapsed());
                log::info!("camera {camera:?}: there again after {waited:?}: {}", running.describe());
                self.counts.n_reconnections += 1;
                self.link = Link::Up(Box::new(running));
                Ok(())
            }
            Err(problem) => self.give_up_if_late(outage, problem),
        }
    }
}

/// Resets a camera as if it were unplugged and plugged in; false where it is not there.
fn reset(config: &Config) -> bool {
    let Ok(device) = Context::new().and_then(|context| find::camera(&context, &config.serial)) else { return false };
    log::warn!("camera {:?}: it does not stream: resetting it", config.name);
    device.reset();
    true
}

impl Camera for RealsenseCamera {
    fn name(&self) -> &str {
        &self.config.name
    }

    fn intrinsics(&self) -> &Intrinsics {
        &self.calibration.intrinsics
    }

    fn next_image(&mut self, timeout: Duration) -> Result<Image, Error> {
        let deadline = Instant::now() + timeout;
        loop {
            match &self.link {
                Link::Down => self.reconnect(deadline)?,
                Link::Up(_) => {
                    if let Some(image) = self.wait_for_image(deadline)? {
                        return Ok(image);
                    }
                    if matches!(self.link, Link::Up(_)) {
                        return Err(Error::NoImage { camera: self.config.name.clone(), waited: timeout });
                    }
                }
            }
        }
    }

    fn waits_for_caller(&self) -> bool {
        self.config.file.is_some() && self.config.pace == Pace::Fast
    }
}
