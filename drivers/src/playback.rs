//! Plays a source in real time, as its devices delivered it.

use crate::{Error, Sample, Source};
use kinematics::Stamp;
use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

/// An image is dropped if it is late by more than this time. A camera at 30 Hz fills its queue in
/// [`LiveDevices`](crate::LiveDevices) in the same time. A slow caller therefore loses images in
/// the same way as with devices.
const MAX_DELAY: Duration = Duration::from_millis(270);

/// A source that returns each sample when it is due. Stamps and order of the samples determine when
/// they are due.
///
/// The time from the first sample to the due time of a sample equals the difference of their
/// stamps. A sample is never due before the samples in front of it. This rule preserves the latency
/// of cameras. For example, an image that was recorded after the joint states of the following 30
/// ms is returned 30 ms after its stamp. If the caller is too slow, images are dropped and counted,
/// as with devices.
pub struct Playback {
    source: Box<dyn Source>,
    clock: PlaybackClock,
    /// When the latest sample was due.
    last_due: Option<Instant>,
    /// Numbers of dropped images that are not reported yet. The key is the camera, and whether the
    /// images contain depth.
    n_dropped: BTreeMap<(Arc<str>, bool), u64>,
}

/// Relates the stamps of a [`Playback`] to the clock of this process.
#[derive(Clone, Debug, Default)]
pub struct PlaybackClock {
    /// The first stamp, and when it was returned.
    start: Arc<OnceLock<(Stamp, Instant)>>,
}

impl PlaybackClock {
    /// Time at which a measurement with this stamp takes place in the playback. `None` before the
    /// first sample, and for stamps that are too early for this process's clock.
    #[must_use]
    pub fn instant_of(&self, stamp: Stamp) -> Option<Instant> {
        let (first, began) = self.start.get()?;
        let after_secs = stamp.secs_since(*first);
        let distance = Duration::try_from_secs_f64(after_secs.abs()).ok()?;
        if after_secs >= 0.0 {
            began.checked_add(distance)
        } else {
            began.checked_sub(distance)
        }
    }
}

impl Playback {
    /// Plays a source from its first sample, which is returned at once.
    #[must_use]
    pub fn new(source: Box<dyn Source>) -> Self {
        Self {
            source,
            clock: PlaybackClock::default(),
            last_due: None,
            n_dropped: BTreeMap::new(),
        }
    }

    /// The clock of this playback. It starts with the first sample.
    #[must_use]
    pub fn clock(&self) -> PlaybackClock {
        self.clock.clone()
    }

    /// When a sample is due.
    fn due(&mut self, stamp: Stamp) -> Instant {
        self.clock.start.get_or_init(|| (stamp, Instant::now()));
        let due = self
            .clock
            .instant_of(stamp)
            // A sample is never due before the samples in front of it. Times that the clock cannot
            // represent are replaced by the current time.
            .max(self.last_due)
            .unwrap_or_else(Instant::now);
        self.last_due = Some(due);
        due
    }
}

impl Source for Playback {
    fn next_sample(&mut self) -> Result<Option<Sample>, Error> {
        loop {
            let Some(mut sample) = self.source.next_sample()? else {
                return Ok(None);
            };
            // A sample that is late is returned at once, which lets the playback catch up.
            let delay = match self
                .due(sample.stamp())
                .checked_duration_since(Instant::now())
            {
                Some(remaining) => {
                    std::thread::sleep(remaining);
                    Duration::ZERO
                }
                None => self.last_due.map_or(Duration::ZERO, |due| due.elapsed()),
            };
            if let Sample::Image(image) = &mut sample {
                let key = (image.camera.clone(), image.is_depth());
                if delay > MAX_DELAY {
                    // Only images are dropped. Joint states are small, and the poses of later
                    // images could not be interpolated without them.
                    *self.n_dropped.entry(key).or_default() += 1 + image.n_skipped;
                    continue;
                }
                image.n_skipped += self.n_dropped.remove(&key).unwrap_or_default();
            }
            return Ok(Some(sample));
        }
    }

    fn n_other_samples_dropped(&self) -> u64 {
        self.source.n_other_samples_dropped()
    }

    fn n_restarts(&self) -> u64 {
        self.source.n_restarts()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scripted::{self, Scripted, joints};

    fn millis(millis: i64) -> Stamp {
        // These are stamps of another computer.
        Stamp(7_000_000_000_000 + millis * 1_000_000)
    }

    fn image(stamp: Stamp) -> Sample {
        Sample::Image(scripted::image(stamp))
    }

    fn playback(samples: Vec<Sample>) -> Playback {
        Playback::new(Box::new(Scripted::new(samples)))
    }

    #[test]
    fn samples_are_returned_when_due_and_keep_their_latency() {
        let mut playback = playback(vec![
            joints(millis(0)),
            joints(millis(60)),
            image(millis(20)),
            joints(millis(80)),
        ]);
        assert_eq!(playback.clock().instant_of(millis(0)), None);
        let mut returned = Vec::new();
        while let Some(sample) = playback.next_sample().expect("no error") {
            returned.push((sample.stamp(), Instant::now()));
        }
        let began = playback
            .clock()
            .instant_of(millis(0))
            .expect("it has begun");
        for ((stamp, at), due_millis) in returned.iter().zip([0, 60, 60, 80]) {
            assert!(
                *at >= began + Duration::from_millis(due_millis),
                "{stamp:?}"
            );
        }
        assert_eq!(
            returned.iter().map(|(stamp, _)| *stamp).collect::<Vec<_>>(),
            [0, 60, 20, 80].map(millis)
        );
        assert_eq!(
            playback.clock().instant_of(millis(20)),
            Some(began + Duration::from_millis(20))
        );
    }

    #[test]
    fn images_are_dropped_and_counted_if_the_caller_is_slow() {
        let mut playback = playback(vec![
            image(millis(0)),
            image(millis(10)),
            joints(millis(15)),
            image(millis(20)),
            image(millis(1_000)),
        ]);
        assert_eq!(
            playback
                .next_sample()
                .expect("no error")
                .map(|sample| sample.stamp()),
            Some(millis(0))
        );
        std::thread::sleep(Duration::from_millis(20) + 2 * MAX_DELAY);
        assert!(
            matches!(playback.next_sample(), Ok(Some(Sample::Joints(_)))),
            "joint states are kept"
        );
        match playback.next_sample() {
            Ok(Some(Sample::Image(image))) => {
                assert_eq!((image.stamp, image.n_skipped), (millis(1_000), 2))
            }
            other => panic!("{other:?}"),
        }
        assert!(matches!(playback.next_sample(), Ok(None)));
    }
}
