//! Memory of this process over time, and the growth rate of this memory after the keyframe store is
//! full.

use crate::statistics::theil_sen;
use crate::viewer::ReceivedPicture;
use anyhow::{Context, Result, anyhow};
use numbers::quantile::median;
use serde::Serialize;

/// Time to ignore after the keyframe store is full, while buffers reach their final size.
const SETTLE_SECS: f64 = 60.0;
/// Minimum time over which a rate is measured. Over a shorter time, a rate per hour is mostly noise
/// of the allocator.
const MIN_SPAN_SECS: f64 = 60.0;
/// Maximum number of samples from which a rate is estimated. If there are more samples, they are
/// reduced to the medians of at most this many groups. The reason is that the estimate compares all
/// pairs, and 400 samples already have 80 thousand pairs.
const MAX_GROUPS: usize = 400;
const SECS_PER_HOUR: f64 = 3600.0;
const BYTES_PER_MB: f64 = 1e6;

/// Memory use at one time, bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Sample {
    /// Time since the first image.
    pub seconds: f64,
    /// Resident memory of the process. On a software adapter, it includes GPU memory.
    pub resident_bytes: u64,
    /// GPU buffers in use.
    pub gpu_bytes: u64,
    /// Memory that the GPU allocator reserves for GPU buffers, if the backend reports it.
    pub gpu_reserved_bytes: Option<u64>,
    /// Size of the models, included in `gpu_bytes`.
    pub model_bytes: u64,
    /// Images of keyframes on the GPU. They are also included in `gpu_bytes`.
    pub gpu_image_bytes: u64,
    /// Host memory of the keyframes.
    pub keyframe_bytes: u64,
    /// Number of keyframes.
    pub keyframes: usize,
    /// Keyframes evicted so far.
    pub evicted: u64,
    /// Number of optimizer steps.
    pub step: u64,
    /// Number of connected viewers.
    pub viewers: usize,
    /// Number of pictures that the viewers received.
    pub pictures: u64,
}

impl Sample {
    /// The sample in one line.
    #[must_use]
    pub fn summary(&self) -> String {
        let mb = |bytes: u64| bytes as f64 / BYTES_PER_MB;
        format!(
            "{:7.1} s  {:8.1} MB resident  {:8.1} MB on the GPU  {:7.1} MB model  {:8.1} MB in {} keyframes, step {}",
            self.seconds,
            mb(self.resident_bytes),
            mb(self.gpu_bytes),
            mb(self.model_bytes),
            mb(self.keyframe_bytes),
            self.keyframes,
            self.step,
        )
    }
}

/// Part of the resident memory that is excluded from the growth rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Excluded {
    /// Nothing is excluded, because GPU buffers are in separate memory.
    Nothing,
    /// The models.
    Model,
    /// The models and the working memory of training, whose size grows with the models.
    Training,
}

impl Excluded {
    /// Resident memory without the excluded part and without the picture timings that the viewers
    /// of a benchmark store.
    pub(crate) fn bytes(self, sample: &Sample) -> f64 {
        let excluded_bytes = match self {
            Self::Nothing => 0,
            Self::Model => sample.model_bytes,
            Self::Training => sample.gpu_bytes.saturating_sub(sample.gpu_image_bytes),
        };
        // The viewers of a bench run in the measured process, and store the times of every picture.
        let times_bytes = sample.pictures * size_of::<ReceivedPicture>() as u64;
        sample.resident_bytes as f64 - (excluded_bytes + times_bytes) as f64
    }
}

/// Growth rate of memory once the keyframe store is full.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Growth {
    /// Whether the store was full. If it was not, the second half of the run is measured.
    pub store_was_full: bool,
    /// Start of the measurement, seconds since the first image.
    pub from_seconds: f64,
    /// End of the measurement, seconds since the first image.
    pub to_seconds: f64,
    /// Median resident memory in that time.
    pub resident_bytes: f64,
    /// Theil-Sen estimate, which is the median of the rates of change between all pairs of samples.
    pub bytes_per_hour: f64,
    /// The rate as a percentage of `resident_bytes`.
    pub percent_per_hour: f64,
}

impl Growth {
    /// Returns `None` if less than a minute of samples can be used.
    #[must_use]
    pub fn of(samples: &[Sample], excluded: Excluded) -> Option<Self> {
        // Until the store is full, keyframes are added and memory grows as intended.
        let full_at = samples
            .iter()
            .find(|sample| sample.evicted > 0)
            .map(|sample| sample.seconds + SETTLE_SECS);
        let last = samples.last()?;
        let from_seconds = full_at.unwrap_or(0.5 * last.seconds);
        let counted: Vec<&Sample> = samples
            .iter()
            .filter(|sample| sample.seconds >= from_seconds)
            .collect();
        if last.seconds - counted.first()?.seconds < MIN_SPAN_SECS {
            return None;
        }
        let groups: Vec<(f64, f64)> = counted
            .chunks(counted.len().div_ceil(MAX_GROUPS))
            .filter_map(|group| medians(group, excluded))
            .collect();
        let resident: Vec<f64> = counted
            .iter()
            .map(|sample| sample.resident_bytes as f64)
            .collect();
        let resident_bytes = median(&resident)?;
        let bytes_per_hour = theil_sen(&groups)? * SECS_PER_HOUR;
        Some(Self {
            store_was_full: full_at.is_some(),
            from_seconds: counted.first()?.seconds,
            to_seconds: last.seconds,
            resident_bytes,
            bytes_per_hour,
            percent_per_hour: 100.0 * bytes_per_hour / resident_bytes,
        })
    }
}

/// Median time and median memory of a group of samples.
fn medians(group: &[&Sample], excluded: Excluded) -> Option<(f64, f64)> {
    let seconds: Vec<f64> = group.iter().map(|sample| sample.seconds).collect();
    let bytes: Vec<f64> = group.iter().map(|sample| excluded.bytes(sample)).collect();
    median(&seconds).zip(median(&bytes))
}

/// Current and peak resident memory of this process, bytes.
///
/// # Errors
///
/// Fails if the system does not report the resident memory. Only Linux reports it.
pub fn resident_bytes() -> Result<(u64, u64)> {
    const STATUS: &str = "/proc/self/status";
    let status = std::fs::read_to_string(STATUS).with_context(|| {
        format!("cannot read {STATUS}: resident memory is measured on Linux only")
    })?;
    let now = kilobytes(&status, "VmRSS:").ok_or_else(|| anyhow!("{STATUS} has no line VmRSS"))?;
    let peak = kilobytes(&status, "VmHWM:").ok_or_else(|| anyhow!("{STATUS} has no line VmHWM"))?;
    Ok((now << 10, peak << 10))
}

fn kilobytes(status: &str, name: &str) -> Option<u64> {
    status
        .lines()
        .find_map(|line| line.strip_prefix(name))?
        .trim()
        .strip_suffix("kB")?
        .trim()
        .parse()
        .ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Samples of a run whose store is full after 100 s, with `bytes` as a function of the seconds.
    fn samples(n: u32, bytes: impl Fn(f64) -> f64) -> Vec<Sample> {
        let sample = |ix: u32| {
            let seconds = f64::from(ix);
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "small numbers"
            )]
            let resident_bytes = bytes(seconds) as u64;
            Sample {
                seconds,
                resident_bytes,
                evicted: u64::from(ix >= 100),
                ..Sample::default()
            }
        };
        (0..n).map(sample).collect()
    }

    #[test]
    fn growth_starts_at_full_store_and_ignores_jumps() {
        let growing = |seconds: f64| {
            let jump = if (1000.0..1010.0).contains(&seconds) {
                5e8
            } else {
                0.0
            };
            if seconds < 150.0 {
                1e7 * seconds
            } else {
                2e9 + 1e8 * seconds / 3600.0 + jump
            }
        };
        let growth = Growth::of(&samples(3600, growing), Excluded::Model).expect("an hour");
        assert!(
            growth.store_was_full && growth.from_seconds == 160.0 && growth.to_seconds == 3599.0,
            "{growth:?}"
        );
        assert!((growth.bytes_per_hour - 1e8).abs() < 1e6, "{growth:?}");
        assert!((growth.percent_per_hour - 4.9).abs() < 0.1, "{growth:?}");
    }

    #[test]
    fn model_and_training_bytes_are_excluded_from_growth() {
        let mut with_model = samples(600, |seconds| 1e9 + 1e6 * seconds);
        for sample in &mut with_model {
            sample.model_bytes = sample.resident_bytes - 1_000_000_000;
        }
        let rate = |samples: &[Sample], excluded| {
            Growth::of(samples, excluded)
                .expect("long enough")
                .bytes_per_hour
        };
        assert!(rate(&with_model, Excluded::Model).abs() < 1.0);
        assert!((rate(&with_model, Excluded::Nothing) - 3.6e9).abs() < 1e6);
        for sample in &mut with_model {
            (sample.gpu_bytes, sample.model_bytes) = (sample.model_bytes + 5_000_000, 0);
            sample.gpu_image_bytes = 5_000_000;
        }
        assert!(rate(&with_model, Excluded::Training).abs() < 1.0);
    }

    #[test]
    fn growth_uses_second_half_if_store_never_fills() {
        let mut never_full = samples(400, |_| 1e9);
        never_full.iter_mut().for_each(|sample| sample.evicted = 0);
        let growth = Growth::of(&never_full, Excluded::Model).expect("long enough");
        assert!(
            !growth.store_was_full && growth.from_seconds == 200.0,
            "{growth:?}"
        );
        assert_eq!(
            Growth::of(&samples(200, |_| 1e9), Excluded::Model),
            None,
            "only 40 s of samples after the settling time"
        );
        assert_eq!(Growth::of(&[], Excluded::Model), None);
    }

    #[test]
    fn resident_memory_is_read() {
        let (before, _) = resident_bytes().expect("Linux");
        // This is far more memory than concurrent tests free at the same time.
        let held = vec![1u8; 512 << 20];
        let (now, peak) = resident_bytes().expect("Linux");
        assert!(
            now >= before + (384 << 20) && peak >= now,
            "{before} {now} {peak} {}",
            held.len()
        );
        assert_eq!(
            kilobytes("VmHWM:\t  2048 kB\nVmRSS:\t  1024 kB\n", "VmRSS:"),
            Some(1024)
        );
        assert_eq!(kilobytes("VmRSS: some", "VmRSS:"), None);
    }
}
