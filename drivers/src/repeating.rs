//! Repeats a recording without end.

use crate::{Error, Sample, Source};
use kinematics::Stamp;

/// Time between the last sample of a round and the first of the next one. It is longer than the
/// time within which range scans are used for the depth of an image.
const PAUSE_NANOS: i64 = 1_100_000_000;

/// A source that starts again from its beginning whenever it ends.
///
/// Stamps continue to increase: those of each round are shifted by the length of the rounds before
/// it. At the beginning of a round, the robot jumps back to its first pose (see
/// [`Source::n_restarts`]).
pub struct Repeating<Reopen> {
    source: Box<dyn Source>,
    reopen: Reopen,
    /// Nanoseconds added to the stamps of this round.
    offset_nanos: i64,
    /// The earliest and latest stamp of this round, without the offset.
    span: Option<[Stamp; 2]>,
    /// Whether this round has an image. A recording without images is not repeated, because a run
    /// would never begin.
    has_image: bool,
    n_restarts: u64,
}

impl<Reopen: FnMut() -> Result<Box<dyn Source>, Error> + Send> Repeating<Reopen> {
    /// Repeats `source`. `reopen` reopens it at its first sample.
    pub fn new(source: Box<dyn Source>, reopen: Reopen) -> Self {
        Self {
            source,
            reopen,
            offset_nanos: 0,
            span: None,
            has_image: false,
            n_restarts: 0,
        }
    }
}

impl<Reopen: FnMut() -> Result<Box<dyn Source>, Error> + Send> Source for Repeating<Reopen> {
    /// Returns `None` only if a round has no images.
    fn next_sample(&mut self) -> Result<Option<Sample>, Error> {
        loop {
            // Samples are in stamp order only as far as devices allow, so the first and last one
            // are not necessarily the earliest and latest.
            if let Some(mut sample) = self.source.next_sample()? {
                let stamp = sample.stamp();
                let [earliest, latest] = self.span.unwrap_or([stamp; 2]);
                self.span = Some([earliest.min(stamp), latest.max(stamp)]);
                self.has_image |= matches!(sample, Sample::Image(_));
                sample.shift(self.offset_nanos);
                return Ok(Some(sample));
            }
            let Some([earliest, latest]) = self.span.take().filter(|_| self.has_image) else {
                return Ok(None);
            };
            self.has_image = false;
            // The source is reopened before the offset changes. The stamps of this source therefore
            // stay consistent if reopening fails.
            self.source = (self.reopen)()?;
            let round_nanos = latest.nanos_since(earliest).saturating_add(PAUSE_NANOS);
            self.offset_nanos = self.offset_nanos.saturating_add(round_nanos);
            self.n_restarts += 1;
        }
    }

    fn n_other_samples_dropped(&self) -> u64 {
        self.source.n_other_samples_dropped()
    }

    fn n_restarts(&self) -> u64 {
        self.n_restarts
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scripted::{Scripted, image, joints};
    use crate::{RangeScan, TruthImage};
    use kinematics::Transform;

    fn repeating(samples: Vec<Sample>) -> impl Source {
        let open = move || -> Result<Box<dyn Source>, Error> {
            Ok(Box::new(Scripted::new(samples.clone())))
        };
        Repeating::new(open().expect("scripted"), open)
    }

    #[test]
    fn all_samples_are_shifted_by_the_length_of_earlier_rounds() {
        let image = image(Stamp(40));
        let truth = TruthImage {
            image: image.clone(),
            depth_m: [].into(),
            world_from_camera: Transform::identity(),
            psnr_ceiling: None,
        };
        let scan = RangeScan {
            scanner: "lidar".into(),
            stamp: Stamp(90),
            points: [].into(),
        };
        // The image arrives after a joint state with a later stamp.
        let round = vec![
            joints(Stamp(50)),
            Sample::Image(image),
            Sample::Truth(truth),
            Sample::Range(scan),
            joints(Stamp(100)),
        ];
        let mut source = repeating(round);
        let mut stamps = Vec::new();
        for n_restarts in 0..3 {
            for _ in 0..5 {
                stamps.push(
                    source
                        .next_sample()
                        .expect("no error")
                        .expect("repeated")
                        .stamp()
                        .0,
                );
                assert_eq!(source.n_restarts(), n_restarts);
            }
        }
        let round = |offset: i64| [50, 40, 40, 90, 100].map(|nanos| nanos + offset);
        let length = 60 + PAUSE_NANOS;
        assert_eq!(
            stamps,
            [round(0), round(length), round(2 * length)].concat()
        );
    }

    #[test]
    fn sources_without_images_and_failures_end_the_repetition() {
        assert!(matches!(repeating(Vec::new()).next_sample(), Ok(None)));
        let mut without_images = repeating(vec![joints(Stamp(0))]);
        assert!(matches!(without_images.next_sample(), Ok(Some(_))));
        assert!(matches!(without_images.next_sample(), Ok(None)));
        let reopen = || {
            Err(Error::Ended {
                camera: "wrist".to_owned(),
            })
        };
        let mut failing = Repeating::new(
            Box::new(Scripted::new(vec![Sample::Image(image(Stamp(0)))])),
            reopen,
        );
        assert!(matches!(failing.next_sample(), Ok(Some(_))));
        assert!(failing.next_sample().is_err());
    }
}
