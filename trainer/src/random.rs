//! Reproducible pseudo-random numbers for tests.

/// Fixed pseudo-random numbers, the same on every machine (Steele et al. 2014, `SplitMix64`).
pub(crate) struct Random(u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// Uniform in `low..high`, rounded to f32 so that a kernel and its twin start from the same values.
    pub(crate) fn uniform(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut bits = self.0;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        bits ^= bits >> 31;
        // The upper 32 bits suffice and are exact in f64.
        let share = f64::from(u32::try_from(bits >> 32).expect("a shift by 32 leaves 32 bits")) / f64::from(u32::MAX);
        #[expect(clippy::cast_possible_truncation, reason = "rounding to f32 is intended")]
        let rounded = (low + (high - low) * share) as f32;
        f64::from(rounded)
    }

    pub(crate) fn array<const N: usize>(&mut self, low: f64, high: f64) -> [f64; N] {
        std::array::from_fn(|_| self.uniform(low, high))
    }
}
