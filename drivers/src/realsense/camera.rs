//! A RealSense camera that reconnects after an outage.

use super::find;
use super::image_stream::{ImageStream, Next};
use super::sdk::Context;
use super::{Calibration, Config, Pace, Problem};
use crate::reconnecting::{CameraCounts, Failure, ReconnectPolicy, Reconnecting, ReopenableCamera};
use crate::{Camera, Error, Image};
use kinematics::Intrinsics;
use std::time::{Duration, Instant};

/// Pause before every attempt to reconnect. After a reset, a camera is unavailable for a few
/// seconds.
const RETRY_PAUSE: Duration = Duration::from_millis(500);
/// A stream is restarted if no image arrives for this time, because cameras may hang. The next
/// constant is the same limit in image periods. The longer of the two limits applies.
const MAX_SILENCE: Duration = Duration::from_secs(2);
const MAX_SILENT_IMAGES: f64 = 10.0;
/// Number of failed attempts after which a camera that is connected but does not stream is reset.
const TRIES_BEFORE_RESET: u32 = 3;

/// A RealSense camera, or a file that is played back. It streams color or infrared images and, if
/// configured, depth.
///
/// A camera that is disconnected or hangs is reopened with the same settings for at most
/// [`Config::reconnect_for`]. If it cannot be reopened, it is reset. In the meantime,
/// [`Camera::next_image`] returns [`Error::Reconnecting`]. If the camera does not come back in
/// time, it returns the cause. Dropping this value stops the streams.
#[derive(Debug)]
pub struct RealsenseCamera {
    camera: Reconnecting<RealsenseDevice>,
    calibration: Calibration,
}

#[derive(Debug)]
struct RealsenseDevice {
    config: Config,
    /// Number of resets in the current outage. The next field counts the resets of earlier outages.
    n_resets: u32,
    n_earlier_resets: u32,
}

impl RealsenseCamera {
    /// Opens a camera or a file, applies the settings of the rig file, and starts the streams.
    pub fn open(config: Config) -> Result<Self, Error> {
        let policy = ReconnectPolicy {
            camera: config.name.clone(),
            rate_hz: config.rate_hz,
            reconnect_for: config.reconnect_for,
            first_pause: RETRY_PAUSE,
            retry_pause: RETRY_PAUSE,
        };
        let mut device = RealsenseDevice {
            config,
            n_resets: 0,
            n_earlier_resets: 0,
        };
        let stream = device
            .open()
            .map_err(|failure| failure.into_error(|problem| device.error(problem)))?;
        log::info!("camera {:?}: {}", device.config.name, stream.describe());
        let calibration = stream.calibration().clone();
        Ok(Self {
            camera: Reconnecting::new(device, stream, policy),
            calibration,
        })
    }

    /// Calibration stored in the camera.
    pub fn calibration(&self) -> &Calibration {
        &self.calibration
    }

    /// Statistics since the camera was opened.
    pub fn counts(&self) -> CameraCounts {
        self.camera.counts()
    }

    /// Number of resets since the camera was opened.
    pub fn n_resets(&self) -> u32 {
        let device = self.camera.device();
        device.n_earlier_resets + device.n_resets
    }
}

impl RealsenseDevice {
    fn error(&self, problem: Problem) -> Error {
        Error::Realsense {
            camera: self.config.name.clone(),
            problem: Box::new(problem),
        }
    }
}

impl ReopenableCamera for RealsenseDevice {
    type Stream = ImageStream;
    type Problem = Problem;

    fn open(&mut self) -> Result<ImageStream, Failure<Problem>> {
        Ok(ImageStream::start(&self.config)?)
    }

    fn describe(&self, stream: &ImageStream) -> Option<String> {
        Some(stream.describe().to_owned())
    }

    fn next_image(
        &mut self,
        stream: &mut ImageStream,
        deadline: Instant,
    ) -> Result<Option<Image>, Failure<Problem>> {
        let camera = || self.config.name.clone();
        let is_file = self.config.file.is_some();
        match stream.next(deadline) {
            Ok(Next::Image(image)) => {
                self.n_earlier_resets += std::mem::take(&mut self.n_resets);
                return Ok(Some(image));
            }
            Ok(Next::End) => return Err(Failure::Final(Error::Ended { camera: camera() })),
            Ok(Next::NotDue(remaining)) => {
                return Err(Failure::Final(Error::NotDue {
                    camera: camera(),
                    remaining,
                }));
            }
            Ok(Next::NoImage) => {}
            // Files are not reopened.
            Err(problem) if is_file => return Err(Failure::Final(self.error(problem))),
            Err(problem) => return Err(problem.into()),
        }
        let waited = stream.time_since_image();
        if !is_file
            && waited
                > MAX_SILENCE.max(Duration::from_secs_f64(
                    MAX_SILENT_IMAGES / self.config.rate_hz,
                ))
        {
            return Err(Problem::Silent { waited }.into());
        }
        Ok(None)
    }

    /// Resets the camera, which has the effect of reconnecting it. Fails if it is not connected.
    fn reset(&mut self, n_tries: u32) -> bool {
        // A reset takes seconds and makes other programs lose the camera, so reopening is tried
        // first.
        if !n_tries.is_multiple_of(TRIES_BEFORE_RESET) {
            return false;
        }
        let found = Context::new().and_then(|context| find::camera(&context, &self.config.serial));
        // A camera that is unplugged cannot be reset.
        let Ok(device) = found else { return false };
        log::warn!(
            "camera {:?}: it is connected but does not stream; resetting it",
            self.config.name
        );
        device.reset();
        self.n_resets += 1;
        true
    }

    fn lost(&self, waited: Duration, n_tries: u32, last: Problem) -> Error {
        self.error(Problem::Lost {
            waited,
            n_tries,
            n_resets: self.n_resets,
            last: Box::new(last),
        })
    }
}

impl Camera for RealsenseCamera {
    fn name(&self) -> &str {
        &self.camera.device().config.name
    }

    fn intrinsics(&self) -> &Intrinsics {
        &self.calibration.intrinsics
    }

    fn next_image(&mut self, timeout: Duration) -> Result<Image, Error> {
        self.camera.next_image(timeout)
    }

    fn waits_for_caller(&self) -> bool {
        let config = &self.camera.device().config;
        config.file.is_some() && config.pace == Pace::Fast
    }
}
