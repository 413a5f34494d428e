//! Evaluation of corrections: predicts validation images from training images with and without the
//! corrections.

use super::corrections::Corrections;
use super::layout::Layout;
use super::pairs::Pair;
use super::poses;
use super::prepared_image::PreparedImage;
use super::residual::{Correspondence, Side};
use super::sums::{self, Noise, PixelSubset, ResidualOptions};
use super::view::CorrectedView;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Maximum brightness difference that counts, on a scale of 0 to 255. Larger differences come from
/// other surfaces or highlights.
const CLIP: f64 = 50.0;
/// Noise whose square is added to each squared difference, on a scale of 0 to 255. Differences
/// below the noise of a camera image then do not count. Without this value, they would count,
/// because the compared images are blurred and thus have less noise than a camera image.
const IMAGE_NOISE: f64 = 2.0;
/// Relative depth difference above which a sample counts as occluded, as at the finest level of
/// registration.
const OCCLUSION_FRAC: f64 = 0.04;
/// Minimum number of samples of a score. With fewer samples, the scores of images differ mostly by
/// noise.
const MIN_SAMPLES: usize = 30;

/// A comparison of the predictions of validation images without (baseline) and with (variant) a
/// correction.
#[derive(Clone, Copy, Debug)]
pub(super) struct PairedComparison<'a> {
    pub(super) images: &'a [PreparedImage],
    /// Pairs from training images to validation images.
    pub(super) pairs: &'a [Pair],
    pub(super) baseline: &'a Corrections,
    pub(super) variant: &'a Corrections,
    pub(super) noise: Noise,
}

/// Number of samples, and sums of squared residuals of the baseline and the variant.
type PairedErrors = (usize, f64, f64);

/// PSNR of one validation image.
#[derive(Clone, Copy, Debug)]
pub(super) struct ImageScore {
    pub(super) image_ix: usize,
    pub(super) baseline_db: f64,
    pub(super) variant_db: f64,
}

impl ImageScore {
    fn new(image_ix: usize, errors: PairedErrors) -> Self {
        let (baseline_db, variant_db) = psnr(errors);
        Self {
            image_ix,
            baseline_db,
            variant_db,
        }
    }
}

impl PairedComparison<'_> {
    /// PSNR in dB of each validation image for baseline and variant, at the same samples.
    pub(super) fn scores(&self) -> Vec<ImageScore> {
        image_scores(self.images, self.pairs, &self.views(), self.noise, |pair| {
            pair.to
        })
    }

    /// Like [`Self::scores`], but each validation image gets an individual pose, which is estimated
    /// on one half of its blocks and evaluated on the other half. Then the halves swap roles.
    ///
    /// This tests whether the variant makes the training images more consistent with each other. If
    /// the training images are misaligned, no single pose of the validation image fits the
    /// predictions from all of them. The test must not depend on anything else. The individual pose
    /// is therefore estimated for the baseline and for the variant, with the same residuals, prior,
    /// number of steps and partners. Baseline and variant are evaluated at the samples that both of
    /// them show. As a result, both have the same freedom, and the accuracy of the validation
    /// image's own pose does not matter. Overfitting to noise lowers the score on the other half.
    /// The correction itself was not estimated from the validation images.
    pub(super) fn scores_with_free_poses(&self) -> Vec<ImageScore> {
        let views = self.views();
        let mut by_image: BTreeMap<usize, Vec<Pair>> = BTreeMap::new();
        for pair in self.pairs {
            by_image.entry(pair.to).or_default().push(*pair);
        }
        let pairs_of_images: Vec<Vec<Pair>> = by_image.into_values().collect();
        pairs_of_images
            .par_iter()
            .filter_map(|pairs| {
                let mut sum = self.errors_on_half(&views, pairs, false)?;
                add_errors(&mut sum, self.errors_on_half(&views, pairs, true)?);
                (sum.0 > MIN_SAMPLES).then(|| ImageScore::new(pairs[0].to, sum))
            })
            .collect()
    }

    /// Errors on the even or odd blocks of an image, with a pose that is fitted to the other
    /// blocks. All pairs lead to this image.
    fn errors_on_half(
        &self,
        views: &[Vec<CorrectedView>; 2],
        pairs: &[Pair],
        fitted_is_odd: bool,
    ) -> Option<PairedErrors> {
        let fitted = PixelSubset::Blocks { odd: fitted_is_odd };
        let evaluated = PixelSubset::Blocks {
            odd: !fitted_is_odd,
        };
        let image = &self.images[pairs.first()?.to];
        let own_views = [
            self.with_own_pose(self.baseline, &views[0], pairs, fitted)?,
            self.with_own_pose(self.variant, &views[1], pairs, fitted)?,
        ];
        let mut sum = PairedErrors::default();
        for pair in pairs {
            let sides = [0, 1].map(|ix: usize| {
                let from = Side {
                    image: &self.images[pair.from],
                    view: &views[ix][pair.from],
                };
                let to = Side {
                    image,
                    view: &own_views[ix],
                };
                [from, to]
            });
            add_errors(&mut sum, errors(sides, self.noise, evaluated));
        }
        Some(sum)
    }

    /// View of the image that all pairs lead to, with a pose that is fitted to some of its pixels.
    fn with_own_pose(
        &self,
        corrections: &Corrections,
        views: &[CorrectedView],
        pairs: &[Pair],
        fitted: PixelSubset,
    ) -> Option<CorrectedView> {
        let image = &self.images[pairs.first()?.to];
        let correction = &corrections.by_camera[image.camera];
        let correction = poses::fit_one(self.images, views, pairs, correction, fitted)?;
        CorrectedView::new(image, &correction, &Layout::default())
    }

    fn views(&self) -> [Vec<CorrectedView>; 2] {
        [self.baseline, self.variant]
            .map(|corrections| corrections.views(self.images, &Layout::default()))
    }
}

/// PSNR in dB of the validation images with two sets of views, at the same samples.
///
/// * `validation_image_of`: returns the validation image of a pair.
pub(super) fn scores(
    images: &[PreparedImage],
    pairs: &[Pair],
    views: &[Vec<CorrectedView>; 2],
    noise: Noise,
    validation_image_of: impl Fn(&Pair) -> usize + Sync,
) -> (Vec<f64>, Vec<f64>) {
    let scores = image_scores(images, pairs, views, noise, validation_image_of);
    scores
        .into_iter()
        .map(|score| (score.baseline_db, score.variant_db))
        .unzip()
}

/// [`scores`] with the indices of the images.
fn image_scores(
    images: &[PreparedImage],
    pairs: &[Pair],
    views: &[Vec<CorrectedView>; 2],
    noise: Noise,
    validation_image_of: impl Fn(&Pair) -> usize + Sync,
) -> Vec<ImageScore> {
    let score_of = |pair: &Pair| {
        let sides = [0, 1].map(|ix: usize| sums::sides(images, &views[ix], *pair));
        (
            validation_image_of(pair),
            errors(sides, noise, PixelSubset::All),
        )
    };
    let errors: Vec<(usize, PairedErrors)> = pairs.par_iter().map(score_of).collect();
    let mut by_image: BTreeMap<usize, PairedErrors> = BTreeMap::new();
    for (validation_ix, errors) in errors.into_iter().filter(|(_, (n, ..))| *n > MIN_SAMPLES) {
        add_errors(by_image.entry(validation_ix).or_default(), errors);
    }
    by_image
        .into_iter()
        .map(|(image_ix, errors)| ImageScore::new(image_ix, errors))
        .collect()
}

/// Gain of the prediction of an image if its view is replaced, dB. `None` if too few samples are
/// visible. All pairs must end at this image.
pub(super) fn gain_db(
    images: &[PreparedImage],
    views: &[CorrectedView],
    pairs: &[Pair],
    replaced: &CorrectedView,
    noise: Noise,
) -> Option<f64> {
    let mut sum = PairedErrors::default();
    for pair in pairs {
        let [from, to] = sums::sides(images, views, *pair);
        let sides = [
            [from, to],
            [
                from,
                Side {
                    view: replaced,
                    ..to
                },
            ],
        ];
        add_errors(&mut sum, errors(sides, noise, PixelSubset::All));
    }
    let (baseline, variant) = psnr(sum);
    (sum.0 > MIN_SAMPLES).then_some(variant - baseline)
}

/// Errors of a pair with baseline and variant, at the samples that both show.
fn errors(sides: [[Side<'_>; 2]; 2], noise: Noise, part: PixelSubset) -> PairedErrors {
    let options = ResidualOptions {
        level: 0,
        occlusion_frac: OCCLUSION_FRAC,
        noise,
        part,
    };
    let correspondences =
        sides.map(|sides| sums::correspondences(sides, &sides[0].image.uniform_samples, &options));
    // Samples that only the baseline or only the variant shows are left out. Otherwise, the
    // comparison would also depend on which samples are visible.
    let (baseline, variant): (Vec<&Correspondence>, Vec<&Correspondence>) = correspondences[0]
        .iter()
        .zip(&correspondences[1])
        .filter_map(|(one, other)| one.as_ref().zip(other.as_ref()))
        .unzip();
    (
        baseline.len(),
        squares(&baseline, noise.photo),
        squares(&variant, noise.photo),
    )
}

/// Sum of squared brightness differences after the exposures of the two images are matched.
fn squares(correspondences: &[&Correspondence], photo_noise: f64) -> f64 {
    let tone = sums::tone(correspondences.iter().copied(), photo_noise);
    correspondences
        .iter()
        .map(|correspondence| correspondence.photo(tone).clamp(-CLIP, CLIP).powi(2))
        .sum::<f64>()
}

fn add_errors(sum: &mut PairedErrors, errors: PairedErrors) {
    *sum = (sum.0 + errors.0, sum.1 + errors.1, sum.2 + errors.2);
}

/// PSNR of baseline and variant, dB.
fn psnr((n, baseline, variant): PairedErrors) -> (f64, f64) {
    let psnr = |squares: f64| {
        10.0 * (255.0 * 255.0 / (squares / n as f64 + IMAGE_NOISE * IMAGE_NOISE)).log10()
    };
    (psnr(baseline), psnr(variant))
}
