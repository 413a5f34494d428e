//! Detects missing images by their sequence numbers.

/// Sequence number of the last image.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sequence {
    last: Option<u32>,
}

impl Sequence {
    /// Records the sequence number of the next image and returns the number of images missing
    /// before it.
    ///
    /// Numbers may wrap. If a number repeats or decreases, no image counts as missing. Some devices
    /// do not count their images, and others restart the count.
    pub(super) fn n_skipped_before(&mut self, number: u32) -> u64 {
        let ahead = self
            .last
            .replace(number)
            .map_or(1, |last| number.wrapping_sub(last));
        // The difference wraps like the numbers. A number that seems to be ahead by more than half
        // of the range is actually behind.
        if ahead > u32::MAX / 2 {
            0
        } else {
            u64::from(ahead.saturating_sub(1))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_counted_across_wraparound() {
        let reported = [5, 6, 9, 10, u32::MAX - 1, 1, 1, 1, 2, 0, 1, 4];
        let mut sequence = Sequence::default();
        let skipped: Vec<u64> = reported
            .map(|number| sequence.n_skipped_before(number))
            .into();
        // The jump from 10 to almost the maximum is more than half of the number range, so it
        // counts as a restart.
        assert_eq!(skipped, [0, 0, 2, 0, 0, 2, 0, 0, 0, 0, 0, 2]);
    }
}
