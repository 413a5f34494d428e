//! Normal equations of pairs with robust weights. Gain and offset of each pair are eliminated.

use super::pairs::Pair;
use super::prepared_image::{DepthSample, PreparedImage};
use super::residual::{Correspondence, ParamColumns, Side, Tone};
use super::view::CorrectedView;
use nalgebra::{DMatrix, DVector};
use numbers::quantile::{Rank, quantile};
use rayon::prelude::*;

/// Number of standard deviations at which residuals get half the full weight of Cauchy weights.
/// With this value, the estimate is 95 % as efficient as least squares for normal noise.
const CAUCHY_SCALE: f64 = 2.385;
/// Standard deviation of the prior on the gain, around 1. The next constant is the standard
/// deviation of the prior on the offset, around 0. The priors are wide, because exposures differ.
/// Without a prior, a pair of images of constant brightness would not determine gain and offset.
const PRIOR_GAIN_DEVIATION: f64 = 0.2;
const PRIOR_OFFSET: f64 = 30.0;
/// Minimum number of samples of a pair. With fewer samples, gain and offset of the pair would
/// absorb most of their information.
const MIN_SAMPLES: usize = 12;

/// Scatter of the residuals. Brightness is on a scale of 0 to 255, and depth is in meters at 1 m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Noise {
    pub(super) photo: f64,
    pub(super) depth: f64,
}

/// Level, tolerance, noise and pixels of the residuals.
#[derive(Clone, Copy, Debug)]
pub(super) struct ResidualOptions {
    /// Pyramid level, where 0 is the finest.
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
    /// Every second block of pixels, as in a checkerboard. Poses are estimated on one half of the
    /// blocks and evaluated on the other half.
    Blocks {
        odd: bool,
    },
}

impl PixelSubset {
    fn includes(self, pixel: [f64; 2]) -> bool {
        // Blocks are larger than the correlation lengths of textures and of the blur, so that the
        // two halves are independent. They are small enough for several blocks in each image.
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
    // The equations are linear. Only the weights change between iterations.
    const MAX_ITERATIONS: usize = 3;
    let mut tone = Tone {
        gain: 1.0,
        offset: 0.0,
    };
    for _ in 0..MAX_ITERATIONS {
        // Normal equations of the changes of gain and offset.
        let prior_gain = (noise / PRIOR_GAIN_DEVIATION).powi(2);
        let prior_offset = (noise / PRIOR_OFFSET).powi(2);
        let mut xx = prior_gain;
        let mut x = 0.0;
        let mut n = prior_offset;
        let mut xr = prior_gain * (1.0 - tone.gain);
        let mut r = -prior_offset * tone.offset;
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

/// Cauchy weight of a residual.
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
    pairs
        .par_iter()
        .map(|pair| of_shared_pair(sides(images, views, *pair), options))
        .collect()
}

/// Contribution of a pair to the parameters that its two views depend on.
fn of_shared_pair(sides: [Side<'_>; 2], options: &ResidualOptions) -> PairSums {
    let [i, j] = sides.map(|side| side.view);
    // Two images of one camera share their parameters.
    let mut params = [i.params(), j.params()].concat();
    params.sort_unstable();
    params.dedup();
    let index_of = |param: usize| params.partition_point(|known| *known < param);
    let param_columns = [
        ParamColumns::new(i, index_of),
        ParamColumns::new(j, index_of),
    ];
    of_pair(sides, &param_columns, params.clone(), options)
}

/// Contribution of every pair to the motions of its two cameras. The six parameters of the first
/// camera come first, followed by the six parameters of the second camera.
pub(super) fn of_free_pairs(
    images: &[PreparedImage],
    views: &[CorrectedView],
    pairs: &[Pair],
    options: &ResidualOptions,
) -> Vec<PairSums> {
    pairs
        .par_iter()
        .map(|pair| {
            let sides = sides(images, views, *pair);
            let param_columns = [
                ParamColumns::free(sides[0].view, 0),
                ParamColumns::free(sides[1].view, 6),
            ];
            of_pair(sides, &param_columns, (0..12).collect(), options)
        })
        .collect()
}

/// Contribution of a pair to the motion of its second camera, if the first camera is fixed.
pub(super) fn of_second(sides: [Side<'_>; 2], options: &ResidualOptions) -> PairSums {
    let param_columns = [
        ParamColumns::still(sides[0].view),
        ParamColumns::free(sides[1].view, 0),
    ];
    of_pair(sides, &param_columns, (0..6).collect(), options)
}

/// Normal equations of one pair: the parameters, followed by gain and offset of the pair.
struct ToneSums {
    /// Number of rows.
    n: usize,
    /// Lower triangle, row by row.
    information: Vec<f64>,
    /// Negative gradient of the cost.
    gradient: Vec<f64>,
}

impl ToneSums {
    fn new(n_params: usize) -> Self {
        let n = n_params + 2;
        Self {
            n,
            information: vec![0.0; n * n],
            gradient: vec![0.0; n],
        }
    }

    /// Adds a residual with its derivatives. Most of them are zero, because a pair does not depend
    /// on the parameters of other cameras.
    fn add(&mut self, row: &[f64], residual: f64, noise: f64) {
        let weight = weight(residual, noise) / (noise * noise);
        let n = self.n;
        for (ix, derivative) in row
            .iter()
            .enumerate()
            .filter(|(_, derivative)| **derivative != 0.0)
        {
            let scaled = weight * derivative;
            self.gradient[ix] -= scaled * residual;
            for (sum, other) in self.information[ix * n..][..=ix].iter_mut().zip(row) {
                *sum += scaled * other;
            }
        }
    }

    /// Element of the symmetric information matrix.
    fn at(&self, row: usize, column: usize) -> f64 {
        self.information[row.max(column) * self.n + row.min(column)]
    }

    /// Writes the normal equations of the parameters, which are the Schur complement of gain and
    /// offset.
    fn eliminate_tone(&self, sums: &mut PairSums) {
        let n = self.n - 2;
        let prior_information = [
            1.0 / (PRIOR_GAIN_DEVIATION * PRIOR_GAIN_DEVIATION),
            1.0 / (PRIOR_OFFSET * PRIOR_OFFSET),
        ];
        let gg = self.at(n, n) + prior_information[0];
        let go = self.at(n + 1, n);
        let oo = self.at(n + 1, n + 1) + prior_information[1];
        let determinant = gg * oo - go * go;
        for row in 0..n {
            // Change of gain and offset per change of the parameter.
            let rhs = [self.at(n, row), self.at(n + 1, row)];
            let of_tone = [
                (oo * rhs[0] - go * rhs[1]) / determinant,
                (gg * rhs[1] - go * rhs[0]) / determinant,
            ];
            sums.gradient[row] = self.gradient[row]
                - of_tone[0] * self.gradient[n]
                - of_tone[1] * self.gradient[n + 1];
            for column in 0..n {
                sums.information[(row, column)] = self.at(row, column)
                    - of_tone[0] * self.at(n, column)
                    - of_tone[1] * self.at(n + 1, column);
            }
        }
    }
}

/// Contribution of a pair to parameters with these columns.
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
    // Gain and offset are estimated first, so that the weights of the brightness residuals do not
    // depend on the exposure of the images.
    let tone = tone(correspondences.iter(), photo_noise);
    let mut with_tone = ToneSums::new(n);
    let mut row = vec![0.0; n + 2];
    for correspondence in &correspondences {
        let photo = correspondence.photo(tone);
        correspondence.photo_jacobian(i, j, tone, &mut row);
        with_tone.add(&row, photo, photo_noise);
        let depth = correspondence.depth();
        correspondence.depth_jacobian(i, j, &mut row);
        with_tone.add(&row, depth, depth_noise);
        sums.photo.push(photo.abs());
        sums.depth.push(depth.abs());
    }
    with_tone.eliminate_tone(&mut sums);
    sums
}

/// Scatter of the residuals of all pairs, from their median. `None` without residuals.
pub(super) fn noise_of(sums: &[PairSums]) -> Option<Noise> {
    /// Lower limit of the noise. Rounding brightness to bytes and depth to a tenth of a millimeter
    /// causes this noise.
    const MIN_NOISE: Noise = Noise {
        photo: 0.3,
        depth: 5e-5,
    };
    Some(Noise {
        photo: scatter(sums, |pair| &pair.photo)?.max(MIN_NOISE.photo),
        depth: scatter(sums, |pair| &pair.depth)?.max(MIN_NOISE.depth),
    })
}

/// Standard deviation of normal residuals with the same median of their absolute values.
fn scatter(sums: &[PairSums], residuals_of: fn(&PairSums) -> &[f64]) -> Option<f64> {
    /// For a normal distribution, this is 1 divided by its 75 % quantile.
    const SIGMA_PER_MEDIAN: f64 = 1.4826;
    let mut all: Vec<f64> = sums
        .iter()
        .flat_map(|pair| residuals_of(pair).iter().copied())
        .collect();
    quantile(&mut all, 0.5, Rank::Upper).map(|median| SIGMA_PER_MEDIAN * median)
}
