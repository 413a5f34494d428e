//! Latency, accuracy, training speed and memory of a live run over time, and how they change per
//! hour.

use crate::growth::Excluded;
use crate::memory;
use crate::statistics::theil_sen;
use crate::viewer::{ReceivedPicture, Viewer};
use gpu::Gpu;
use numbers::quantile::median;
use report::chart::{Line, Point};
use serde::Serialize;
use session::LiveLoop;
use std::time::{Duration, Instant};

/// Time between two samples.
const SAMPLE_PERIOD: Duration = Duration::from_secs(1);
/// Maximum number of time buckets. A run of an hour then has one bucket per minute. The median of
/// such a bucket is not affected by single slow pictures.
const MAX_BUCKETS: usize = 60;
/// Minimum duration of a run for trends, measured at its last sample. In a shorter run, the second
/// half is too short for a rate per hour. The limit is slightly below two minutes, because the last
/// sample of a run of two minutes is a little earlier than its end.
const MIN_SECS: f64 = 115.0;
const SECS_PER_HOUR: f64 = 3600.0;
const BYTES_PER_MB: f64 = 1e6;

/// Samples of a live run, one per second.
#[derive(Debug, Default)]
pub struct Timeline {
    moments: Vec<Moment>,
}

#[derive(Clone, Copy, Debug)]
struct Moment {
    at: Instant,
    seconds: f64,
    step: u64,
    psnr: Option<f64>,
    /// Resident memory. `None` if the system does not report it.
    host_bytes: Option<f64>,
}

impl Timeline {
    /// Samples a run in progress if a second has passed since the last sample.
    pub fn sample(&mut self, live: &LiveLoop, gpu: &Gpu, viewers: &[Viewer]) {
        let at = Instant::now();
        let session = &live.sessions()[0];
        let seconds = session.time().secs();
        let is_due = self
            .moments
            .last()
            .is_none_or(|last| at - last.at >= SAMPLE_PERIOD);
        // Before the first image, the training time is 0.
        if is_due && seconds > 0.0 {
            // On a software adapter, the model and its working memory are in host memory, too.
            let excluded = if gpu.is_software() {
                Excluded::Training
            } else {
                Excluded::Nothing
            };
            let host_bytes = memory::sample(live, gpu, viewers)
                .ok()
                .map(|(sample, _)| excluded.bytes(&sample));
            self.moments.push(Moment {
                at,
                seconds,
                step: session.progress().step,
                psnr: session.scoreboard().psnr(),
                host_bytes,
            });
        }
    }

    /// Divides the run into buckets and measures how the second half changes.
    ///
    /// * `pictures`: the pictures of each viewer.
    pub(crate) fn over_time(&self, pictures: &[Vec<ReceivedPicture>]) -> OverTime {
        // The pictures of all viewers are in one list, ordered by time. The pictures of a bucket
        // are therefore a range of this list.
        let mut received: Vec<(Instant, f64)> = pictures
            .iter()
            .flatten()
            .map(|picture| {
                (
                    picture.complete,
                    (picture.complete - picture.requested).as_secs_f64() * 1e3,
                )
            })
            .collect();
        received.sort_by_key(|(complete, _)| *complete);
        let last_ix = self.moments.len().saturating_sub(1);
        let n_each = last_ix.div_ceil(MAX_BUCKETS).max(1);
        // Neighboring buckets share the moment between them, because rates need both ends of a
        // bucket.
        let buckets: Vec<Bucket> = (0..last_ix)
            .step_by(n_each)
            .map(|from_ix| {
                let moments = &self.moments[from_ix..=last_ix.min(from_ix + n_each)];
                Bucket::of(moments, &received)
            })
            .collect();
        let last_secs = self.moments.last().map_or(0.0, |last| last.seconds);
        // The first half is the time in which the model and the buffers grow.
        let mut trends = Vec::new();
        if last_secs >= MIN_SECS {
            for quantity in &QUANTITIES {
                let mut points = quantity.points(&buckets);
                points.retain(|(seconds, _)| *seconds >= 0.5 * last_secs);
                trends.extend(Trend::of(&points).map(|trend| (quantity.name, trend)));
            }
        }
        OverTime { buckets, trends }
    }
}

/// Medians over one interval of a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Bucket {
    /// Middle of the interval, seconds of training.
    pub seconds: f64,
    /// Time from a request to the complete picture, milliseconds. `None` without pictures.
    pub picture_millis: Option<f64>,
    /// Mean of the latest PSNR of all test images, dB. `None` before the first score.
    pub psnr: Option<f64>,
    /// Training steps per second.
    pub steps_per_sec: f64,
    /// Resident memory without the picture timings that the viewers of a benchmark store. On a
    /// software adapter, it also excludes the buffers of training. `None` if the system does not
    /// report the resident memory.
    pub host_mb: Option<f64>,
}

impl Bucket {
    /// * `received`: times and durations (milliseconds) of pictures, ordered by time.
    fn of(moments: &[Moment], received: &[(Instant, f64)]) -> Self {
        let from = moments[0];
        let to = moments[moments.len() - 1];
        let [first, end] = [from, to]
            .map(|moment| received.partition_point(|(complete, _)| *complete < moment.at));
        let millis: Vec<f64> = received[first..end]
            .iter()
            .map(|(_, millis)| *millis)
            .collect();
        let median_of = |value: fn(&Moment) -> Option<f64>| {
            median(&moments.iter().filter_map(value).collect::<Vec<f64>>())
        };
        let elapsed_secs = (to.at - from.at).as_secs_f64();
        Self {
            seconds: 0.5 * (from.seconds + to.seconds),
            picture_millis: median(&millis),
            psnr: median_of(|moment| moment.psnr),
            // A rejected trial restores an earlier step, so the difference may be negative.
            steps_per_sec: to.step.saturating_sub(from.step) as f64 / elapsed_secs.max(1e-9),
            host_mb: median_of(|moment| moment.host_bytes).map(|bytes| bytes / BYTES_PER_MB),
        }
    }
}

/// Median and change of a quantity in the second half of a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Trend {
    /// Median over the buckets.
    pub median: f64,
    /// Theil-Sen estimate, which is the median of the rates of change between all pairs of buckets.
    pub per_hour: f64,
    /// The rate as a percentage of the median.
    pub percent_per_hour: f64,
}

impl Trend {
    /// `None` for fewer than two buckets.
    fn of(points: &[(f64, f64)]) -> Option<Self> {
        let median = median(&points.iter().map(|(_, value)| *value).collect::<Vec<_>>())?;
        let per_hour = theil_sen(points)? * SECS_PER_HOUR;
        Some(Self {
            median,
            per_hour,
            percent_per_hour: 100.0 * per_hour / median,
        })
    }
}

/// A live run over time.
#[derive(Clone, Debug, Default, Serialize)]
pub struct OverTime {
    /// Consecutive intervals, at most 60.
    pub buckets: Vec<Bucket>,
    /// Trends of the second half by name. The list is empty if the run took less than two minutes.
    pub trends: Vec<(&'static str, Trend)>,
}

struct Quantity {
    name: &'static str,
    n_decimals: usize,
    value: fn(&Bucket) -> Option<f64>,
}

const QUANTITIES: [Quantity; 4] = [
    Quantity {
        name: "request to complete picture, ms",
        n_decimals: 1,
        value: |bucket| bucket.picture_millis,
    },
    Quantity {
        name: "test PSNR, dB",
        n_decimals: 2,
        value: |bucket| bucket.psnr,
    },
    Quantity {
        name: "training steps per second",
        n_decimals: 1,
        value: |bucket| Some(bucket.steps_per_sec),
    },
    Quantity {
        name: "host memory, MB",
        n_decimals: 1,
        value: |bucket| bucket.host_mb,
    },
];

impl Quantity {
    /// Seconds and values.
    fn points(&self, buckets: &[Bucket]) -> Vec<(f64, f64)> {
        buckets
            .iter()
            .filter_map(|bucket| Some((bucket.seconds, (self.value)(bucket)?)))
            .collect()
    }
}

impl OverTime {
    /// Rows of a table, each with a quantity and its median and change in each of the runs. There
    /// are no rows if all runs are short.
    pub(crate) fn rows(runs: &[&Self]) -> Vec<Vec<String>> {
        let mut rows = Vec::new();
        for quantity in &QUANTITIES {
            let cells: Vec<Option<String>> = runs.iter().map(|run| run.cell(quantity)).collect();
            // A run without viewers has no times of pictures.
            if cells.iter().any(Option::is_some) {
                let cells = cells.into_iter().map(Option::unwrap_or_default);
                rows.push(
                    std::iter::once(quantity.name.to_owned())
                        .chain(cells)
                        .collect(),
                );
            }
        }
        rows
    }

    /// Median and change of a quantity as text. `None` if they are unknown.
    fn cell(&self, quantity: &Quantity) -> Option<String> {
        let n_decimals = quantity.n_decimals;
        let (_, trend) = self
            .trends
            .iter()
            .find(|(known, _)| *known == quantity.name)?;
        let Trend {
            median,
            per_hour,
            percent_per_hour,
        } = trend;
        Some(format!(
            "{median:.n_decimals$}, {per_hour:+.n_decimals$} per hour ({percent_per_hour:+.1} %)"
        ))
    }

    /// Each quantity as a percentage of its median in the second half, over minutes.
    pub(crate) fn lines(&self) -> Vec<Line> {
        self.trends
            .iter()
            .filter_map(|(name, trend)| self.line(name, trend))
            .collect()
    }

    /// The line of one quantity. `None` for an unknown name.
    fn line(&self, name: &str, trend: &Trend) -> Option<Line> {
        let quantity = QUANTITIES.iter().find(|quantity| quantity.name == name)?;
        // The unit at the end of the name does not apply to percentages.
        let label = name.split_once(',').map_or(name, |(label, _)| label);
        let point = |(seconds, value): (f64, f64)| percent_point(seconds, value, trend.median);
        Some(Line {
            label: label.to_owned(),
            points: quantity
                .points(&self.buckets)
                .into_iter()
                .map(point)
                .collect(),
            is_peer: false,
        })
    }
}

/// A value as a percentage of a median, over minutes.
fn percent_point(seconds: f64, value: f64, median: f64) -> Point {
    let y = 100.0 * value / median;
    Point {
        x: seconds / 60.0,
        y,
        low: y,
        high: y,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A run of `n` seconds whose memory grows by 36 MB per hour. It has ten pictures per second,
    /// which take 20 ms at the start and 10 ms more per hour.
    fn over_time(n: u32) -> OverTime {
        let began = Instant::now();
        let moment = |ix: u32| Moment {
            at: began + Duration::from_secs(ix.into()),
            seconds: f64::from(ix),
            step: 50 * u64::from(ix),
            psnr: (ix >= 10).then_some(30.0),
            host_bytes: Some(1e9 + 1e4 * f64::from(ix)),
        };
        let picture = |ix: u32| {
            let complete = began + Duration::from_millis(100 * u64::from(ix) + 50);
            let millis = 20.0 + f64::from(ix) / 36_000.0 * 10.0;
            let requested = complete - Duration::from_secs_f64(1e-3 * millis);
            ReceivedPicture {
                requested,
                first_stage: complete,
                complete,
                waited_millis: 0.0,
                render_millis: 0.0,
                encode_millis: 0.0,
                n_keyframes: 0,
            }
        };
        // The first picture is requested before the first sample.
        let pictures: Vec<ReceivedPicture> = (1..10 * n).map(picture).collect();
        Timeline {
            moments: (0..=n).map(moment).collect(),
        }
        .over_time(&[pictures])
    }

    #[test]
    fn trends_are_those_of_the_second_half() {
        let run = over_time(540);
        assert_eq!(run.buckets.len(), MAX_BUCKETS);
        let trend = |name: &str| {
            run.trends
                .iter()
                .find(|(known, _)| known.starts_with(name))
                .expect("measured")
                .1
        };
        assert!(
            (trend("request").per_hour - 10.0).abs() < 0.1,
            "{:?}",
            trend("request")
        );
        assert!(
            (trend("request").median - 21.1).abs() < 0.1,
            "{:?}",
            trend("request")
        );
        assert_eq!(
            (trend("test PSNR").median, trend("test PSNR").per_hour),
            (30.0, 0.0)
        );
        assert!(
            (trend("training").median - 50.0).abs() < 1e-9
                && trend("training").per_hour.abs() < 1e-6
        );
        assert!(
            (trend("host memory").per_hour - 36.0).abs() < 0.1,
            "{:?}",
            trend("host memory")
        );
        let rows = OverTime::rows(&[&run, &over_time(20)]);
        assert_eq!(
            rows[1],
            ["test PSNR, dB", "30.00, +0.00 per hour (+0.0 %)", ""]
        );
        assert_eq!((rows.len(), run.lines().len()), (4, 4));
        assert_eq!(run.lines()[3].label, "host memory");
        assert!(run.buckets[0].psnr.is_none() && run.buckets[1].psnr.is_some());
    }

    #[test]
    fn short_runs_have_buckets_but_no_trends() {
        for n_secs in [0, 1, 90] {
            let run = over_time(n_secs);
            assert_eq!(run.buckets.is_empty(), n_secs == 0);
            assert!(
                run.trends.is_empty()
                    && run.lines().is_empty()
                    && OverTime::rows(&[&run]).is_empty()
            );
        }
        assert_eq!(over_time(120).trends.len(), 4);
    }
}
