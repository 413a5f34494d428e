//! A V4L2 camera that reconnects after an outage.

use super::stream::V4l2Stream;
use super::{Config, Problem};
use crate::reconnecting::{CameraCounts, Failure, ReconnectPolicy, Reconnecting, ReopenableCamera};
use crate::{Camera, Error, Image};
use kinematics::Intrinsics;
use std::time::{Duration, Instant};

/// Pause between two attempts to reconnect. The pause is short, because opening a missing node
/// fails at once and a shorter outage loses fewer images.
const RETRY_PAUSE: Duration = Duration::from_millis(100);
/// A stream is restarted if no image arrives for this time, because cameras may hang. The next
/// constant is the same limit in image periods. The longer of the two limits applies.
const MAX_SILENCE: Duration = Duration::from_secs(2);
const MAX_SILENT_IMAGES: f64 = 5.0;

/// A streaming V4L2 camera.
///
/// A camera that is disconnected or hangs is reopened with the same settings for at most
/// [`Config::reconnect_for`]. In the meantime, [`Camera::next_image`] returns
/// [`Error::Reconnecting`]. If the camera does not come back in time, it returns the cause. Images
/// missed in the meantime count as skipped. Dropping this value stops the stream.
#[derive(Debug)]
pub struct V4l2Camera(Reconnecting<V4l2Device>);

#[derive(Debug)]
struct V4l2Device {
    config: Config,
    /// Number of images delivered with damaged or incomplete data.
    n_damaged: u64,
    /// Whether an image was requested yet.
    was_read: bool,
}

impl V4l2Camera {
    /// Opens a camera, applies the settings of the rig file, reads them back, and starts the
    /// stream.
    pub fn open(config: Config) -> Result<Self, Error> {
        if config.device.starts_with("/dev/video") {
            let Config { name, device, .. } = &config;
            log::warn!(
                "camera {name:?}: {device} may become another camera after a restart; `fieldrig devices` prints a stable name"
            );
        }
        let policy = ReconnectPolicy {
            camera: config.name.clone(),
            rate_hz: config.rate_hz,
            reconnect_for: config.reconnect_for,
            first_pause: Duration::ZERO,
            retry_pause: RETRY_PAUSE,
        };
        let mut device = V4l2Device {
            config,
            n_damaged: 0,
            was_read: false,
        };
        let stream = device
            .open()
            .map_err(|failure| failure.into_error(|problem| device.error(problem)))?;
        log::info!("camera {:?}: {}", device.config.name, stream.describe());
        Ok(Self(Reconnecting::new(device, stream, policy)))
    }

    /// Statistics since the camera was opened.
    pub fn counts(&self) -> CameraCounts {
        self.0.counts()
    }

    /// Number of dropped images that the device delivered with damaged or incomplete data.
    pub fn n_damaged(&self) -> u64 {
        self.0.device().n_damaged
    }

    /// Names and values of the settings as read back from the camera. Empty while the camera is
    /// disconnected.
    pub fn read_back(&self) -> &[(&'static str, i32)] {
        self.0.stream().map_or(&[], V4l2Stream::read_back)
    }
}

impl V4l2Device {
    fn error(&self, problem: Problem) -> Error {
        Error::V4l2 {
            camera: self.config.name.clone(),
            problem: Box::new(problem),
        }
    }
}

impl ReopenableCamera for V4l2Device {
    type Stream = V4l2Stream;
    type Problem = Problem;

    fn open(&mut self) -> Result<V4l2Stream, Failure<Problem>> {
        V4l2Stream::start(&self.config)
    }

    fn describe(&self, stream: &V4l2Stream) -> Option<String> {
        Some(stream.describe())
    }

    fn next_image(
        &mut self,
        stream: &mut V4l2Stream,
        deadline: Instant,
    ) -> Result<Option<Image>, Failure<Problem>> {
        // Between opening this camera and the first request for an image, other devices may take
        // seconds to open. By then, the images in the queue are outdated.
        if !std::mem::replace(&mut self.was_read, true) {
            stream.discard_queued()?;
        }
        let image = stream.next_image(&self.config, deadline);
        self.n_damaged += stream.take_n_damaged();
        let image = image?;
        // Damaged images do not end the silence. A camera that sends only damaged images has hung,
        // and is opened again.
        let waited = stream.time_since_image();
        if image.is_none()
            && waited
                > MAX_SILENCE.max(Duration::from_secs_f64(
                    MAX_SILENT_IMAGES / self.config.rate_hz,
                ))
        {
            return Err(Problem::Silent { waited }.into());
        }
        Ok(image)
    }

    fn lost(&self, waited: Duration, n_tries: u32, last: Problem) -> Error {
        self.error(Problem::Lost {
            waited,
            n_tries,
            last: Box::new(last),
        })
    }
}

impl Camera for V4l2Camera {
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
        let message = V4l2Camera::open(config)
            .expect_err("the camera does not exist")
            .to_string();
        assert!(
            message.contains("\"wrist\"") && message.contains("no such serial"),
            "{message}"
        );
    }
}
