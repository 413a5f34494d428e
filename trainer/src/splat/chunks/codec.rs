//! Encodes each splat in 16 bytes, and its view-dependent color in another 16 bytes.

use crate::model_chunks::{ChunkData, ChunkLayout};
use model_files::splat::arrays::SplatArrays;
use numbers::f32_of;
use std::f64::consts::FRAC_1_SQRT_2;
use std::ops::Range;

/// Highest degree of spherical harmonics in a chunk. Degree 3 would need twice as many bytes.
pub(in crate::splat) const MAX_SH_DEGREE: u32 = 2;
/// Constant basis function.
pub(super) const SH_0: f64 = 0.282_094_791_773_878_14;
/// Bits of a coordinate of a mean. In a cell of 1 m, a step is 0.12 mm.
const MEAN_BITS: u32 = 13;
/// Range of constant colors. It is wider than 0 to 1, because view-dependent parts are added to
/// them.
const COLOR_RANGE: [f64; 2] = [-0.5, 1.5];
/// Larger ranges of standard deviations are clamped at the lower end, because such splats are
/// thinner than a pixel.
const MAX_LOG_SCALE_SPAN: f64 = 10.0;
/// Number of coefficients of degree 1, and of degree 1 and 2, per color channel.
const N_DEGREE_1: usize = 3;
const N_DEGREE_2: usize = 8;
/// Maximum magnitude of a coefficient in 5 bits.
const MAX_SH_COUNT: f64 = 15.0;
/// Coefficients above this limit are clamped. The limit is in units of the root mean square of the
/// chunk. A single outlier would otherwise make the steps of all other coefficients too coarse.
const MAX_SH_DEVIATIONS: f64 = 4.0;

/// Encodes these splats in the given order.
pub(super) fn encode(
    splats: &SplatArrays,
    members: &[u32],
    scale_factor: f64,
    sh_degree: u32,
) -> ChunkData {
    let ranges = Ranges::of(splats, members, sh_degree);
    let words = members.iter().flat_map(|ix| ranges.base_words(splats, *ix));
    let sh_words = members
        .iter()
        .filter(|_| sh_degree > 0)
        .flat_map(|ix| ranges.sh_words(splats, *ix));
    let layout = ChunkLayout::Splats {
        n_splats: members.len(),
        min_m: ranges.min_m,
        max_m: ranges.max_m,
        log_scale_range: ranges.log_scale,
        scale_factor: f32_of(scale_factor),
        sh_degree,
        sh_ranges: ranges.sh,
        is_antialiased: splats.is_antialiased,
    };
    ChunkData {
        layout,
        bytes: words.chain(sh_words).flat_map(u32::to_le_bytes).collect(),
    }
}

/// Ranges of the values in a chunk.
struct Ranges {
    min_m: [f32; 3],
    max_m: [f32; 3],
    log_scale: [f32; 2],
    sh: [f32; 2],
    sh_degree: u32,
}

impl Ranges {
    fn of(splats: &SplatArrays, members: &[u32], sh_degree: u32) -> Self {
        let mut min_m = [f32::INFINITY; 3];
        let mut max_m = [f32::NEG_INFINITY; 3];
        let mut smallest = f32::INFINITY;
        let mut largest = f32::NEG_INFINITY;
        for ix in members {
            let mean = splats.means[*ix as usize];
            min_m = std::array::from_fn(|axis| min_m[axis].min(mean[axis]));
            max_m = std::array::from_fn(|axis| max_m[axis].max(mean[axis]));
            for log_scale in splats.log_scales[*ix as usize] {
                smallest = smallest.min(log_scale);
                largest = largest.max(log_scale);
            }
        }
        // A wide range would make the steps of visible sizes too coarse.
        let smallest = smallest.max(largest - f32_of(MAX_LOG_SCALE_SPAN));
        // Coefficients of degree 2 are usually smaller, so each degree has its own range.
        let degree_1 = if sh_degree >= 1 { 0..N_DEGREE_1 } else { 0..0 };
        let degree_2 = if sh_degree >= 2 {
            N_DEGREE_1..N_DEGREE_2
        } else {
            0..0
        };
        Self {
            min_m,
            max_m,
            log_scale: [smallest, largest],
            sh: [degree_1, degree_2].map(|functions| sh_range(splats, members, functions)),
            sh_degree,
        }
    }

    /// Mean, standard deviations, rotation, opacity and color.
    fn base_words(&self, splats: &SplatArrays, splat_ix: u32) -> [u32; 4] {
        let ix = splat_ix as usize;
        let [x, y, z] = [0, 1, 2].map(|axis| {
            count(
                splats.means[ix][axis].into(),
                [self.min_m[axis].into(), self.max_m[axis].into()],
                MEAN_BITS,
            )
        });
        // Eight bits each for scales, opacity and color.
        let scales = splats.log_scales[ix]
            .map(|scale| count(scale.into(), self.log_scale.map(f64::from), 8));
        let color = splats.sh[ix * splats.n_coefficients()];
        let [red, green, blue] =
            color.map(|value| count(0.5 + SH_0 * f64::from(value), COLOR_RANGE, 8));
        [
            x | y << 13 | z << 26, // The upper bits of z follow.
            z >> 6 | scales[0] << 7 | scales[1] << 15 | scales[2] << 23,
            rotation_word(splats.rotations_wxyz[ix]),
            count(splats.opacity(splat_ix as usize), [0.0, 1.0], 8)
                | red << 8
                | green << 16
                | blue << 24,
        ]
    }

    /// Coefficients of degree 1 and 2, with six in each word. Red, green and blue of one basis
    /// function come before the colors of the next basis function.
    fn sh_words(&self, splats: &SplatArrays, splat_ix: u32) -> [u32; 4] {
        let mut words = [0; 4];
        for function in 0..N_DEGREE_2 {
            let degree = if function < N_DEGREE_1 { 1 } else { 2 };
            let range: f64 = self.sh[degree - 1].into();
            for (channel, value) in higher_coefficient(splats, splat_ix, function)
                .into_iter()
                .enumerate()
            {
                // A range of 0 has no steps. In that case, all coefficients are 0.
                let is_present = degree <= self.sh_degree as usize && range > 0.0;
                let share = if is_present { value / range } else { 0.0 };
                let field = 3 * function + channel;
                words[field / 6] |= sh_count(share) << (5 * (field % 6));
            }
        }
        words
    }
}

/// Largest magnitude of these higher coefficients, without outliers.
fn sh_range(splats: &SplatArrays, members: &[u32], functions: Range<usize>) -> f32 {
    let mut values: Vec<f64> = Vec::new();
    for ix in members {
        for function in functions.clone() {
            values.extend(higher_coefficient(splats, *ix, function));
        }
    }
    let n_values = values.len().max(1) as f64;
    let rms = (values.iter().map(|value| value * value).sum::<f64>() / n_values).sqrt();
    let largest = values.iter().map(|value| value.abs()).fold(0.0, f64::max);
    f32_of(largest.min(MAX_SH_DEVIATIONS * rms))
}

/// Red, green and blue of a basis function after the constant function. They are zero if the splats
/// have no such function.
fn higher_coefficient(splats: &SplatArrays, splat_ix: u32, function: usize) -> [f64; 3] {
    let n_coefficients = splats.n_coefficients();
    let is_present = function + 1 < n_coefficients;
    let at = splat_ix as usize * n_coefficients + function + 1;
    if is_present {
        splats.sh[at].map(f64::from)
    } else {
        [0.0; 3]
    }
}

/// Rounds a value in a range to the given number of bits.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to the bits"
)]
fn count(value: f64, [min, max]: [f64; 2], bits: u32) -> u32 {
    // In a range without extent, all values are equal and encoded as 0.
    let max_count = f64::from((1_u32 << bits) - 1);
    let share = if max > min {
        (value - min) / (max - min)
    } else {
        0.0
    };
    (share * max_count).round().clamp(0.0, max_count) as u32
}

/// A share of the range of coefficients, from -1 to 1, as a number from 1 to 31. 16 stands for 0.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to 5 bits"
)]
fn sh_count(share: f64) -> u32 {
    (16.0
        + (MAX_SH_COUNT * share)
            .round()
            .clamp(-MAX_SH_COUNT, MAX_SH_COUNT)) as u32
}

/// A rotation in 32 bits. The upper two bits are the index of the component with the largest
/// magnitude. The other three components follow with 10 bits each. The largest component is made
/// positive.
///
/// Source of the idea: Fiedler 2015, "Snapshot compression".
fn rotation_word(wxyz: [f32; 4]) -> u32 {
    let wxyz = wxyz.map(f64::from);
    let length = wxyz
        .iter()
        .map(|part| part * part)
        .sum::<f64>()
        .sqrt()
        // The length must not be 0, even for an invalid rotation.
        .max(1e-30);
    let largest_ix = (1..4).fold(0, |largest, ix| {
        if wxyz[ix].abs() > wxyz[largest].abs() {
            ix
        } else {
            largest
        }
    });
    // A quaternion and its negative are the same rotation, so the sign of the omitted component
    // need not be stored. The others are at most 1 / sqrt(2).
    let sign = wxyz[largest_ix].signum() / length;
    let others = (0..4)
        .filter(|ix| *ix != largest_ix)
        .map(|ix| sign * wxyz[ix]);
    others.fold(u32::try_from(largest_ix).unwrap_or(0), |word, part| {
        word << 10 | count(part, [-FRAC_1_SQRT_2, FRAC_1_SQRT_2], 10)
    })
}
