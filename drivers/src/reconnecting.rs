//! Reopens a camera after it was disconnected. All camera drivers use this code.
//!
//! A driver implements [`ReopenableCamera`], which opens the camera, reads images and describes
//! problems. [`Reconnecting`] decides when to retry and when to give up, and counts the images that
//! were lost in the meantime.

use crate::outage::{Outage, n_between};
use crate::{Error, Image};
use kinematics::Stamp;
use std::fmt::{Debug, Display};
use std::time::{Duration, Instant};

/// A camera that can be opened repeatedly.
///
/// An implementation must not return images that were queued before the camera was opened. If the
/// camera has no clock, it stamps an image when the last byte has arrived.
pub(crate) trait ReopenableCamera: Debug {
    /// The open camera. Dropping it closes the camera.
    type Stream: Debug;
    /// A problem of this kind of camera.
    type Problem: Display;

    /// Opens the camera. This function must return within about 100 ms, because the caller cannot
    /// be stopped in the meantime. If opening takes longer, it must run on another thread.
    /// [`Self::describe`] then returns `None` until the camera is open.
    fn open(&mut self) -> Result<Self::Stream, Failure<Self::Problem>>;

    /// Description of device, mode and settings for the log. Returns `None` while the camera is
    /// still being opened. For a camera that only sends datagrams, opening does not prove that the
    /// camera exists. For such a camera, this function returns `None` until the first image. A
    /// camera counts as reconnected once it has a description.
    fn describe(&self, stream: &Self::Stream) -> Option<String>;

    /// Waits for the next image. Returns `None` if no image arrived. The caller may call again
    /// until the deadline has passed.
    fn next_image(
        &mut self,
        stream: &mut Self::Stream,
        deadline: Instant,
    ) -> Result<Option<Image>, Failure<Self::Problem>>;

    /// May reset the camera before an attempt to reopen it. `n_tries` is the number of the attempt,
    /// starting at 1. If this function returns true, it has reset the camera, and the attempt ends.
    fn reset(&mut self, _n_tries: u32) -> bool {
        false
    }

    /// The error after the last attempt to reconnect.
    fn lost(&self, waited: Duration, n_tries: u32, last: Self::Problem) -> Error;
}

/// The reason why a camera cannot be opened or delivers no images.
#[derive(Debug)]
pub(crate) enum Failure<P> {
    /// The camera is disconnected, or has a problem that may disappear if it is reopened.
    Lost(P),
    /// A permanent error: the camera answered and refuses the settings of the rig file. The driver
    /// returns this error without another attempt.
    #[cfg_attr(
        not(any(target_os = "linux", feature = "realsense", test)),
        expect(dead_code, reason = "the nokhwa driver has no such errors")
    )]
    Final(Error),
}

impl<P> From<P> for Failure<P> {
    fn from(problem: P) -> Self {
        Self::Lost(problem)
    }
}

impl<P> Failure<P> {
    /// The error that is returned if there is no further attempt.
    pub(crate) fn into_error(self, error_of: impl FnOnce(P) -> Error) -> Error {
        match self {
            Self::Lost(problem) => error_of(problem),
            Self::Final(error) => error,
        }
    }
}

/// Determines when a camera is reopened.
#[derive(Clone, Debug)]
pub(crate) struct ReconnectPolicy {
    /// Name in the rig file.
    pub(crate) camera: String,
    /// Images per second.
    pub(crate) rate_hz: f64,
    /// Time after which the next problem is returned as an error.
    pub(crate) reconnect_for: Duration,
    /// Pause before the first attempt.
    pub(crate) first_pause: Duration,
    /// Pause between two attempts.
    pub(crate) retry_pause: Duration,
}

/// Statistics of a camera since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CameraCounts {
    /// Number of delivered images, including depth.
    pub n_images: u64,
    /// Number of dropped images, all of which were reported in [`Image::n_skipped`].
    pub n_skipped: u64,
    /// Number of reconnections.
    pub n_reconnections: u32,
}

/// A camera that is reopened with the same settings after it was disconnected.
#[derive(Debug)]
pub(crate) struct Reconnecting<C: ReopenableCamera> {
    device: C,
    policy: ReconnectPolicy,
    /// `None` while the camera is disconnected.
    stream: Option<C::Stream>,
    /// Whether the camera has finished opening.
    is_streaming: bool,
    /// The outage, from its start until the next image. A camera that can be opened but sends
    /// nothing still counts as disconnected.
    outage: Option<Outage>,
    /// Stamps of the last color image and of the last depth image. Both are kept across
    /// reconnections.
    last: [Option<Stamp>; 2],
    /// Whether a color image and a depth image have arrived since the camera was last opened.
    has_image: [bool; 2],
    counts: CameraCounts,
}

impl<C: ReopenableCamera> Reconnecting<C> {
    /// Takes over a camera that was opened and streams.
    pub(crate) fn new(device: C, stream: C::Stream, policy: ReconnectPolicy) -> Self {
        Self {
            device,
            policy,
            stream: Some(stream),
            is_streaming: true,
            outage: None,
            last: [None; 2],
            has_image: [false; 2],
            counts: CameraCounts::default(),
        }
    }

    pub(crate) fn device(&self) -> &C {
        &self.device
    }

    /// The open camera; `None` while it is disconnected.
    #[cfg(target_os = "linux")]
    pub(crate) fn stream(&self) -> Option<&C::Stream> {
        self.stream.as_ref()
    }

    pub(crate) fn counts(&self) -> CameraCounts {
        self.counts
    }

    /// Waits for the next image, see [`crate::Camera::next_image`].
    pub(crate) fn next_image(&mut self, timeout: Duration) -> Result<Image, Error> {
        let deadline = Instant::now() + timeout;
        loop {
            if self.stream.is_none() {
                self.reconnect(deadline)?;
                continue;
            }
            if let Some(image) = self.poll_image(deadline)? {
                return Ok(image);
            }
            // While the camera is still being opened, a missing image is part of the known outage,
            // not a new silence.
            if self.stream.is_some() && Instant::now() >= deadline {
                return Err(match self.outage {
                    Some(outage) if !self.is_streaming => self.reconnecting(outage),
                    _ => Error::NoImage {
                        camera: self.policy.camera.clone(),
                        waited: timeout,
                    },
                });
            }
        }
    }

    /// Waits once for an image of a connected camera.
    fn poll_image(&mut self, deadline: Instant) -> Result<Option<Image>, Error> {
        let Some(stream) = &mut self.stream else {
            return Ok(None);
        };
        let image = self.device.next_image(stream, deadline);
        self.report_reconnection();
        match image {
            Ok(image) => Ok(image.map(|image| self.count(image))),
            Err(Failure::Lost(problem)) => self.disconnect(problem).map(|()| None),
            Err(Failure::Final(error)) => Err(error),
        }
    }

    /// Counts an image. If this is the first color or depth image since the camera was reopened,
    /// also counts the images that were missed during the outage.
    fn count(&mut self, mut image: Image) -> Image {
        let kind = usize::from(image.is_depth());
        let last = self.last[kind].replace(image.stamp);
        // Sequence numbers start again when a camera is opened, so the driver cannot count images
        // that were lost during an outage. The number is estimated from the stamps instead. The
        // driver may also have counted images that were dropped after opening, so the larger of
        // both numbers is used.
        let is_first_since_open = !std::mem::replace(&mut self.has_image[kind], true);
        if let (true, Some(last)) = (is_first_since_open, last) {
            image.n_skipped =
                image
                    .n_skipped
                    .max(n_between(last, image.stamp, self.policy.rate_hz));
        }
        // The outage ends with an image and not with the opening, because a camera may be open but
        // send nothing.
        self.outage = None;
        self.counts.n_images += 1;
        self.counts.n_skipped += image.n_skipped;
        image
    }

    /// Closes the camera. If its device node stayed open, the camera would get another number when
    /// it is connected again.
    fn disconnect(&mut self, problem: C::Problem) -> Result<(), Error> {
        let outage = Outage::of(&mut self.outage);
        // The stream is dropped before the warning and any wait, so that the device node is free
        // from here on.
        self.stream = None;
        // The first problem is a warning. Later problems are logged at a lower level until the time
        // limit, because every attempt would otherwise repeat the warning.
        if outage.n_tries > 0 {
            return self.fail_if_overdue(outage, problem);
        }
        let ReconnectPolicy {
            camera,
            reconnect_for,
            ..
        } = &self.policy;
        log::warn!("camera {camera:?}: {problem}; trying to reconnect for {reconnect_for:?}");
        Ok(())
    }

    /// Fails if the camera has been disconnected for longer than the rig file allows.
    fn fail_if_overdue(
        &self,
        Outage { since, n_tries, .. }: Outage,
        problem: C::Problem,
    ) -> Result<(), Error> {
        let waited = since.elapsed();
        if waited < self.policy.reconnect_for {
            log::debug!("camera {:?}: {problem}", self.policy.camera);
            return Ok(());
        }
        Err(self.device.lost(waited, n_tries, problem))
    }

    /// Tries once to reopen a disconnected camera, after the pause since the last attempt.
    fn reconnect(&mut self, deadline: Instant) -> Result<(), Error> {
        let Some(outage) = &mut self.outage else {
            unreachable!("a camera without a stream is in an outage")
        };
        let pause = if outage.n_tries == 0 {
            self.policy.first_pause
        } else {
            self.policy.retry_pause
        };
        let is_due = outage.wait_for_retry(pause, deadline);
        let outage = *outage;
        if !is_due {
            return Err(self.reconnecting(outage));
        }
        // A reset camera disappears from the bus for a moment and cannot be opened at once.
        if self.device.reset(outage.n_tries) {
            return Ok(());
        }
        match self.device.open() {
            Ok(stream) => {
                self.stream = Some(stream);
                self.is_streaming = false;
                self.has_image = [false; 2];
                self.report_reconnection();
                Ok(())
            }
            Err(Failure::Lost(problem)) => self.fail_if_overdue(outage, problem),
            Err(Failure::Final(error)) => Err(error),
        }
    }

    /// Counts and logs a reconnection once the camera has finished opening.
    fn report_reconnection(&mut self) {
        let (Some(stream), Some(Outage { since, n_tries, .. }), false) =
            (&self.stream, self.outage, self.is_streaming)
        else {
            return;
        };
        let Some(description) = self.device.describe(stream) else {
            return;
        };
        let camera = &self.policy.camera;
        let waited = since.elapsed();
        log::info!(
            "camera {camera:?}: reconnected after {waited:?} ({n_tries} attempts): {description}"
        );
        self.is_streaming = true;
        self.counts.n_reconnections += 1;
    }

    fn reconnecting(&self, outage: Outage) -> Error {
        Error::Reconnecting {
            camera: self.policy.camera.clone(),
            waited: outage.since.elapsed(),
        }
    }
}

#[cfg(test)]
mod tests;
