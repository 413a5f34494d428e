//! Reproducible pseudorandom numbers: `SplitMix64`.
//!
//! The same seed gives the same numbers on every machine. The generator is from Steele, Lea and
//! Flood 2014, "Fast splittable pseudorandom number generators", with the output function "variant
//! 13" of Stafford. Normal numbers are from Box and Muller 1958.

use std::f64::consts::TAU;

/// Increment of the state: 2^64 divided by the golden ratio, rounded to an odd number.
const GOLDEN_GAMMA: u64 = 0x9e37_79b9_7f4a_7c15;

/// A sequence of pseudorandom numbers.
#[derive(Clone, Debug)]
pub struct Random {
    state: u64,
    /// Second number of the last Box-Muller pair, for the next call.
    spare_normal: Option<f64>,
}

impl Random {
    /// Starts the sequence of a seed. All seeds are suitable, and neighboring seeds give unrelated
    /// sequences.
    pub fn new(seed: u64) -> Self {
        Self {
            state: seed,
            spare_normal: None,
        }
    }

    /// The next 64 random bits.
    pub fn bits(&mut self) -> u64 {
        let bits = nth_bits(self.state, 0);
        self.state = self.state.wrapping_add(GOLDEN_GAMMA);
        bits
    }

    /// The next 32 random bits.
    pub fn bits_32(&mut self) -> u32 {
        u32::try_from(self.bits() >> 32).expect("a shift by 32 leaves 32 bits")
    }

    /// A random byte.
    pub fn byte(&mut self) -> u8 {
        self.bits().to_be_bytes()[0]
    }

    /// `n` random bytes.
    pub fn bytes(&mut self, n: usize) -> Vec<u8> {
        (0..n).map(|_| self.byte()).collect()
    }

    /// A number in `0..bound`. All numbers are equally likely up to a factor of `1 + bound / 2^64`.
    ///
    /// # Panics
    /// Panics if `bound` is 0.
    pub fn below(&mut self, bound: usize) -> usize {
        // The bias of the modulo is accepted. If values were rejected, the number of draws, and
        // thus all later numbers, would depend on the values.
        usize::try_from(self.bits() % bound as u64).expect("less than a usize")
    }

    /// A uniformly distributed number, 0 <= x < 1.
    pub fn unit(&mut self) -> f64 {
        unit_from_bits(self.bits())
    }

    /// A uniformly distributed number in `low..high`.
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// A normally distributed number with mean 0 and standard deviation 1.
    pub fn normal(&mut self) -> f64 {
        if let Some(spare) = self.spare_normal.take() {
            return spare;
        }
        // `unit` may be 0 but not 1, so the logarithm is taken of its complement, which is never 0.
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        let (sine, cosine) = (TAU * self.unit()).sin_cos();
        self.spare_normal = Some(radius * sine);
        radius * cosine
    }

    /// Shuffles the items. All orders are equally likely. Source: Durstenfeld 1964.
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for ix in (1..items.len()).rev() {
            // Each position receives one of the remaining items, including its own.
            items.swap(ix, self.below(ix + 1));
        }
    }
}

/// The bits at index `n` of the sequence of a seed. They are computed without the preceding
/// elements.
pub fn nth_bits(seed: u64, n: u64) -> u64 {
    // The state after `n` steps is known without taking them, so any element can be computed in
    // parallel. The factor is `n + 1`, because the generator advances before it mixes.
    let state = seed.wrapping_add(n.wrapping_add(1).wrapping_mul(GOLDEN_GAMMA));
    let mixed = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    mixed ^ (mixed >> 31)
}

/// A hash of a word. It consists of the first bits of the sequence with this word as seed.
pub fn hash(word: u64) -> u64 {
    nth_bits(word, 0)
}

/// Maps random bits to 0 <= x < 1. The upper 53 bits fill the mantissa of an f64.
pub fn unit_from_bits(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_match_reference_implementation() {
        // These values are from `splitmix64.c` of Sebastiano Vigna (public domain) for the state 1234567.
        const EXPECTED: [u64; 5] = [
            6_457_827_717_110_365_317,
            3_203_168_211_198_807_973,
            9_817_491_932_198_370_423,
            4_593_380_528_125_082_431,
            16_408_922_859_458_223_821,
        ];
        let mut random = Random::new(1_234_567);
        for (n, expected) in (0..).zip(EXPECTED) {
            assert_eq!(
                (random.bits(), nth_bits(1_234_567, n)),
                (expected, expected)
            );
        }
        assert_eq!(hash(1_234_567), EXPECTED[0]);
        assert_eq!(hash(0), 0xe220_a839_7b1d_cdaf);
    }

    #[test]
    fn numbers_derive_from_bits() {
        let mut random = Random::new(1_234_567);
        assert_eq!(random.unit().to_bits(), 0x3fd6_67b4_05fe_c23e);
        assert_eq!(random.uniform(-2.0, 2.0).to_bits(), 0xbff4_e303_dee9_eafe);
        assert_eq!(random.bits_32(), 2_285_812_965);
        assert_eq!(random.byte(), 63);
        assert_eq!(random.below(1000), 821);
        assert_eq!(
            [unit_from_bits(0), unit_from_bits(u64::MAX)],
            [0.0, 1.0 - f64::EPSILON / 2.0]
        );
    }

    #[test]
    fn normal_numbers_have_mean_0_and_deviation_1() {
        let mut random = Random::new(5);
        let n = 100_000;
        let numbers: Vec<f64> = (0..n).map(|_| random.normal()).collect();
        let mean = numbers.iter().sum::<f64>() / f64::from(n);
        let variance = numbers
            .iter()
            .map(|number| (number - mean).powi(2))
            .sum::<f64>()
            / f64::from(n);
        let within_one =
            numbers.iter().filter(|number| number.abs() < 1.0).count() as f64 / f64::from(n);
        assert!(
            mean.abs() < 0.015 && (variance - 1.0).abs() < 0.02,
            "mean {mean}, variance {variance}"
        );
        assert!((within_one - 0.6827).abs() < 0.007, "{within_one}");
    }

    #[test]
    fn shuffling_keeps_items_and_reaches_all_orders() {
        let mut random = Random::new(9);
        let mut counts = std::collections::BTreeMap::<_, u32>::new();
        for _ in 0..6000 {
            let mut items = [0, 1, 2];
            random.shuffle(&mut items);
            *counts.entry(items).or_default() += 1;
        }
        assert_eq!(counts.len(), 6);
        assert!(
            counts.values().all(|n| (850..1150).contains(n)),
            "{counts:?}"
        );
    }
}
