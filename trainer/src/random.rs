//! Reproducible pseudorandom numbers for tests of kernels.

use numbers::{f32_of, random};

/// Pseudorandom numbers rounded to f32, so that a kernel and its twin start from the same values.
pub(crate) struct F32Random(random::Random);

impl F32Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(random::Random::new(seed))
    }

    /// Uniform in `low..high`.
    pub(crate) fn uniform(&mut self, low: f64, high: f64) -> f64 {
        f64::from(f32_of(self.0.uniform(low, high)))
    }

    pub(crate) fn array<const N: usize>(&mut self, low: f64, high: f64) -> [f64; N] {
        std::array::from_fn(|_| self.uniform(low, high))
    }
}
