//! A V4L2 camera as the rest of the program sees it: images while it is plugged in, waiting while it is not.

use super::stream::V4l2Stream;
use super::{Config, Problem};
use crate::outage::{Outage, n_between};
use crate::{Camera, Error, Image};
use kinematics::{Intrinsics, Stamp};
use std::time::{Duration, Instant};

/// Between two tries to find a lost camera again.
const RETRY_PAUSE: Duration = Duration::from_millis(100);
/// A stream that is silent for this long, or for so many images, is begun anew: cameras hang.
const MAX_SILENCE: Duration = Duration::from_secs(2);
const MAX_SILENT_IMAGES: f64 = 5.0;

/// A V4L2 camera that streams.
///
/// A camera that is unplugged, or hangs, is opened again with the same settings, for at most [`Config::reconnect_for`]: until
/// then [`Camera::next_image`] says [`Error::Reconnecting`], after that what it was. Images that would have come meanwhile count
/// as skipped. Dropping it ends the stream.
#[derive(Debug)]
pub struct V4l2Camera {
    config: Config,
    connection: Connection,
    counts: Counts,
    /// Stamp of the last image, across reconnections.
    last: Option<Stamp>,
    /// Set from a loss to the next image.
    outage: Option<Outage>,
    /// Whether an image was asked for yet.
    was_read: bool,
}

/// What became of the camera since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Images delivered.
    pub n_images: u64,
    /// Images lost, all of which were told in [`Image::n_skipped`].
    pub n_skipped: u64,
    /// Of these: delivered by the device with damaged or too little data.
    pub n_damaged: u64,
    /// Times that it was found again.
    pub n_reconnections: u32,
}

#[derive(Debug)]
enum Connection {
    Connected(Box<V4l2Stream>),
    Disconnected,
}

impl V4l2Camera {
    /// Opens a camera, sets it up as the rig file says, reads that back, and starts its stream.
    pub fn open(config: Config) -> Result<Self, Error> {
        if config.device.starts_with("/dev/video") {
            let Config { name, device, .. } = &config;
            log::warn!(
                "camera {name:?}: {device} may be another camera tomorrow; `fieldrig devices` prints a name that stays"
            );
        }
        let stream = V4l2Stream::start(&config)?;
        log::info!("camera {:?}: {}", config.name, stream.describe());
        Ok(Self {
            config,
            connection: Connection::Connected(Box::new(stream)),
            counts: Counts::default(),
            last: None,
            outage: None,
            was_read: false,
        })
    }

    /// What became of it so far.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// What the camera told when its settings were read back, names and counts; empty while it is gone.
    pub fn read_back(&self) -> &[(&'static str, i32)] {
        match &self.connection {
            Connection::Connected(stream) => stream.read_back(),
            Connection::Disconnected => &[],
        }
    }

    /// One step of waiting for an image of a camera that is there.
    fn poll_image(&mut self, deadline: Instant) -> Result<Option<Image>, Error> {
        let Connection::Connected(stream) = &mut self.connection else { return Ok(None) };
        if !std::mem::replace(&mut self.was_read, true)
            && let Err(problem) = stream.discard_queued()
        {
            return self.handle_disconnect(problem).map(|()| None);
        }
        let (n_damaged, image) = (stream.n_damaged(), stream.next_image(&self.config, deadline));
        self.counts.n_damaged += stream.n_damaged() - n_damaged;
        let image = match image {
            Ok(image) => image,
            Err(problem) => return self.handle_disconnect(problem).map(|()| None),
        };
        let waited = stream.time_since_image();
        if image.is_none() && waited > MAX_SILENCE.max(Duration::from_secs_f64(MAX_SILENT_IMAGES / self.config.rate_hz))
        {
            self.handle_disconnect(Problem::Silent { waited })?;
        }
        Ok(image.map(|image| self.count(image)))
    }

    fn count(&mut self, mut image: Image) -> Image {
        if self.is_first_since_open() {
            let n_missed_by_time = self.last.map_or(0, |last| n_between(last, image.stamp, self.config.rate_hz));
            image.n_skipped = image.n_skipped.max(n_missed_by_time);
        }
        self.last = Some(image.stamp);
        self.outage = None;
        self.counts.n_images += 1;
        self.counts.n_skipped += image.n_skipped;
        image
    }

    /// Whether the image in hand is the first since the camera was opened, for the first time or again.
    fn is_first_since_open(&self) -> bool {
        matches!(&self.connection, Connection::Connected(stream) if stream.n_images() == 1)
    }

    /// Closes the device before it is looked for: a node in use keeps its number. Fails when it has been lost for too long: a camera
    /// that can be opened and sends nothing is lost, too.
    fn handle_disconnect(&mut self, cause: Problem) -> Result<(), Error> {
        let outage = Outage::of(&mut self.outage);
        self.connection = Connection::Disconnected;
        if outage.n_tries > 0 {
            return self.fail_if_overdue(outage, cause);
        }
        log::warn!("camera {:?}: {cause}; looking for it for {:?}", self.config.name, self.config.reconnect_for);
        Ok(())
    }

    /// The error of a camera that was lost for longer than the rig file allows.
    fn fail_if_overdue(&self, Outage { since, n_tries, .. }: Outage, cause: Problem) -> Result<(), Error> {
        let (camera, waited) = (self.config.name.clone(), since.elapsed());
        if waited < self.config.reconnect_for {
            log::debug!("camera {camera:?}: {cause}");
            return Ok(());
        }
        Err(Error::V4l2 { camera, problem: Box::new(Problem::Lost { waited, n_tries, last: Box::new(cause) }) })
    }

    /// One try to open a lost camera again, not before the pause since the last one is over.
    fn reconnect(&mut self, deadline: Instant) -> Result<(), Error> {
        let (Connection::Disconnected, Some(outage)) = (&self.connection, &mut self.outage) else { return Ok(()) };
        let pause = if outage.n_tries == 0 { Duration::ZERO } else { RETRY_PAUSE };
        if !outage.wait_for_retry(pause, deadline) {
            return Err(Error::Reconnecting { camera: self.config.name.clone(), waited: outage.since.elapsed() });
        }
        let outage = *outage;
        match V4l2Stream::start(&self.config) {
            Ok(stream) => {
                let Outage { since, n_tries, .. } = outage;
                let (camera, waited) = (&self.config.name, since.elapsed());
                log::info!(
                    "camera {camera:?}: there again after {waited:?} and {n_tries} tries: {}",
                    stream.describe()
                );
                self.counts.n_reconnections += 1;
                self.connection = Connection::Connected(Box::new(stream));
                Ok(())
            }
            Err(Error::V4l2 { problem, .. }) => self.fail_if_overdue(outage, *problem),
            Err(other) => Err(other),
        }
    }
}

impl Camera for V4l2Camera {
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
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_camera_error_names_it() {
        let config = Config {
            name: "wrist".into(),
            device: "no such serial".into(),
            format: None,
            intrinsics: Intrinsics {
                size_px: [640, 480],
                focal_px: [600.0; 2],
                principal_px: [320.0, 240.0],
                lens: kinematics::Lens::Pinhole,
                rectified: true,
            },
            rate_hz: 30.0,
            meters_per_count: None,
            settings: super::super::Settings::default(),
            delivery: super::super::Delivery::Every,
            reconnect_for: Duration::from_secs(1),
        };
        let message = V4l2Camera::open(config).expect_err("nothing there").to_string();
        assert!(message.contains("\"wrist\"") && message.contains("no such serial"), "{message}");
    }
}
