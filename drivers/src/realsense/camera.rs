//! A RealSense camera that reconnects after an outage.

use super::find;
use super::sdk::Context;
use super::session::{Next, Session};
use super::{Calibration, Config, Pace, Problem};
use crate::outage::{Outage, n_between};
use crate::{Camera, Error, Image};
use kinematics::{Intrinsics, Stamp};
use std::time::{Duration, Instant};

/// Pause between two attempts to reconnect. After a reset, a camera is unavailable for a few seconds.
const RETRY_PAUSE: Duration = Duration::from_millis(500);
/// A stream without images for this long, or for the time of this many images, is restarted, because cameras may hang.
const MAX_SILENCE: Duration = Duration::from_secs(2);
const MAX_SILENT_IMAGES: f64 = 10.0;
/// After every so many failed attempts, a camera that is connected but does not stream is reset.
const TRIES_BEFORE_RESET: u32 = 3;

/// A RealSense camera that streams color or infrared and, if configured, depth; or a file that is played back.
///
/// A camera that is disconnected or hangs is reopened with the same settings for at most [`Config::reconnect_for`], and
/// reset if that does not help. During that time, [`Camera::next_image`] returns [`Error::Reconnecting`], afterwards
/// the cause. Dropping it stops the streams.
#[derive(Debug)]
pub struct RealsenseCamera {
    config: Config,
    connection: Connection,
    calibration: Calibration,
    counts: Counts,
    /// Stamps of the last color or infrared image and of the last depth image, kept across reconnections.
    last: [Option<Stamp>; 2],
    /// Set from the start of an outage until the next image.
    outage: Option<Outage>,
    /// Number of resets in the current outage.
    n_resets: u32,
}

/// Statistics of a camera since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Number of delivered images, including depth.
    pub n_images: u64,
    /// Number of dropped images, all of which were reported in [`Image::n_skipped`].
    pub n_skipped: u64,
    /// Number of reconnections.
    pub n_reconnections: u32,
    /// Number of resets.
    pub n_resets: u32,
}

#[derive(Debug)]
enum Connection {
    Connected(Box<Session>),
    Disconnected,
}

impl RealsenseCamera {
    /// Opens a camera or a file, applies the settings of the rig file, and starts the streams.
    pub fn open(config: Config) -> Result<Self, Error> {
        let session = Session::start(&config)
            .map_err(|problem| Error::Realsense { camera: config.name.clone(), problem: Box::new(problem) })?;
        log::info!("camera {:?}: {}", config.name, session.describe());
        Ok(Self {
            calibration: session.calibration().clone(),
            config,
            connection: Connection::Connected(Box::new(session)),
            counts: Counts::default(),
            last: [None; 2],
            outage: None,
            n_resets: 0,
        })
    }

    /// Calibration stored in the camera.
    pub fn calibration(&self) -> &Calibration {
        &self.calibration
    }

    /// Statistics since the camera was opened.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// Waits once for an image of a connected camera.
    fn poll_image(&mut self, deadline: Instant) -> Result<Option<Image>, Error> {
        let Connection::Connected(session) = &mut self.connection else { return Ok(None) };
        match session.next(deadline) {
            Ok(Next::Image(image)) => return Ok(Some(self.count(image))),
            Ok(Next::End) => return Err(Error::Ended { camera: self.config.name.clone() }),
            Ok(Next::NotDue(remaining)) => return Err(Error::NotDue { camera: self.config.name.clone(), remaining }),
            Ok(Next::NoImage) => {}
            Err(problem) => return self.handle_disconnect(problem).map(|()| None),
        }
        let waited = session.time_since_image();
        let is_camera = self.config.file.is_none();
        if is_camera && waited > MAX_SILENCE.max(Duration::from_secs_f64(MAX_SILENT_IMAGES / self.config.rate_hz)) {
            self.handle_disconnect(Problem::Silent { waited })?;
        }
        Ok(None)
    }

    fn count(&mut self, mut image: Image) -> Image {
        let last = self.last[usize::from(image.is_depth())].replace(image.stamp);
        let is_first_since_open = matches!(&self.connection, Connection::Connected(session) if session.n_images() == 1);
        if let (true, Some(last)) = (is_first_since_open, last) {
            image.n_skipped = image.n_skipped.max(n_between(last, image.stamp, self.config.rate_hz));
        }
        (self.outage, self.n_resets) = (None, 0);
        self.counts.n_images += 1;
        self.counts.n_skipped += image.n_skipped;
        image
    }

    /// Closes the device before it is reopened. Files are not reopened.
    fn handle_disconnect(&mut self, cause: Problem) -> Result<(), Error> {
        if self.config.file.is_some() {
            return Err(Error::Realsense { camera: self.config.name.clone(), problem: Box::new(cause) });
        }
        let outage = Outage::of(&mut self.outage);
        self.connection = Connection::Disconnected;
        if outage.n_tries > 0 {
            return self.fail_if_overdue(outage, cause);
        }
        log::warn!("camera {:?}: {cause}; trying to reconnect for {:?}", self.config.name, self.config.reconnect_for);
        Ok(())
    }

    /// Fails if the camera has been disconnected for longer than the rig file allows.
    fn fail_if_overdue(&self, Outage { since, n_tries, .. }: Outage, cause: Problem) -> Result<(), Error> {
        let (camera, waited) = (self.config.name.clone(), since.elapsed());
        if waited < self.config.reconnect_for {
            log::debug!("camera {camera:?}: {cause}");
            return Ok(());
        }
        let problem = Problem::Lost { waited, n_tries, n_resets: self.n_resets, last: Box::new(cause) };
        Err(Error::Realsense { camera, problem: Box::new(problem) })
    }

    /// Tries once to reopen a disconnected camera, after the pause since the last attempt.
    fn reconnect(&mut self, deadline: Instant) -> Result<(), Error> {
        let (Connection::Disconnected, Some(outage)) = (&self.connection, &mut self.outage) else { return Ok(()) };
        if !outage.wait_for_retry(RETRY_PAUSE, deadline) {
            return Err(Error::Reconnecting { camera: self.config.name.clone(), waited: outage.since.elapsed() });
        }
        if outage.n_tries.is_multiple_of(TRIES_BEFORE_RESET) && reset(&self.config) {
            self.n_resets += 1;
            self.counts.n_resets += 1;
            return Ok(());
        }
        let outage = *outage;
        match Session::start(&self.config) {
            Ok(session) => {
                let (camera, waited) = (&self.config.name, outage.since.elapsed());
                log::info!("camera {camera:?}: reconnected after {waited:?}: {}", session.describe());
                self.counts.n_reconnections += 1;
                self.connection = Connection::Connected(Box::new(session));
                Ok(())
            }
            Err(problem) => self.fail_if_overdue(outage, problem),
        }
    }
}

/// Resets a camera, which has the effect of reconnecting it. Returns false if it is not connected.
fn reset(config: &Config) -> bool {
    let Ok(device) = Context::new().and_then(|context| find::camera(&context, &config.serial)) else { return false };
    log::warn!("camera {:?}: it is connected but does not stream; resetting it", config.name);
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
            match &self.connection {
                Connection::Disconnected => self.reconnect(deadline)?,
                Connection::Connected(_) => {
                    if let Some(image) = self.poll_image(deadline)? {
                        return Ok(image);
                    }
                    if matches!(self.connection, Connection::Connected(_)) {
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
