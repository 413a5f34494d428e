//! Computes the time at which an image of a RealSense camera was taken, on the monotonic clock of
//! this computer.
//!
//! If metadata are available, a camera reports mid-exposure on its own clock, which is a 32-bit
//! count of microseconds. Metadata need a patched kernel module or the USB backend of the library.
//! Without metadata, only the arrival time is known. The library's conversion to "global time" is
//! switched off, because the mapping here is robust to late arrivals.

use super::{Config, Pace};
use crate::clock;
use kinematics::device_clock::WrappingMicros;
use kinematics::{ClockMap, Stamp};
use realsense_rust::frame::FrameEx;
use realsense_rust::kind::{Rs2FrameMetadata, Rs2TimestampDomain};

const NANOS_PER_MILLI: f64 = 1e6;

/// Time information of one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct FrameTime {
    /// Mid-exposure on the camera clock, microseconds.
    pub(super) mid_exposure_micros: Option<i64>,
    /// Stamp of the library, milliseconds.
    pub(super) millis: f64,
    /// Whether the stamp of the library also comes from the camera clock.
    pub(super) is_device_clock: bool,
}

impl FrameTime {
    pub(super) fn of(frame: &impl FrameEx) -> Self {
        Self {
            mid_exposure_micros: frame.metadata(Rs2FrameMetadata::SensorTimestamp),
            millis: frame.timestamp(),
            is_device_clock: frame.timestamp_domain() == Rs2TimestampDomain::HardwareClock,
        }
    }
}

/// Computes stamps for all streams of one camera, which share one clock.
#[derive(Debug)]
pub(super) struct Stamps {
    camera: String,
    /// Pace of the playback. `None` for a camera.
    pace: Option<Pace>,
    offset_nanos: i64,
    opened: Stamp,
    micros: WrappingMicros,
    map: ClockMap,
    /// Time of the first image of a file, nanoseconds, and arrival of this image.
    first: Option<(i64, Stamp)>,
    has_warned: bool,
}

impl Stamps {
    pub(super) fn new(config: &Config) -> Self {
        Self {
            camera: config.name.clone(),
            pace: config.file.is_some().then_some(config.pace),
            offset_nanos: config.clock_offset_nanos,
            opened: clock::now(),
            micros: WrappingMicros::new(),
            map: ClockMap::new(),
            first: None,
            has_warned: false,
        }
    }

    /// Stamp of an image that just arrived.
    pub(super) fn stamp(&mut self, frame_time: &FrameTime, arrival: Stamp) -> Stamp {
        let device_nanos = self.device_nanos(frame_time);
        let Some(pace) = self.pace else {
            return device_nanos.map_or(arrival, |nanos| self.map.stamp(nanos, arrival));
        };
        // A file without camera clock still has the ordered stamps of the library.
        let nanos = device_nanos.unwrap_or_else(|| nanos_of(frame_time.millis));
        match pace {
            Pace::Fast => Stamp(nanos),
            Pace::Clock => Stamp(nanos.saturating_add(self.offset_nanos)),
            Pace::RealTime => {
                let (first_nanos, started_at) = *self.first.get_or_insert((nanos, arrival));
                Stamp(
                    started_at
                        .0
                        .saturating_add(nanos.saturating_sub(first_nanos)),
                )
            }
        }
    }

    /// Whether an image is due.
    pub(super) fn is_due(&self, stamp: Stamp) -> bool {
        matches!(self.pace, None | Some(Pace::Fast)) || stamp <= clock::now()
    }

    /// Whether an image was due before the file was opened. Such images are skipped and do not
    /// count as late.
    pub(super) fn is_before_open(&self, stamp: Stamp) -> bool {
        self.pace == Some(Pace::Clock) && stamp < self.opened
    }

    /// Camera clock in nanoseconds. If the camera does not report it, returns `None` and logs this
    /// once.
    fn device_nanos(&mut self, frame_time: &FrameTime) -> Option<i64> {
        if let Some(micros) = frame_time.mid_exposure_micros {
            // Emulated cameras use 64-bit counts, which do not wrap. A count that fits into 32 bits
            // is always unwrapped. If it is a 64-bit count, it has not wrapped, so unwrapping does
            // not change it.
            let is_64_bit = micros > i64::from(u32::MAX);
            return Some(if is_64_bit {
                micros.saturating_mul(1000)
            } else {
                self.micros.nanos(low_bits(micros))
            });
        }
        let has_warned = std::mem::replace(&mut self.has_warned, true);
        let camera = &self.camera;
        if frame_time.is_device_clock {
            if !has_warned {
                log::warn!(
                    "camera {camera:?}: it does not report mid-exposure; stamps are the start of the readout"
                );
            }
            return Some(nanos_of(frame_time.millis));
        }
        if !has_warned {
            log::warn!(
                "camera {camera:?}: its images come without metadata because the kernel module uvcvideo is not patched; stamps are \
                 arrival times. Patch it with the scripts of the SDK, or use the RSUSB backend"
            );
        }
        None
    }
}

/// Counts wrap at 2^32.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "the low 32 bits are the count"
)]
fn low_bits(micros: i64) -> u32 {
    micros as u32
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "the cast saturates as intended"
)]
fn nanos_of(millis: f64) -> i64 {
    (millis * NANOS_PER_MILLI).round() as i64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stamps(pace: Option<Pace>) -> Stamps {
        Stamps {
            camera: "wrist".into(),
            pace,
            offset_nanos: 5,
            opened: Stamp(0),
            micros: WrappingMicros::new(),
            map: ClockMap::new(),
            first: None,
            has_warned: false,
        }
    }

    fn frame_time(micros: i64) -> FrameTime {
        FrameTime {
            mid_exposure_micros: Some(micros),
            millis: 0.0,
            is_device_clock: true,
        }
    }

    #[test]
    fn camera_clock_is_mapped_across_wraparound() {
        let mut stamps = stamps(None);
        let begin = i64::from(u32::MAX) - 500_000;
        for image in 0..100_i64 {
            let since_micros = image * 33_333;
            // The difference is negative if mid-exposure is before the wrap and the readout after
            // it.
            let wrapped = (begin + since_micros) % (1 << 32);
            let micros = if wrapped < 20_000 {
                wrapped - (1 << 32)
            } else {
                wrapped
            };
            let late_nanos = 5_000_000 + (image % 7) * 3_000_000;
            let arrival = Stamp(since_micros * 1000 + late_nanos);
            let error_nanos = stamps.stamp(&frame_time(micros), arrival).0 - since_micros * 1000;
            // The minimum latency cannot be observed, but jitter must be removed.
            assert!(
                (error_nanos - 5_000_000).abs() < 200_000,
                "image {image}: {error_nanos}"
            );
        }
    }

    #[test]
    fn file_stamps_follow_pace() {
        let later = 123_456;
        for (pace, expected) in [
            (Pace::Fast, [7_000_000_000, 7_123_456_000]),
            (Pace::Clock, [7_000_000_005, 7_123_456_005]),
            (Pace::RealTime, [99, 99 + 123_456_000]),
        ] {
            let mut stamps = stamps(Some(pace));
            let got = [(0, 99), (later, 5_000)].map(|(since_micros, arrival)| {
                stamps
                    .stamp(&frame_time(7_000_000 + since_micros), Stamp(arrival))
                    .0
            });
            assert_eq!(got, expected, "{pace:?}");
            assert_eq!(stamps.is_due(Stamp(i64::MAX)), pace == Pace::Fast);
        }
        // Counts of an emulated camera do not wrap.
        let mut emulated_clock = stamps(Some(Pace::Fast));
        let wrap = i64::from(u32::MAX);
        let got = [wrap - 1, wrap + 1, wrap + 3]
            .map(|micros| emulated_clock.stamp(&frame_time(micros), Stamp(0)).0 / 1000);
        assert_eq!(got, [wrap - 1, wrap + 1, wrap + 3]);
    }

    #[test]
    fn without_metadata_library_stamp_or_arrival_is_used() {
        let plain = |is_device_clock| FrameTime {
            mid_exposure_micros: None,
            millis: 12.5,
            is_device_clock,
        };
        assert_eq!(stamps(None).stamp(&plain(false), Stamp(77)), Stamp(77));
        let mut live = stamps(None);
        live.stamp(&plain(true), Stamp(1_000));
        let later = FrameTime {
            millis: 22.5,
            ..plain(true)
        };
        assert_eq!(live.stamp(&later, Stamp(90_000_000)), Stamp(10_001_000));
        assert_eq!(
            stamps(Some(Pace::Fast)).stamp(&plain(false), Stamp(77)),
            Stamp(12_500_000)
        );
    }
}
