//! Random numbers that depend only on a key and a counter, so that any image can be reproduced
//! independently.

use numbers::random::{hash, nth_bits, unit_from_bits};
use std::sync::LazyLock;

/// Random number stream of one key.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RandomStream {
    key: u64,
}

impl RandomStream {
    /// The stream of a seed and the numbers that identify its use, such as camera and image.
    pub(crate) fn new(seed: u64, names: &[u64]) -> Self {
        Self {
            key: names
                .iter()
                .fold(hash(seed), |key, name| hash(key ^ hash(*name))),
        }
    }

    /// 64 random bits at a counter.
    pub(crate) fn bits(self, counter: u64) -> u64 {
        nth_bits(self.key, counter)
    }

    /// Uniform in `0..1` at a counter.
    pub(crate) fn unit(self, counter: u64) -> f64 {
        unit_from_bits(self.bits(counter))
    }

    /// Uniform in `lower..upper` at a counter.
    pub(crate) fn between(self, counter: u64, lower: f64, upper: f64) -> f64 {
        lower + (upper - lower) * self.unit(counter)
    }

    /// Four standard normal numbers at a counter, from a table of 4096 quantiles.
    pub(crate) fn normals(self, counter: u64) -> [f32; 4] {
        let bits = self.bits(counter);
        let table = &*QUANTILES;
        // Four separate groups of 12 bits are used. A table lookup is much faster than the
        // Box-Muller transform, and images need millions of normal numbers.
        [0, 12, 24, 36].map(|shift| table[(bits >> shift & 0xfff) as usize])
    }
}

/// Quantiles of the standard normal distribution at `(i + 1/2) / 4096`, scaled to variance 1.
static QUANTILES: LazyLock<[f32; 4096]> = LazyLock::new(|| {
    let quantiles: Vec<f64> = (0..4096)
        .map(|ix| normal_quantile((f64::from(ix) + 0.5) / 4096.0))
        .collect();
    // The tails beyond the table are missing, so the quantiles have a variance slightly below 1.
    let scale = (quantiles.iter().map(|q| q * q).sum::<f64>() / 4096.0).sqrt();
    #[expect(clippy::cast_possible_truncation, reason = "a table in f32")]
    std::array::from_fn(|ix| (quantiles[ix] / scale) as f32)
});

/// Inverse of the normal distribution function, by Newton steps from a logistic guess.
fn normal_quantile(probability: f64) -> f64 {
    // The logistic distribution with the scale 1.702 differs from the normal distribution by less
    // than 0.01.
    let mut x = (probability / (1.0 - probability)).ln() / 1.702;
    for _ in 0..60 {
        let density = (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt();
        // The step is limited, because the density is almost 0 far from the mean, where a full
        // Newton step would overshoot.
        let step = ((normal_below(x) - probability) / density).clamp(-0.5, 0.5);
        x -= step;
    }
    x
}

/// The normal distribution function, by its power series (Marsaglia 2004).
fn normal_below(x: f64) -> f64 {
    let mut term = x;
    let mut sum = x;
    for n in 1..200 {
        term *= x * x / f64::from(2 * n + 1);
        sum += term;
    }
    0.5 + sum * (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_match_normal_distribution() {
        assert!((normal_quantile(0.975) - 1.959_963_984_540_054).abs() < 1e-9);
        assert!((normal_quantile(0.001) + 3.090_232_306_167_813).abs() < 1e-9);
    }

    #[test]
    fn normals_are_standard_and_depend_on_key() {
        let random = RandomStream::new(7, &[1, 2]);
        let numbers: Vec<f64> = (0..50_000)
            .flat_map(|ix| random.normals(ix))
            .map(f64::from)
            .collect();
        let n = numbers.len() as f64;
        let mean = numbers.iter().sum::<f64>() / n;
        let variance = numbers.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n;
        assert!(
            mean.abs() < 0.01 && (variance - 1.0).abs() < 0.02,
            "mean {mean}, variance {variance}"
        );
        assert_ne!(RandomStream::new(7, &[1, 3]).bits(0), random.bits(0));
        assert_ne!(RandomStream::new(8, &[1, 2]).bits(0), random.bits(0));
    }
}
