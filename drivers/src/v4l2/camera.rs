//! A V4L2 camera that reconnects after an outage.

use super::stream::V4l2Stream;
use super::{Config, Problem};
use crate::outage::{Outage, n_between};
use crate::{Camera, Error, Image};
use kinematics::{Intrinsics, Stamp};
use std::time::{Duration, Instant};

/// Pause between two attempts to reconnect.
const RETRY_PAUSE: Duration = Duration::from_millis(100);
/// A stream without images for this long, or for the time of this many images, is restarted, because cameras may hang.
const MAX_SILENCE: Duration = Duration::from_secs(2);
const MAX_SILENT_IMAGES: f64 = 5.0;

/// A streaming V4L2 camera.
///
/// A camera that is disconnected or hangs is reopened with the same settings for at most [`Config::reconnect_for`].
/// During that time, [`Camera::next_image`] returns [`Error::Reconnecting`], afterwards the cause. Images missed in the
/// meantime count as skipped. Dropping it stops the stream.
#[derive(Debug)]
pub struct V4l2Camera {
    config: Config,
    connection: Connection,
    counts: Counts,
    /// Stamp of the last image, kept across reconnections.
    last: Option<Stamp>,
    /// Set from the start of an outage until the next image.
    outage: Option<Outage>,
    /// Whether an image was requested yet.
    was_read: bool,
}

/// Statistics of a camera since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Number of delivered images.
    pub n_images: u64,
    /// Number of dropped images, all of which were reported in [`Image::n_skipped`].
    pub n_skipped: u64,
    /// Dropped images that the device delivered with damaged or incomplete data.
    pub n_damaged: u64,
    /// Number of reconnections.
    pub n_reconnections: u32,
}

#[derive(Debug)]
enum Connection {
    Connected(Box<V4l2Stream>),
    Disconnected,
}

impl V4l2Camera {
    /// Opens a camera, applies the settings of the rig file, reads them back, and starts the stream.
    pub fn open(config: Config) -> Result<Self, Error> {
        if config.device.starts_with("/dev/video") {
            let Config { name, device, .. } = &config;
            log::warn!(
                "camera {name:?}: {device} may become another camera after a restart; `fieldrig devices` prints a stable name"
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

    /// Statistics since the camera was opened.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// Settings as read back from the camera, names and values. Empty while it is disconnected.
    pub fn read_back(&self) -> &[(&'static str, i32)] {
        match &self.connection {
            Connection::Connected(stream) => stream.read_back(),
            Connection::Disconnected => &[],
        }
    }

    /// Waits once for an image of a connected camera.
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

    /// Whether the current image is the first one since the camera was opened or reopened.
    fn is_first_since_open(&self) -> bool {
        matches!(&self.connection, Connection::Connected(stream) if stream.n_images() == 1)
    }

    /// Closes the device before it is reopened, because an open node keeps its number. Fails if the camera has been
    /// disconnected for too long; a camera that can be opened but sends nothing counts as disconnected.
    fn handle_disconnect(&mut self, cause: Problem) -> Result<(), Error> {
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
        Err(Error::V4l2 { camera, problem: Box::new(Problem::Lost { waited, n_tries, last: Box::new(cause) }) })
    }

    /// Tries once to reopen a disconnected camera, after the pause since the last attempt.
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
                    "camera {camera:?}: reconnected after {waited:?} ({n_tries} attempts): {}",
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
        let message = V4l2Camera::open(config).expect_err("the camera does not exist").to_string();
        assert!(message.contains("\"wrist\"") && message.contains("no such serial"), "{message}");
    }
}
