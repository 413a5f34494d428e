//! Whether corrections pay: selection images predicted from training images, with them and without.

use super::corrections::Corrections;
use super::frame::Frame;
use super::layout::Layout;
use super::pairs::Pair;
use super::poses;
use super::residual::{Look, Side};
use super::sums::{self, Looks, Noise, Part};
use super::view::View;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Differences beyond this are another surface's or a highlight, of 255.
const CLIP: f64 = 50.0;
/// Noise of an image, of 255: what lies below it does not show in pictures. The blurred images that are compared have less.
const IMAGE_NOISE: f64 = 2.0;
const HIDDEN_FRAC: f64 = 0.04;
/// Fewer spots make no score.
const LEAST_SPOTS: usize = 30;

/// What is compared: selection images as their partners predict them, without a correction and with it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Compared<'a> {
    pub(super) frames: &'a [Frame],
    /// From training images to selection images.
    pub(super) pairs: &'a [Pair],
    pub(super) without: &'a Corrections,
    pub(super) with: &'a Corrections,
    pub(super) noise: Noise,
}

/// Spots, and squares of what is left without and with.
type Errors = (usize, f64, f64);

impl Compared<'_> {
    /// PSNR, dB, of each selection image where the corrections have it, without and with: at the same spots.
    pub(super) fn scores(&self) -> (Vec<f64>, Vec<f64>) {
        scores(self.frames, self.pairs, &self.views(), self.noise, |pair| pair.to)
    }

    /// The same where each selection image has a pose of its own, found on one half of its blocks and scored on the other, and
    /// the other way round.
    ///
    /// This asks whether the training images agree better with each other: from images that are apart no single pose fits what
    /// all of them predict. To ask nothing else, the selection image may move without the correction just as with it: by the same
    /// residuals, prior and number of steps, towards the same partners, and both are scored at the spots that both show. So the
    /// freedom of a pose is on both sides, what it learns from noise costs it on the half that it has not seen, and it never
    /// matters whether the selection image's own pose can be guessed. The correction itself has seen nothing of these images.
    pub(super) fn own_scores(&self) -> (Vec<f64>, Vec<f64>) {
        let views = self.views();
        let mut by_image: BTreeMap<usize, Vec<Pair>> = BTreeMap::new();
        for pair in self.pairs {
            by_image.entry(pair.to).or_default().push(*pair);
        }
        let images: Vec<(usize, Vec<Pair>)> = by_image.into_iter().collect();
        let of_half = |to: usize, pairs: &[Pair], odd: bool| {
            let frame = &self.frames[to];
            let own = |corrections: &Corrections, views: &[View]| {
                let fix = &corrections.fixes[frame.camera];
                let fix = poses::fit_one(self.frames, views, pairs, fix, Part::Blocks { odd })?;
                View::new(frame, &fix, &Layout::default())
            };
            let own = [own(self.without, &views[0])?, own(self.with, &views[1])?];
            let mut sum = Errors::default();
            for pair in pairs {
                let from = |ix: usize| Side { frame: &self.frames[pair.from], view: &views[ix][pair.from] };
                let sides = [0, 1].map(|ix| [from(ix), Side { frame, view: &own[ix] }]);
                add(&mut sum, errors(sides, self.noise, Part::Blocks { odd: !odd }));
            }
            Some(sum)
        };
        let of = |(to, pairs): &(usize, Vec<Pair>)| {
            let mut sum = of_half(*to, pairs, false)?;
            add(&mut sum, of_half(*to, pairs, true)?);
            (sum.0 > LEAST_SPOTS).then(|| psnr(sum))
        };
        images.par_iter().filter_map(of).collect::<Vec<_>>().into_iter().unzip()
    }

    fn views(&self) -> [Vec<View>; 2] {
        [self.without, self.with].map(|corrections| corrections.views(self.frames, &Layout::default()))
    }
}

/// PSNR, dB, of the images that judge, under two sets of cameras: at the same spots.
///
/// * `judge_of`: which image a pair tells of.
pub(super) fn scores(
    frames: &[Frame],
    pairs: &[Pair],
    views: &[Vec<View>; 2],
    noise: Noise,
    judge_of: impl Fn(&Pair) -> usize + Sync,
) -> (Vec<f64>, Vec<f64>) {
    let of = |pair: &Pair| {
        let sides = [0, 1].map(|ix: usize| sums::sides(frames, &views[ix], *pair));
        (judge_of(pair), errors(sides, noise, Part::All))
    };
    let errors: Vec<(usize, Errors)> = pairs.par_iter().map(of).collect();
    let mut by_image: BTreeMap<usize, Errors> = BTreeMap::new();
    for (judge, errors) in errors.into_iter().filter(|(_, (n, ..))| *n > LEAST_SPOTS) {
        add(by_image.entry(judge).or_default(), errors);
    }
    by_image.into_values().map(psnr).unzip()
}

/// Of a pair, without and with, at the spots that both show.
fn errors(sides: [[Side<'_>; 2]; 2], noise: Noise, part: Part) -> Errors {
    let how = Looks { level: 0, hidden_frac: HIDDEN_FRAC, noise, part };
    let looks = sides.map(|sides| sums::looks(sides, &sides[0].frame.even_spots, &how));
    let both = || looks[0].iter().zip(&looks[1]).filter_map(|(one, other)| one.as_ref().zip(other.as_ref()));
    let sum = |looks: Vec<&Look>| {
        let tone = sums::tone(looks.iter().copied(), noise.photo);
        looks.iter().map(|look| look.photo(tone).clamp(-CLIP, CLIP).powi(2)).sum::<f64>()
    };
    (both().count(), sum(both().map(|(one, _)| one).collect()), sum(both().map(|(_, other)| other).collect()))
}

fn add(sum: &mut Errors, errors: Errors) {
    *sum = (sum.0 + errors.0, sum.1 + errors.1, sum.2 + errors.2);
}

fn psnr((n, without, with): Errors) -> (f64, f64) {
    let psnr = |squares: f64| 10.0 * (255.0 * 255.0 / (squares / n as f64 + IMAGE_NOISE * IMAGE_NOISE)).log10();
    (psnr(without), psnr(with))
}
