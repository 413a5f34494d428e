//! Maps the clock of a device to the host clock, using the arrival times of messages.

use crate::Stamp;
use std::collections::VecDeque;

/// Maps stamps of one device's clock to the host's monotonic clock.
///
/// Every message arrives at `device * (1 + drift) + offset + latency`. The latency has a fixed
/// minimum and is often much larger. All arrivals therefore lie above a line. The map is the line
/// below all arrivals that is closest to them. It is the edge of the lower convex hull at the mean
/// device time (Moon, Skelly and Towsley 1999, section 4). Late arrivals do not move the line. The
/// minimum latency cannot be observed and remains in the result. Calibration estimates it.
#[derive(Clone, Debug)]
pub struct ClockMap {
    /// Device stamp and arrival of the first message since the start or the last restart. Device
    /// times are relative to this stamp.
    origin: Option<Origin>,
    /// For each bucket of device time, the message with the smallest delay.
    buckets: VecDeque<Bucket>,
    line: Line,
    newest_nanos: i64,
    late_since_nanos: Option<i64>,
    n_restarts: u64,
}

#[derive(Clone, Copy, Debug)]
struct Origin {
    device_nanos: i64,
    arrival: Stamp,
}

#[derive(Clone, Copy, Debug)]
struct Bucket {
    index: i64,
    /// Seconds of device time since the origin.
    device_secs: f64,
    /// Arrival time minus device time, minus the same difference at the origin, seconds.
    delay_secs: f64,
}

/// `delay = offset + drift * device`, seconds since the origin.
#[derive(Clone, Copy, Debug, Default)]
struct Line {
    offset_secs: f64,
    drift: f64,
}

/// Each bucket keeps one arrival. Longer buckets take less memory and time, but have fewer points
/// near the line. Shorter buckets keep more late arrivals, which never touch the line.
const BUCKET_NANOS: i64 = 250_000_000;
/// Older arrivals are discarded, so that the map follows a drift that changes with temperature. A
/// longer window averages the latency of more messages. A shorter window follows changes of
/// temperature faster. With [`BUCKET_NANOS`], the window has at most 481 buckets.
const WINDOW_SECS: f64 = 120.0;
/// Maximum drift. The drift of all common crystals is smaller. Steeper slopes are caused by
/// latency.
const MAX_DRIFT: f64 = 200e-6;
/// Observed time span at which the estimated drift is applied in full. For shorter spans, a
/// proportional part is applied, because latency looks like drift over short spans.
const FULL_DRIFT_SECS: f64 = 80.0;
/// If a device stamp is earlier than the newest one by more than this, the clock has restarted.
/// Smaller steps back come from reordered messages.
const MAX_DISORDER_NANOS: i64 = 500_000_000;
/// If a message arrives earlier than the line by more than this, in seconds, the device clock has
/// jumped ahead. Smaller differences need no restart, because the line follows early arrivals at
/// once. They also occur when the latency of a connection decreases.
const MAX_EARLY_SECS: f64 = 0.25;
/// If all arrivals within [`MAX_LATE_NANOS`] are late by more than this, in seconds, the device
/// clock has jumped back a little or was paused. A congested network also delays messages, but it
/// rarely delays every single message by this much.
const MAX_LATE_SECS: f64 = 1.0;
/// How long arrivals must be late before the clock counts as restarted. A blocked connection, whose
/// messages arrive late together, should recover within this time.
const MAX_LATE_NANOS: i64 = 3_000_000_000;

const NANOS_PER_SEC: f64 = 1e9;

impl Default for ClockMap {
    fn default() -> Self {
        Self::new()
    }
}

impl ClockMap {
    /// Creates a map without observations.
    pub fn new() -> Self {
        Self {
            origin: None,
            buckets: VecDeque::new(),
            line: Line::default(),
            newest_nanos: i64::MIN,
            late_since_nanos: None,
            n_restarts: 0,
        }
    }

    /// Adds one message: its device stamp and its arrival time.
    pub fn observe(&mut self, device_nanos: i64, arrival: Stamp) {
        let Some(origin) = self.origin else {
            return self.start(device_nanos, arrival);
        };
        // A device that restarts counts from zero again. Its old line does not apply to the new
        // clock.
        if device_nanos < self.newest_nanos.saturating_sub(MAX_DISORDER_NANOS) {
            return self.restart(device_nanos, arrival);
        }
        self.newest_nanos = self.newest_nanos.max(device_nanos);
        // A delay is the difference of two absolute times. The difference is taken in integers
        // before the conversion to f64, because nanoseconds since 1970 have a resolution of only
        // 256 ns in f64.
        let since_nanos = device_nanos.saturating_sub(origin.device_nanos);
        let device_secs = since_nanos as f64 / NANOS_PER_SEC;
        let delay_secs = arrival
            .nanos_since(origin.arrival)
            .saturating_sub(since_nanos) as f64
            / NANOS_PER_SEC;
        let lateness_secs = delay_secs - self.line.at(device_secs);
        // The first arrival may have had any latency, so early arrivals are checked only after a
        // line has formed.
        let has_line = self.buckets.len() > 4;
        if has_line && lateness_secs < -MAX_EARLY_SECS {
            return self.restart(device_nanos, arrival);
        }
        // The line follows early arrivals at once, but it never follows late arrivals. If the clock
        // jumped back, all stamps would therefore be too early until the old arrivals have left the
        // window.
        if self.late_for_too_long(lateness_secs, arrival) {
            return self.restart(device_nanos, arrival);
        }
        if self.insert(Bucket {
            index: since_nanos.div_euclid(BUCKET_NANOS),
            device_secs,
            delay_secs,
        }) {
            self.line = self.fit();
        }
    }

    /// Converts a device stamp to host time. Returns `None` before the first message.
    ///
    /// The result includes the minimum latency of the connection. Once a faster message has
    /// arrived, stamps may map to slightly earlier times. Two stamps that are close together can
    /// therefore change order while there are few observations.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "a float to integer cast saturates"
    )]
    pub fn map(&self, device_nanos: i64) -> Option<Stamp> {
        let origin = self.origin?;
        let since_nanos = device_nanos.saturating_sub(origin.device_nanos);
        let delay_nanos = self.line.at(since_nanos as f64 / NANOS_PER_SEC) * NANOS_PER_SEC;
        let mapped = origin
            .arrival
            .0
            .saturating_add(since_nanos)
            .saturating_add(delay_nanos.round() as i64);
        Some(Stamp(mapped))
    }

    /// Adds one message and returns its host time, which is never later than its arrival.
    pub fn stamp(&mut self, device_nanos: i64, arrival: Stamp) -> Stamp {
        self.observe(device_nanos, arrival);
        self.map(device_nanos)
            // A message cannot have been sent after it arrived.
            .map_or(arrival, |mapped| mapped.min(arrival))
    }

    /// Relative difference of the clock rates. It is positive if the host clock runs faster than
    /// the device clock. A value of 1e-6 is one part per million.
    pub fn drift(&self) -> f64 {
        self.line.drift
    }

    /// Number of detected restarts and jumps of the device clock.
    pub fn n_restarts(&self) -> u64 {
        self.n_restarts
    }

    fn start(&mut self, device_nanos: i64, arrival: Stamp) {
        self.origin = Some(Origin {
            device_nanos,
            arrival,
        });
        self.newest_nanos = device_nanos;
        self.late_since_nanos = None;
        self.line = Line::default();
        // The first message lies on the line by definition.
        self.buckets.clear();
        self.buckets.push_back(Bucket {
            index: 0,
            device_secs: 0.0,
            delay_secs: 0.0,
        });
    }

    fn restart(&mut self, device_nanos: i64, arrival: Stamp) {
        self.n_restarts += 1;
        self.start(device_nanos, arrival);
    }

    fn late_for_too_long(&mut self, lateness_secs: f64, arrival: Stamp) -> bool {
        if lateness_secs < MAX_LATE_SECS {
            self.late_since_nanos = None;
            return false;
        }
        arrival
            .0
            .saturating_sub(*self.late_since_nanos.get_or_insert(arrival.0))
            > MAX_LATE_NANOS
    }

    /// Merges an arrival into its bucket. Returns whether anything changed.
    fn insert(&mut self, new: Bucket) -> bool {
        let at = self
            .buckets
            .partition_point(|bucket| bucket.index < new.index);
        match self.buckets.get_mut(at) {
            None => self.buckets.push_back(new),
            // Only the fastest message of a bucket can touch the line. The other messages need not
            // be stored.
            Some(known) if known.index == new.index && new.delay_secs < known.delay_secs => {
                *known = new
            }
            // Slower messages are not stored. Messages of an earlier, empty bucket are not stored
            // either. They come from reordering and would have to be inserted in the middle.
            Some(_) => return false,
        }
        let oldest_secs = new.device_secs - WINDOW_SECS;
        while self
            .buckets
            .front()
            .is_some_and(|bucket| bucket.device_secs < oldest_secs)
        {
            self.buckets.pop_front();
        }
        true
    }

    fn fit(&self) -> Line {
        let span_secs = match (self.buckets.front(), self.buckets.back()) {
            (Some(first), Some(last)) => last.device_secs - first.device_secs,
            _ => return self.line,
        };
        // Over one second, a change of latency by 1 ms looks like a drift of 1000 ppm. Over the
        // full span, it amounts to 12.5 ppm.
        let max_drift = MAX_DRIFT * (span_secs / FULL_DRIFT_SECS).min(1.0);
        let drift = self.hull_slope().clamp(-max_drift, max_drift);
        // The slope may have been limited, so the offset may differ from the offset of the hull's
        // edge. The line must always touch the arrivals from below.
        let offset_secs = self
            .buckets
            .iter()
            .map(|bucket| bucket.delay_secs - drift * bucket.device_secs);
        Line {
            offset_secs: offset_secs.fold(f64::INFINITY, f64::min),
            drift,
        }
    }

    /// Slope of the edge of the lower convex hull at the mean device time.
    fn hull_slope(&self) -> f64 {
        let mean_secs = self
            .buckets
            .iter()
            .map(|bucket| bucket.device_secs)
            .sum::<f64>()
            / self.buckets.len() as f64;
        let mut hull: Vec<&Bucket> = Vec::with_capacity(self.buckets.len());
        for bucket in &self.buckets {
            // This is Andrew's monotone chain. A point above the line from its predecessor to the
            // new point is not part of the lower hull.
            while let [.., a, b] = hull[..]
                && slope(a, bucket) <= slope(a, b)
            {
                hull.pop();
            }
            hull.push(bucket);
        }
        // For lines below the points, the sum of the distances to the points depends only on the
        // height of the line at the mean time. The edge at the mean time therefore minimizes this
        // sum.
        let edge = hull
            .windows(2)
            .find(|edge| edge[1].device_secs >= mean_secs);
        edge.map_or(0.0, |edge| slope(edge[0], edge[1]))
    }
}

impl Line {
    fn at(&self, device_secs: f64) -> f64 {
        self.offset_secs + self.drift * device_secs
    }
}

fn slope(a: &Bucket, b: &Bucket) -> f64 {
    (b.delay_secs - a.delay_secs) / (b.device_secs - a.device_secs)
}

/// Unwraps a device's 32-bit microsecond counter, which overflows every 71.6 minutes, to
/// nanoseconds.
#[derive(Clone, Copy, Debug, Default)]
pub struct WrappingMicros {
    last: Option<(u32, i64)>,
}

impl WrappingMicros {
    /// Creates an unwrapper without a previous count. Its first result equals the count.
    pub fn new() -> Self {
        Self::default()
    }

    /// Returns the count as monotonic nanoseconds. The count must lie within 35 minutes of the
    /// previous count.
    pub fn nanos(&mut self, micros: u32) -> i64 {
        const NANOS_PER_MICRO: i64 = 1000;
        let total = match self.last {
            None => i64::from(micros),
            // The signed difference accepts messages that arrive out of order.
            Some((last, total)) => total + i64::from(micros.wrapping_sub(last).cast_signed()),
        };
        self.last = Some((micros, total));
        total * NANOS_PER_MICRO
    }
}

#[cfg(test)]
mod tests {
    #![expect(
        clippy::cast_possible_truncation,
        reason = "test numbers lie well inside the integers' ranges"
    )]

    use super::*;
    use numbers::random::Random;

    const FIXED_NANOS: i64 = 5_000_000;
    const JITTER_NANOS: f64 = 75e6;
    const DRIFT: f64 = 50e-6;

    /// A device that sends at a fixed rate over a connection with jitter. Drift and latencies
    /// derive from one seed.
    struct Device {
        rate_hz: f64,
        random: Random,
        clock_starts: i64,
    }

    impl Device {
        fn new(rate_hz: f64, seed: u64) -> Self {
            Self {
                rate_hz,
                random: Random::new(seed),
                clock_starts: 9_876_543_210,
            }
        }

        /// True time, device time and arrival of the message at `ix`, in nanoseconds.
        fn message(&mut self, ix: u32) -> (i64, i64, Stamp) {
            let truth = (f64::from(ix) / self.rate_hz * 1e9) as i64;
            let device = self.clock_starts + (truth as f64 / (1.0 + DRIFT)) as i64;
            let arrival = truth + FIXED_NANOS + (self.random.unit() * JITTER_NANOS) as i64;
            (truth, device, Stamp(arrival))
        }
    }

    /// Largest error from `settled_secs` to the end, in nanoseconds, after subtracting the fixed
    /// latency.
    fn worst_error(clock: &mut ClockMap, device: &mut Device, secs: f64, settled_secs: f64) -> i64 {
        let n_messages = (secs * device.rate_hz) as u32;
        let mut worst = 0;
        for ix in 0..n_messages {
            let (truth, stamped, arrival) = device.message(ix);
            let mapped = clock.stamp(stamped, arrival);
            assert!(mapped <= arrival);
            if truth as f64 > settled_secs * 1e9 {
                worst = worst.max((mapped.0 - FIXED_NANOS - truth).abs());
            }
        }
        worst
    }

    #[test]
    fn jitter_and_drift_are_filtered_to_a_millisecond() {
        // Each entry contains the rate, the run length, the settling time, the maximum error after
        // settling, and the number of runs whose error may be up to twice the maximum. At a low
        // rate, messages with a low latency are rare. The fastest of n messages in a window has a
        // jitter of about 75 ms / n.
        const RUNS: [(f64, f64, f64, i64, usize); 4] = [
            (1000.0, 30.0, 2.0, 300_000, 0),
            (200.0, 60.0, 6.0, 700_000, 0),
            (60.0, 150.0, 10.0, 1_000_000, 0),
            (30.0, 150.0, 10.0, 1_000_000, 1),
        ];
        for (rate_hz, secs, settled_secs, close_nanos, max_n_exceeding) in RUNS {
            let worst_of_run = |seed| {
                let mut clock = ClockMap::new();
                let worst = worst_error(
                    &mut clock,
                    &mut Device::new(rate_hz, seed),
                    secs,
                    settled_secs,
                );
                assert!(
                    (clock.drift() - DRIFT).abs() < 20e-6,
                    "{rate_hz} Hz, seed {seed}: drift {}",
                    clock.drift()
                );
                assert_eq!(clock.n_restarts(), 0);
                worst
            };
            let worst: Vec<i64> = (1..=20).map(worst_of_run).collect();
            assert!(
                worst.iter().all(|nanos| *nanos < 2 * close_nanos),
                "{rate_hz} Hz: {worst:?} ns off"
            );
            let n_exceeding = worst.iter().filter(|nanos| **nanos >= close_nanos).count();
            assert!(
                n_exceeding <= max_n_exceeding,
                "{rate_hz} Hz: {worst:?} ns off"
            );
        }
    }

    #[test]
    fn clock_without_jitter_is_exact() {
        let mut clock = ClockMap::new();
        assert_eq!(clock.map(5), None);
        for ix in 0..1000 {
            let device = ix * 10_000_000;
            clock.observe(device, Stamp(device + 77));
        }
        assert_eq!(clock.map(123_456_789), Some(Stamp(123_456_866)));
        assert_eq!(clock.drift(), 0.0);
    }

    #[test]
    fn device_clock_restart_is_detected() {
        // The clock jumps back to zero, far ahead, and back by less than its running time.
        for jump_nanos in [-70_000_000_000, 3_600_000_000_000, -4_000_000_000] {
            let mut device = Device::new(200.0, 7);
            let mut clock = ClockMap::new();
            for ix in 0..12_000 {
                let (_, stamped, arrival) = device.message(ix);
                clock.observe(stamped, arrival);
            }
            assert_eq!(clock.n_restarts(), 0);
            device.clock_starts += jump_nanos;
            for ix in 12_000..14_000 {
                let (truth, stamped, arrival) = device.message(ix);
                let mapped = clock.stamp(stamped, arrival);
                if ix >= 13_500 {
                    let off = (mapped.0 - FIXED_NANOS - truth).abs();
                    assert!(off < 1_000_000, "jump {jump_nanos}: {} us off", off / 1000);
                }
            }
            assert_eq!(clock.n_restarts(), 1, "jump {jump_nanos}");
        }
    }

    #[test]
    fn small_clock_step_is_detected() {
        let mut clock = ClockMap::new();
        let send = |clock: &mut ClockMap, ms: i64, behind_ms: i64| {
            clock
                .stamp((ms - behind_ms) * 1_000_000, Stamp(ms * 1_000_000))
                .0
                - ms * 1_000_000
        };
        for ix in 0..500 {
            assert_eq!(send(&mut clock, ix * 10, 0), 0);
        }
        // The device and its clock were paused for three seconds: every later stamp is 3 s behind,
        // and no stamp decreases.
        for ix in 800..1200 {
            send(&mut clock, ix * 10, 3000);
        }
        assert_eq!(clock.n_restarts(), 1);
        assert_eq!(send(&mut clock, 12_010, 3000), 0);
    }

    #[test]
    fn connection_stall_is_ignored() {
        let mut clock = ClockMap::new();
        for ix in 0..1000_i64 {
            let device = ix * 10_000_000;
            // Everything sent in the third second arrives at the end of that second.
            let sent = if (200..300).contains(&ix) {
                3_000_000_000
            } else {
                device
            };
            clock.observe(device, Stamp(sent + 77));
        }
        assert_eq!(clock.n_restarts(), 0);
        assert_eq!(clock.map(5_000_000_000), Some(Stamp(5_000_000_077)));
    }

    #[test]
    fn reordered_messages_are_no_restart() {
        let mut clock = ClockMap::new();
        for ix in 0..1000_i64 {
            let device = (ix ^ 1) * 10_000_000;
            clock.observe(device, Stamp(ix.max(ix ^ 1) * 10_000_000));
        }
        assert_eq!(clock.n_restarts(), 0);
        assert_eq!(clock.map(1_000_000_000), Some(Stamp(1_000_000_000)));
    }

    #[test]
    fn microseconds_unwrap_past_32_bits() {
        let mut wrapping = WrappingMicros::new();
        assert_eq!(wrapping.nanos(u32::MAX - 1), 4_294_967_294_000);
        assert_eq!(wrapping.nanos(1), 4_294_967_297_000);
        assert_eq!(wrapping.nanos(0), 4_294_967_296_000);
        let mut micros = 0_u32;
        for _ in 0..10 {
            micros = micros.wrapping_add(1_000_000_000);
            wrapping.nanos(micros);
        }
        assert_eq!(
            wrapping.nanos(micros),
            (4_294_967_296 + 10_000_000_000) * 1000
        );
    }
}
