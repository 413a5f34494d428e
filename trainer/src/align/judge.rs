//! Whether corrections pay: selection images predicted from training images, with them and without.

use super::corrections::Corrections;
use super::frame::Frame;
use super::layout::Layout;
use super::pairs::Pair;
use super::residual::Look;
use super::sums::{self, Looks, Noise};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Differences beyond this are another surface's or a highlight, of 255.
const CLIP: f64 = 50.0;
/// Noise of an image, of 255: what lies below it does not show in pictures. The blurred images that are compared have less.
const IMAGE_NOISE: f64 = 2.0;
const HIDDEN_FRAC: f64 = 0.04;
/// Fewer spots make no score.
const LEAST_SPOTS: usize = 30;

/// PSNR, dB, of each selection image as its partners predict it, without and with: at the same spots.
pub(super) fn scores(
    frames: &[Frame],
    pairs: &[Pair],
    without: &Corrections,
    with: &Corrections,
    noise: Noise,
) -> (Vec<f64>, Vec<f64>) {
    let how = Looks { level: 0, hidden_frac: HIDDEN_FRAC, noise };
    let views = [without, with].map(|corrections| corrections.views(frames, &Layout::default()));
    let errors = |pair: &Pair| {
        let spots = &frames[pair.from].even_spots;
        let looks = [0, 1].map(|ix: usize| sums::looks(frames, &views[ix], *pair, spots, &how));
        let both = || looks[0].iter().zip(&looks[1]).filter_map(|(one, other)| one.as_ref().zip(other.as_ref()));
        let sum = |looks: Vec<&Look>| {
            let tone = sums::tone(looks.iter().copied(), noise.photo);
            looks.iter().map(|look| look.photo(tone).clamp(-CLIP, CLIP).powi(2)).sum::<f64>()
        };
        let n = both().count();
        (pair.to, n, sum(both().map(|(one, _)| one).collect()), sum(both().map(|(_, other)| other).collect()))
    };
    let errors: Vec<(usize, usize, f64, f64)> = pairs.par_iter().map(errors).collect();
    let mut by_image: BTreeMap<usize, (usize, f64, f64)> = BTreeMap::new();
    for (to, n, without, with) in errors.into_iter().filter(|(_, n, _, _)| *n > LEAST_SPOTS) {
        let sums = by_image.entry(to).or_default();
        *sums = (sums.0 + n, sums.1 + without, sums.2 + with);
    }
    let psnr =
        |n: usize, squares: f64| 10.0 * (255.0 * 255.0 / (squares / n as f64 + IMAGE_NOISE * IMAGE_NOISE)).log10();
    by_image.into_values().map(|(n, without, with)| (psnr(n, without), psnr(n, with))).unzip()
}
