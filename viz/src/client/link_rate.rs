//! Estimates how fast a client's connection transfers data, so that little of it waits in buffers.

use crate::pictures::compact_depth::Effort;
use std::time::Duration;

/// Data handed to the kernel at once, as transfer time in seconds. Together with the buffer, the
/// transfer takes 60 ms. It stays below 100 ms even if the estimated rate is too high by a half.
const PART_TIME: f64 = 0.02;
/// Data in the kernel's buffer, as transfer time in seconds. A shorter buffer runs empty on fast
/// links, before this process is scheduled again.
const BUFFER_TIME: f64 = 0.04;
/// Limits of the size of a part, bytes; the next constant limits the buffer. Larger parts and
/// buffers do not make fast connections faster. Smaller ones would make the headers and calls cost
/// more than the data.
const PART_BYTES: std::ops::RangeInclusive<f64> = 4096.0..=65_536.0;
const BUFFER_BYTES: std::ops::RangeInclusive<f64> = 8192.0..=65_536.0;
/// Rate before the first measurement: an ordinary wireless link.
const INITIAL_BYTES_PER_SEC: f64 = 1.25e6;
/// Above this rate, fast compression saves more time than its additional bytes take. For depth of
/// 512 x 512 pixels, it saves about 4 ms of computation and adds 12 to 47 kB
/// (`docs/benchmarks/2026-11-26-viewer-protocol.md`).
const FAST_BYTES_PER_SEC: f64 = 6e6;
/// Slower loopback connections are probably tunnels to another computer. A tunnel at or above this
/// rate gets uncompressed depth, which it can transfer.
const LOCAL_BYTES_PER_SEC: f64 = 3e7;
/// Shorter sends do not measure the link, but the memory of this computer.
const MIN_SEND_SECS: f64 = 2e-4;
/// Parts of less than half the usual size measure the link only if they take at least this long.
/// Otherwise, the time is mostly the overhead of the call.
const MIN_SHORT_SEND_SECS: f64 = 5e-3;
/// Maximum factor by which the estimate increases at once. Decreases are followed quickly. If the
/// estimate is too high, data waits in buffers. If it is too low, parts are only smaller than
/// necessary.
const MAX_INCREASE: f64 = 1.25;
/// After a longer pause, the kernel's buffer may be empty. Data that fits into it then seems to be
/// sent at once.
const MAX_PAUSE: Duration = Duration::from_millis(5);

/// Transfer rate of a connection.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LinkRate {
    bytes_per_sec: f64,
    /// Bytes and time of the sends since the last pause.
    burst_bytes: f64,
    burst_secs: f64,
}

impl Default for LinkRate {
    fn default() -> Self {
        Self {
            bytes_per_sec: INITIAL_BYTES_PER_SEC,
            burst_bytes: 0.0,
            burst_secs: 0.0,
        }
    }
}

impl LinkRate {
    /// Records that the kernel accepted data after this time, and the pause before it.
    pub(crate) fn observe(&mut self, n_bytes: usize, took: Duration, pause: Duration) {
        if pause > MAX_PAUSE {
            self.burst_bytes = 0.0;
            self.burst_secs = 0.0;
        }
        let secs = took.as_secs_f64().max(MIN_SEND_SECS);
        // Shorter pauses count as sending, because the kernel continues to send the data in its
        // buffer.
        self.burst_bytes += n_bytes as f64;
        self.burst_secs += secs + pause.min(MAX_PAUSE).as_secs_f64();
        let measured = n_bytes as f64 / secs;
        // A send that takes long had to wait for room in the buffer, so it measures the link.
        if measured < self.bytes_per_sec {
            let is_short = 2 * n_bytes < self.part_bytes();
            if !is_short || secs >= MIN_SHORT_SEND_SECS {
                self.bytes_per_sec = 0.5 * (self.bytes_per_sec + measured);
            }
            return;
        }
        // A send that takes no time may only have filled the buffer. The rate may therefore
        // increase only by what was sent since the last pause, without the data that is still in
        // the buffer.
        let over_burst = (self.burst_bytes - self.buffer_bytes() as f64) / self.burst_secs;
        if over_burst > self.bytes_per_sec {
            self.bytes_per_sec = over_burst.min(self.bytes_per_sec * MAX_INCREASE);
        }
    }

    /// How to compress data for this connection. `None` within a computer, where compression takes
    /// longer than it saves.
    pub(crate) fn effort(self, is_loopback: bool) -> Option<Effort> {
        match self.bytes_per_sec {
            // The initial rate is below this limit, so a connection counts as local only after a
            // higher rate was measured.
            rate if is_loopback && rate > LOCAL_BYTES_PER_SEC => None,
            rate if rate > FAST_BYTES_PER_SEC => Some(Effort::Fast),
            _ => Some(Effort::Small),
        }
    }

    /// Size of the parts of long messages.
    pub(crate) fn part_bytes(self) -> usize {
        bytes_in(self.bytes_per_sec * PART_TIME, PART_BYTES)
    }

    /// Size of the kernel's send buffer.
    pub(crate) fn buffer_bytes(self) -> usize {
        bytes_in(self.bytes_per_sec * BUFFER_TIME, BUFFER_BYTES)
    }
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "limited to a range of sizes"
)]
fn bytes_in(bytes: f64, range: std::ops::RangeInclusive<f64>) -> usize {
    bytes.clamp(*range.start(), *range.end()) as usize
}

#[cfg(test)]
mod tests {
    use super::{Effort, LinkRate};
    use std::time::Duration;

    /// Simulates a link with a kernel buffer. Returns the largest time that data waits once the
    /// estimate has settled.
    fn longest_wait_secs(link_bytes_per_sec: f64) -> f64 {
        let mut rate = LinkRate::default();
        let (mut buffered, mut longest) = (0.0_f64, 0.0_f64);
        for ix in 0..400 {
            let (part, buffer) = (rate.part_bytes(), rate.buffer_bytes() as f64);
            // The kernel accepts the part as soon as its buffer has room for the end of it.
            let excess = (buffered + part as f64 - buffer).max(0.0);
            let secs = excess / link_bytes_per_sec;
            buffered = (buffered + part as f64 - excess).max(0.0);
            if ix > 50 {
                longest = longest.max((buffered + part as f64) / link_bytes_per_sec);
            }
            // A pause now and then empties the buffer.
            let pause = if ix % 37 == 0 { 0.5 } else { 0.0 };
            rate.observe(
                part,
                Duration::from_secs_f64(secs),
                Duration::from_secs_f64(pause),
            );
            buffered = (buffered - pause * link_bytes_per_sec).max(0.0);
        }
        longest
    }

    #[test]
    fn at_most_100_ms_wait_unsent() {
        for megabits in [2.0, 5.0, 20.0, 100.0, 1000.0] {
            let wait = longest_wait_secs(megabits * 1e6 / 8.0);
            assert!(wait < 0.1, "{megabits} Mbit/s: {wait} s");
        }
    }

    #[test]
    fn fast_links_get_large_parts() {
        let mut rate = LinkRate::default();
        for _ in 0..40 {
            rate.observe(rate.part_bytes(), Duration::from_micros(20), Duration::ZERO);
        }
        assert_eq!((rate.part_bytes(), rate.buffer_bytes()), (65_536, 65_536));
        assert_eq!(
            [true, false].map(|is_loopback| rate.effort(is_loopback)),
            [None, Some(Effort::Fast)]
        );
        assert_eq!(LinkRate::default().effort(true), Some(Effort::Small));
        // The short ends of messages do not look like a slow link.
        for _ in 0..40 {
            rate.observe(300, Duration::from_micros(250), Duration::ZERO);
        }
        assert_eq!((rate.part_bytes(), rate.buffer_bytes()), (65_536, 65_536));
    }

    #[test]
    fn short_messages_on_slow_links_are_measured() {
        let mut rate = LinkRate::default();
        for _ in 0..40 {
            rate.observe(5000, Duration::from_millis(20), Duration::from_millis(50));
        }
        assert!(
            rate.buffer_bytes() <= 11_000,
            "{} bytes at 250 kB/s",
            rate.buffer_bytes()
        );
    }
}
