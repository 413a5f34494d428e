//! Normal equations of pairs with robust weights; gain and offset of each pair are eliminated.

use super::pairs::Pair;
use super::prepared_image::{DepthSample, PreparedImage};
use super::residual::{Correspondence, ParamColumns, Side, Tone};
use super::view::CorrectedView;
use kinematics::quantile::{Rank, quantile};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Number of standard deviations at which residuals get half the full weight (Cauchy weights, 95 %
/// as efficient as least squares for normal noise).
const CAUCHY_SCALE: f64 = 2.385;
/// Standard deviation of the prior on the gain, around 1. The next constant is that of the offset,
/// around 0.
const PRIOR_GAIN_DEVIATION: f64 = 0.2;
const PRIOR_OFFSET: f64 = 30.0;
/// Minimum number of samples of a pair.
const MIN_SAMPLES: usize = 12;

/// Scatter of the residuals: brightness on a scale of 0 to 255, depth in meters at 1 m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Noise {
    pub(super) photo: f64,
    pub(super) depth: f64,
}

/// Level, tolerance, noise and pixels of the residuals.
#[derive(Clone, Copy, Debug)]
pub(super) struct ResidualOptions {
    /// Pyramid level; 0 is the finest.
    pub(super) level: usize,
    /// Relative depth difference above which a reading belongs to another surface.
    pub(super) occlusion_frac: f64,
    pub(super) noise: Noise,
    pub(super) part: PixelSubset,
}

/// Subset of the pixels of a pair's second image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PixelSubset {
    All,
    /// Every second block, as in a checkerboard: poses are estimated on one half of the blocks and
    /// evaluated on the other.
    Blocks {
        odd: bool,
    },
}

impl PixelSubset {
    fn includes(self, pixel: [f64; 2]) -> bool {
        const BLOCK_PX: f64 = 64.0;
        match self {
            Self::All => true,
            Self::Blocks { odd } => {
                let [column, row] = pixel.map(|coordinate| (coordinate / BLOCK_PX).floor());
                ((column + row) % 2.0 != 0.0) == odd
            }
        }
    }
}

/// Contribution of one pair to the normal equations.
#[derive(Debug)]
pub(super) struct PairSums {
    /// Indices of the parameters that affect the pair.
    pub(super) params: Vec<usize>,
    pub(super) information: DMatrix<f64>,
    /// Negative gradient of the cost.
    pub(super) gradient: DVector<f64>,
    photo: Vec<f64>,
    depth: Vec<f64>,
}

impl PairSums {
    /// Sums of residuals other than brightness and depth.
    pub(super) fn new(
        params: Vec<usize>,
        information: DMatrix<f64>,
        gradient: DVector<f64>,
    ) -> Self {
        Self {
            params,
            information,
            gradient,
            photo: Vec::new(),
            depth: Vec::new(),
        }
    }
}

/// Correspondences of the first image's samples in the second image, within the selected pixels.
pub(super) fn correspondences(
    [i, j]: [Side<'_>; 2],
    samples: &[DepthSample],
    options: &ResidualOptions,
) -> Vec<Option<Correspondence>> {
    let correspondence = |sample: &DepthSample| {
        Correspondence::new(i, j, sample, options.level, options.occlusion_frac)
    };
    samples
        .iter()
        .map(|sample| {
            correspondence(sample)
                .filter(|correspondence| options.part.includes(correspondence.pixel()))
        })
        .collect()
}

/// The images of a pair with their views.
pub(super) fn sides<'a>(
    images: &'a [PreparedImage],
    views: &'a [CorrectedView],
    pair: Pair,
) -> [Side<'a>; 2] {
    [pair.from, pair.to].map(|ix| Side {
        image: &images[ix],
        view: &views[ix],
    })
}

/// Estimates gain and offset by iteratively reweighted least squares.
pub(super) fn tone<'a>(
    correspondences: impl Iterator<Item = &'a Correspondence> + Clone,
    noise: f64,
) -> Tone {
    const MAX_ITERATIONS: usize = 3;
    let mut tone = Tone {
        gain: 1.0,
        offset: 0.0,
    };
    for _ in 0..MAX_ITERATIONS {
        // Normal equations of the changes of gain and offset.
        let (prior_gain, prior_offset) = (
            (noise / PRIOR_GAIN_DEVIATION).powi(2),
            (noise / PRIOR_OFFSET).powi(2),
        );
        let (mut xx, mut x, mut n) = (prior_gain, 0.0, prior_offset);
        let (mut xr, mut r) = (prior_gain * (1.0 - tone.gain), -prior_offset * tone.offset);
        for correspondence in correspondences.clone() {
            let residual = correspondence.photo(tone);
            let weight = weight(residual, noise);
            let [brightness, _] = correspondence.brightness();
            xx += weight * brightness * brightness;
            x += weight * brightness;
            n += weight;
            xr += weight * brightness * residual;
            r += weight * residual;
        }
        let determinant = xx * n - x * x;
        tone.gain += (n * xr - x * r) / determinant;
        tone.offset += (xx * r - x * xr) / determinant;
    }
    tone
}

fn weight(residual: f64, noise: f64) -> f64 {
    1.0 / (1.0 + (residual / (CAUCHY_SCALE * noise)).powi(2))
}

/// Contribution of every pair to the normal equations of the views' parameters, in the order of the
/// pairs.
pub(super) fn of_pairs(
    images: &[PreparedImage],
    views: &[CorrectedView],
    pairs: &[Pair],
    options: &ResidualOptions,
) -> Vec<PairSums> {
    let of = |pair: &Pair| {
        let (i, j) = (&views[pair.from], &views[pair.to]);
        let mut params = [i.params(), j.params()].concat();
        params.sort_unstable();
        params.dedup();
        let index_of = |param: usize| params.partition_point(|known| *known < param);
        let param_columns = [
            ParamColumns::new(i, index_of),
            ParamColumns::new(j, index_of),
        ];
        of_pair(
            sides(images, views, *pair),
            &param_columns,
            params.clone(),
            options,
        )
    };
    pairs.par_iter().map(of).collect()
}

/// Contribution of every pair to the motions of its two cameras: six parameters of the first, then
/// six of the second.
pub(super) fn of_free_pairs(
    images: &[PreparedImage],
    views: &[CorrectedView],
    pairs: &[Pair],
    options: &ResidualOptions,
) -> Vec<PairSums> {
    let of = |pair: &Pair| {
        let param_columns = [
            ParamColumns::free(&views[pair.from], 0),
            ParamColumns::free(&views[pair.to], 6),
        ];
        of_pair(
            sides(images, views, *pair),
            &param_columns,
            (0..12).collect(),
            options,
        )
    };
    pairs.par_iter().map(of).collect()
}

/// Contribution of a pair to the motion of its second camera, with the first one fixed.
pub(super) fn of_second(sides: [Side<'_>; 2], options: &ResidualOptions) -> PairSums {
    let param_columns = [
        ParamColumns::still(sides[0].view),
        ParamColumns::free(sides[1].view, 0),
    ];
    of_pair(sides, &param_columns, (0..6).collect(), options)
}

fn of_pair(
    sides: [Side<'_>; 2],
    [i, j]: &[ParamColumns<'_>; 2],
    params: Vec<usize>,
    options: &ResidualOptions,
) -> PairSums {
    let n = params.len();
    let mut sums = PairSums {
        params,
        information: DMatrix::zeros(n, n),
        gradient: DVector::zeros(n),
        photo: Vec::new(),
        depth: Vec::new(),
    };
    let correspondences: Vec<Correspondence> =
        correspondences(sides, &sides[0].image.samples, options)
            .into_iter()
            .flatten()
            .collect();
    if correspondences.len() < MIN_SAMPLES {
        return sums;
    }
    let Noise {
        photo: photo_noise,
        depth: depth_noise,
    } = options.noise;
    let tone = tone(correspondences.iter(), photo_noise);
    let (mut information, mut gradient) = (vec![0.0; (n + 2) * (n + 2)], vec![0.0; n + 2]);
    let mut row = vec![0.0; n + 2];
    let mut add = |row: &[f64], residual: f64, noise: f64| {
        let weight = weight(residual, noise) / (noise * noise);
        for (ix, derivative) in row
            .iter()
            .enumerate()
            .filter(|(_, derivative)| **derivative != 0.0)
        {
            let scaled = weight * derivative;
            gradient[ix] -= scaled * residual;
            for (sum, other) in information[ix * (n + 2)..][..=ix].iter_mut().zip(row) {
                *sum += scaled * other;
            }
        }
    };
    for correspondence in &correspondences {
        let photo = correspondence.photo(tone);
        correspondence.photo_jacobian(i, j, tone, &mut row);
        add(&row, photo, photo_noise);
        let depth = correspondence.depth();
        correspondence.depth_jacobian(i, j, &mut row);
        add(&row, depth, depth_noise);
        sums.photo.push(photo.abs());
        sums.depth.push(depth.abs());
    }
    let at = |row: usize, column: usize| information[row.max(column) * (n + 2) + row.min(column)];
    // The Schur complement of gain and offset.
    let prior_information = [
        1.0 / (PRIOR_GAIN_DEVIATION * PRIOR_GAIN_DEVIATION),
        1.0 / (PRIOR_OFFSET * PRIOR_OFFSET),
    ];
    let [gg, go, oo] = [
        at(n, n) + prior_information[0],
        at(n + 1, n),
        at(n + 1, n + 1) + prior_information[1],
    ];
    let determinant = gg * oo - go * go;
    let solve_tone = |rhs: [f64; 2]| {
        [
            (oo * rhs[0] - go * rhs[1]) / determinant,
            (gg * rhs[1] - go * rhs[0]) / determinant,
        ]
    };
    for row in 0..n {
        let of_tone = solve_tone([at(n, row), at(n + 1, row)]);
        sums.gradient[row] =
            gradient[row] - of_tone[0] * gradient[n] - of_tone[1] * gradient[n + 1];
        for column in 0..n {
            sums.information[(row, column)] =
                at(row, column) - of_tone[0] * at(n, column) - of_tone[1] * at(n + 1, column);
        }
    }
    sums
}

/// Scatter of the residuals of all pairs, from their median; `None` without residuals.
pub(super) fn noise_of(sums: &[PairSums]) -> Option<Noise> {
    /// Lower limit of the noise: rounding to bytes and to a tenth of a millimeter.
    const MIN_NOISE: Noise = Noise {
        photo: 0.3,
        depth: 5e-5,
    };
    let scatter = |of: fn(&PairSums) -> &[f64]| {
        let mut all: Vec<f64> = sums
            .iter()
            .flat_map(|pair| of(pair).iter().copied())
            .collect();
        quantile(&mut all, 0.5, Rank::Upper).map(|median| 1.4826 * median)
    };
    Some(Noise {
        photo: scatter(|pair| &pair.photo)?.max(MIN_NOISE.photo),
        depth: scatter(|pair| &pair.depth)?.max(MIN_NOISE.depth),
    })
}
