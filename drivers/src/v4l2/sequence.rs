//! Counts the images that a device numbered and did not deliver.

/// Where a stream stands.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sequence {
    last: Option<u32>,
}

impl Sequence {
    /// Takes the number of the next image; tells how many numbers before it never came.
    ///
    /// Numbers may wrap. One that repeats or goes back tells nothing: some devices do not count, or begin anew.
    pub(super) fn n_skipped_before(&mut self, number: u32) -> u64 {
        let ahead = self.last.replace(number).map_or(1, |last| number.wrapping_sub(last));
        if ahead > u32::MAX / 2 { 0 } else { u64::from(ahead.saturating_sub(1)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_counted_across_wraparound() {
        let reported = [5, 6, 9, 10, u32::MAX - 1, 1, 1, 1, 2, 0, 1, 4];
        let mut sequence = Sequence::default();
        let skipped: Vec<u64> = reported.map(|number| sequence.n_skipped_before(number)).into();
        // From 10 to almost the end of the numbers is further than half way round: the device began anew.
        assert_eq!(skipped, [0, 0, 2, 0, 0, 2, 0, 0, 0, 0, 0, 2]);
    }
}
