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

/// The time of a playback. Tests replace the time of this process, so that they do not depend on
/// the load of the computer.
trait PlaybackTime: Send {
    fn now(&self) -> Instant;
    fn sleep(&self, duration: Duration);
}

/// The time of this process.
struct ProcessTime;

impl PlaybackTime for ProcessTime {
    fn now(&self) -> Instant {
        Instant::now()
    }

    fn sleep(&self, duration: Duration) {
        std::thread::sleep(duration);
    }
}

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
    time: Box<dyn PlaybackTime>,
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
        Self::with_time(source, Box::new(ProcessTime))
    }

    fn with_time(source: Box<dyn Source>, time: Box<dyn PlaybackTime>) -> Self {
        Self {
            source,
            time,
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
        let now = self.time.now();
        self.clock.start.get_or_init(|| (stamp, now));
        let due = self
            .clock
            .instant_of(stamp)
            // A sample is never due before the samples in front of it. Times that the clock cannot
            // represent are replaced by the current time.
            .max(self.last_due)
            .unwrap_or(now);
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
            let due = self.due(sample.stamp());
            let now = self.time.now();
            let delay = now.saturating_duration_since(due);
            self.time.sleep(due.saturating_duration_since(now));
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
    use parking_lot::Mutex;

    fn millis(millis: i64) -> Stamp {
        // These are stamps of another computer.
        Stamp(7_000_000_000_000 + millis * 1_000_000)
    }

    fn image(stamp: Stamp) -> Sample {
        Sample::Image(scripted::image(stamp))
    }

    /// A time that only passes while someone sleeps. Clones share it.
    #[derive(Clone)]
    struct SimulatedTime(Arc<Mutex<Instant>>);

    impl PlaybackTime for SimulatedTime {
        fn now(&self) -> Instant {
            *self.0.lock()
        }

        fn sleep(&self, duration: Duration) {
            *self.0.lock() += duration;
        }
    }

    fn playback(samples: Vec<Sample>) -> (Playback, SimulatedTime) {
        let time = SimulatedTime(Arc::new(Mutex::new(Instant::now())));
        let source = Box::new(Scripted::new(samples));
        (Playback::with_time(source, Box::new(time.clone())), time)
    }

    #[test]
    fn samples_are_returned_when_due_and_keep_their_latency() {
        let (mut playback, time) = playback(vec![
            joints(millis(0)),
            joints(millis(60)),
            image(millis(20)),
            joints(millis(80)),
        ]);
        let began = time.now();
        assert_eq!(playback.clock().instant_of(millis(0)), None);
        let mut returned = Vec::new();
        while let Some(sample) = playback.next_sample().expect("no error") {
            returned.push((sample.stamp(), time.now() - began));
        }
        assert_eq!(
            returned,
            [(0, 0), (60, 60), (20, 60), (80, 80)]
                .map(|(stamp, at)| (millis(stamp), Duration::from_millis(at)))
        );
        assert_eq!(
            playback.clock().instant_of(millis(20)),
            Some(began + Duration::from_millis(20))
        );
    }

    #[test]
    fn playback_sleeps_until_a_sample_is_due() {
        let samples = vec![joints(millis(0)), joints(millis(30))];
        let mut playback = Playback::new(Box::new(Scripted::new(samples)));
        while playback.next_sample().expect("no error").is_some() {}
        let due = playback.clock().instant_of(millis(30));
        assert!(due.is_some_and(|due| Instant::now() >= due));
    }

    #[test]
    fn images_are_dropped_and_counted_if_the_caller_is_slow() {
        let (mut playback, time) = playback(vec![
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
        time.sleep(Duration::from_millis(20) + 2 * MAX_DELAY);
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
