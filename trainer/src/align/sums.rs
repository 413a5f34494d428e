//! Normal equations of pairs: robustly weighted, with gain and offset of each pair taken out.

use super::frame::{Frame, Spot};
use super::pairs::Pair;
use super::residual::{Look, Placed, Side, Tone};
use super::view::View;
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Residuals of this many standard deviations count half (Cauchy's weights; 95 % as good as squares where noise is normal).
const CAUCHY: f64 = 2.385;
/// Gains further from 1 than this, and offsets beyond this, are pulled back.
const USUAL_GAIN: f64 = 0.2;
const USUAL_OFFSET: f64 = 30.0;
/// Fewer spots tell nothing about a pair.
const LEAST_SPOTS: usize = 12;

/// Scatter of the residuals: brightness of 255, depth in metres at 1 m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Noise {
    pub(super) photo: f64,
    pub(super) depth: f64,
}

/// What is looked at, and how finely.
#[derive(Clone, Copy, Debug)]
pub(super) struct Looks {
    /// Of the pyramid; 0 is the finest.
    pub(super) level: usize,
    /// By how much readings may differ before they count as another surface's.
    pub(super) hidden_frac: f64,
    pub(super) noise: Noise,
    pub(super) part: Part,
}

/// Which pixels of the second image of a pair are looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    All,
    /// One half of its blocks, as of a checkerboard: what is found on one is judged on the other.
    Blocks {
        odd: bool,
    },
}

impl Part {
    fn shows(self, pixel: [f64; 2]) -> bool {
        const BLOCK_PX: f64 = 64.0;
        match self {
            Self::All => true,
            Self::Blocks { odd } => {
                let [column, row] = pixel.map(|place| (place / BLOCK_PX).floor());
                ((column + row) % 2.0 != 0.0) == odd
            }
        }
    }
}

/// What one pair says.
#[derive(Debug)]
pub(super) struct PairSums {
    /// Indices of the terms that it knows of.
    pub(super) terms: Vec<usize>,
    pub(super) information: DMatrix<f64>,
    /// Downhill.
    pub(super) gradient: DVector<f64>,
    photo: Vec<f64>,
    depth: Vec<f64>,
}

/// The spots of the first of two frames that both show, in the part of the second that is looked at.
pub(super) fn looks([i, j]: [Side<'_>; 2], spots: &[Spot], how: &Looks) -> Vec<Option<Look>> {
    let look = |spot: &Spot| Look::new(i, j, spot, how.level, how.hidden_frac);
    spots.iter().map(|spot| look(spot).filter(|look| how.part.shows(look.pixel()))).collect()
}

/// The frames of a pair.
pub(super) fn sides<'a>(frames: &'a [Frame], views: &'a [View], pair: Pair) -> [Side<'a>; 2] {
    [pair.from, pair.to].map(|ix| Side { frame: &frames[ix], view: &views[ix] })
}

/// Gain and offset by weighted squares, weights by what was left before.
pub(super) fn tone<'a>(looks: impl Iterator<Item = &'a Look> + Clone, noise: f64) -> Tone {
    const ROUNDS: usize = 3;
    let mut tone = Tone { gain: 1.0, offset: 0.0 };
    for _ in 0..ROUNDS {
        // Normal equations of the changes of gain and offset.
        let (pull_gain, pull_offset) = ((noise / USUAL_GAIN).powi(2), (noise / USUAL_OFFSET).powi(2));
        let (mut xx, mut x, mut n) = (pull_gain, 0.0, pull_offset);
        let (mut xr, mut r) = (pull_gain * (1.0 - tone.gain), -pull_offset * tone.offset);
        for look in looks.clone() {
            let left = look.photo(tone);
            let weight = weight(left, noise);
            let [brightness, _] = look.brightness();
            xx += weight * brightness * brightness;
            x += weight * brightness;
            n += weight;
            xr += weight * brightness * left;
            r += weight * left;
        }
        let determinant = xx * n - x * x;
        tone.gain += (n * xr - x * r) / determinant;
        tone.offset += (xx * r - x * xr) / determinant;
    }
    tone
}

fn weight(residual: f64, noise: f64) -> f64 {
    1.0 / (1.0 + (residual / (CAUCHY * noise)).powi(2))
}

/// What every pair says about the terms of the views, in the order of the pairs.
pub(super) fn of_pairs(frames: &[Frame], views: &[View], pairs: &[Pair], how: &Looks) -> Vec<PairSums> {
    let of = |pair: &Pair| {
        let (i, j) = (&views[pair.from], &views[pair.to]);
        let mut terms = [i.terms(), j.terms()].concat();
        terms.sort_unstable();
        terms.dedup();
        let place = |term: usize| terms.partition_point(|known| *known < term);
        let placed = [Placed::new(i, place), Placed::new(j, place)];
        of_pair(sides(frames, views, *pair), &placed, terms.clone(), how)
    };
    pairs.par_iter().map(of).collect()
}

/// What every pair says about the motion of its two cameras: six numbers of the first, six of the second.
pub(super) fn of_free_pairs(frames: &[Frame], views: &[View], pairs: &[Pair], how: &Looks) -> Vec<PairSums> {
    let of = |pair: &Pair| {
        let placed = [Placed::free(&views[pair.from], 0), Placed::free(&views[pair.to], 6)];
        of_pair(sides(frames, views, *pair), &placed, (0..12).collect(), how)
    };
    pairs.par_iter().map(of).collect()
}

/// What a pair says about the motion of its second camera, where the first stays.
pub(super) fn of_second(sides: [Side<'_>; 2], how: &Looks) -> PairSums {
    let placed = [Placed::still(sides[0].view), Placed::free(sides[1].view, 0)];
    of_pair(sides, &placed, (0..6).collect(), how)
}

fn of_pair(sides: [Side<'_>; 2], [i, j]: &[Placed<'_>; 2], terms: Vec<usize>, how: &Looks) -> PairSums {
    let n = terms.len();
    let mut sums = PairSums {
        terms,
        information: DMatrix::zeros(n, n),
        gradient: DVector::zeros(n),
        photo: Vec::new(),
        depth: Vec::new(),
    };
    let looks: Vec<Look> = looks(sides, &sides[0].frame.spots, how).into_iter().flatten().collect();
    if looks.len() < LEAST_SPOTS {
        return sums;
    }
    let Noise { photo: photo_noise, depth: depth_noise } = how.noise;
    let tone = tone(looks.iter(), photo_noise);
    let (mut information, mut gradient) = (vec![0.0; (n + 2) * (n + 2)], vec![0.0; n + 2]);
    let mut row = vec![0.0; n + 2];
    let mut add = |row: &[f64], residual: f64, noise: f64| {
        let weight = weight(residual, noise) / (noise * noise);
        for (ix, slope) in row.iter().enumerate().filter(|(_, slope)| **slope != 0.0) {
            let scaled = weight * slope;
            gradient[ix] -= scaled * residual;
            for (sum, other) in information[ix * (n + 2)..][..=ix].iter_mut().zip(row) {
                *sum += scaled * other;
            }
        }
    };
    for look in &looks {
        let photo = look.photo(tone);
        look.photo_slopes(i, j, tone, &mut row);
        add(&row, photo, photo_noise);
        let depth = look.depth();
        look.depth_slopes(i, j, &mut row);
        add(&row, depth, depth_noise);
        sums.photo.push(photo.abs());
        sums.depth.push(depth.abs());
    }
    let at = |row: usize, column: usize| information[row.max(column) * (n + 2) + row.min(column)];
    // The Schur complement of gain and offset.
    let pull = [1.0 / (USUAL_GAIN * USUAL_GAIN), 1.0 / (USUAL_OFFSET * USUAL_OFFSET)];
    let [gg, go, oo] = [at(n, n) + pull[0], at(n + 1, n), at(n + 1, n + 1) + pull[1]];
    let determinant = gg * oo - go * go;
    let solved = |right: [f64; 2]| {
        [(oo * right[0] - go * right[1]) / determinant, (gg * right[1] - go * right[0]) / determinant]
    };
    for row in 0..n {
        let of_tone = solved([at(n, row), at(n + 1, row)]);
        sums.gradient[row] = gradient[row] - of_tone[0] * gradient[n] - of_tone[1] * gradient[n + 1];
        for column in 0..n {
            sums.information[(row, column)] =
                at(row, column) - of_tone[0] * at(n, column) - of_tone[1] * at(n + 1, column);
        }
    }
    sums
}

/// Scatter of the residuals of all pairs, by their median; none where nothing was seen.
pub(super) fn noise_of(sums: &[PairSums]) -> Option<Noise> {
    /// What a perfect sensor would be taken for: rounding to bytes and to a tenth of a millimetre.
    const LEAST: Noise = Noise { photo: 0.3, depth: 5e-5 };
    let scatter = |of: fn(&PairSums) -> &[f64]| {
        let mut all: Vec<f64> = sums.iter().flat_map(|pair| of(pair).iter().copied()).collect();
        let middle = all.len() / 2;
        (!all.is_empty()).then(|| 1.4826 * *all.select_nth_unstable_by(middle, f64::total_cmp).1)
    };
    Some(Noise {
        photo: scatter(|pair| &pair.photo)?.max(LEAST.photo),
        depth: scatter(|pair| &pair.depth)?.max(LEAST.depth),
    })
}
