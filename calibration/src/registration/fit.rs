//! Coarse-to-fine estimation of the parameters that images share, such as the extrinsics.

use super::corrections::Corrections;
use super::layout::Layout;
use super::pairs::Pair;
use super::prepared_image::PreparedImage;
use super::solve::Solution;
use super::sums::{self, Noise, PairSums, PixelSubset, ResidualOptions};
use nalgebra::DVector;

/// Maximum number of steps at each level, the finest first. Coarse levels only bring the estimate
/// into the range in which the next level converges.
const MAX_ITERATIONS: [usize; 4] = [12, 4, 4, 4];
/// Relative depth error above which a point counts as occluded, the finest level first. It is
/// larger at coarse levels, where poses still have larger errors.
pub(super) const OCCLUSION_FRAC: [f64; 4] = [0.04, 0.05, 0.07, 0.1];
/// A step smaller than this number of standard deviations ends a level. The value of the finest
/// level comes first. Further steps would be smaller than the error of the result.
const CONVERGED_STEP_SIGMAS: [f64; 4] = [0.2, 2.0, 2.0, 2.0];
/// Noise for the first residuals. An estimate replaces it afterwards, so it must only be large
/// enough not to reject many of the first residuals.
pub(super) const INITIAL_NOISE: Noise = Noise {
    photo: 20.0,
    depth: 0.005,
};

/// Result of a fit.
#[derive(Debug)]
pub(super) struct Fit {
    pub(super) corrections: Corrections,
    pub(super) layout: Layout,
    pub(super) solution: Solution,
    pub(super) noise: Noise,
}

impl Fit {
    /// Adds the discretization error to the covariance. All pairs share this error, so the scatter
    /// between pairs does not contain it. The size of the error is estimated by repeating the
    /// estimate at the next coarser level, where pixels are twice as large. If the error grows at
    /// least linearly with the pixel size, the error at the finest level is at most as large as the
    /// change of the result. The error may have another direction than the change, because it is a
    /// sum of errors that grow with different powers of the pixel size.
    pub(super) fn add_discretization_error(&mut self, images: &[PreparedImage], pairs: &[Pair]) {
        // Steps at level 1 start from the result of level 0 and continue until they are small. The
        // change is the sum of these steps.
        const LEVEL: usize = 1;
        if images.iter().all(|image| image.levels.len() <= LEVEL) {
            return;
        }
        let mut options = ResidualOptions {
            level: LEVEL,
            occlusion_frac: OCCLUSION_FRAC[LEVEL],
            noise: self.noise,
            part: PixelSubset::All,
        };
        let mut corrections = self.corrections.clone();
        let mut change = DVector::zeros(self.layout.n());
        for _ in 0..MAX_ITERATIONS[LEVEL] {
            let sums = sums::of_pairs(
                images,
                &corrections.views(images, &self.layout),
                pairs,
                &options,
            );
            let Some(noise) = sums::noise_of(&sums) else {
                return;
            };
            options.noise = noise;
            let solution = step(&self.layout, &corrections, pairs, &sums);
            corrections.apply_step(&self.layout, &solution.step);
            change += &solution.step;
            if solution.step_in_sigmas() < CONVERGED_STEP_SIGMAS[0] {
                break;
            }
        }
        self.solution.add_error(&change);
    }
}

/// A Gauss-Newton step from the given corrections.
fn step(layout: &Layout, corrections: &Corrections, pairs: &[Pair], sums: &[PairSums]) -> Solution {
    let scales = layout.params.iter().map(|param| param.scale());
    let values = layout.params.iter().map(|param| corrections.value(*param));
    let [scales, values] = [scales.collect::<Vec<f64>>(), values.collect()].map(DVector::from);
    Solution::new(scales, &values, pairs, sums)
}

/// Estimates the parameters of a layout, starting from given corrections. Returns `None` if the
/// pairs have no valid residuals.
pub(super) fn fit(
    images: &[PreparedImage],
    pairs: &[Pair],
    layout: Layout,
    start: &Corrections,
) -> Option<Fit> {
    let mut corrections = start.clone();
    let n_levels = images.iter().map(|image| image.levels.len()).max()?;
    let mut options = ResidualOptions {
        level: n_levels - 1,
        occlusion_frac: OCCLUSION_FRAC[n_levels - 1],
        noise: INITIAL_NOISE,
        part: PixelSubset::All,
    };
    options.noise = sums::noise_of(&sums::of_pairs(
        images,
        &corrections.views(images, &layout),
        pairs,
        &options,
    ))?;
    let mut last = None;
    for level in (0..n_levels).rev() {
        options.level = level;
        options.occlusion_frac = OCCLUSION_FRAC[level];
        // At coarse levels, an approximate result from a subset of the pairs is sufficient.
        let stride = if level == 0 {
            1
        } else {
            pairs.len().div_ceil(120).max(1)
        };
        let subset: Vec<Pair> = pairs.iter().copied().step_by(stride).collect();
        for _ in 0..MAX_ITERATIONS[level] {
            let sums = sums::of_pairs(
                images,
                &corrections.views(images, &layout),
                &subset,
                &options,
            );
            // As the images become aligned, the noise decreases, and so does the limit above which
            // residuals count as outliers.
            options.noise = sums::noise_of(&sums)?;
            let solution = step(&layout, &corrections, &subset, &sums);
            corrections.apply_step(&layout, &solution.step);
            log::debug!(
                "alignment: level {level}, {:?}, step of {:.2} sigma",
                options.noise,
                solution.step_in_sigmas()
            );
            let is_small = solution.step_in_sigmas() < CONVERGED_STEP_SIGMAS[level];
            last = Some(solution);
            if is_small {
                break;
            }
        }
    }
    Some(Fit {
        corrections,
        layout,
        solution: last?,
        noise: options.noise,
    })
}
