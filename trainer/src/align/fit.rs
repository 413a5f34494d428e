//! Shared terms from coarse to fine.

use super::corrections::Corrections;
use super::frame::Frame;
use super::layout::Layout;
use super::pairs::Pair;
use super::solve::Solved;
use super::sums::{self, Looks, Noise, Part};
use nalgebra::DVector;

/// Steps at each level, the finest first.
const ROUNDS: [usize; 4] = [12, 4, 4, 4];
/// By how much of its depth a point may be off before it counts as hidden, the finest first: errors are large at first.
pub(super) const HIDDEN_FRAC: [f64; 4] = [0.04, 0.05, 0.07, 0.1];
/// A step below this many standard deviations ends a level.
const SMALL_STEP: [f64; 4] = [0.2, 2.0, 2.0, 2.0];
pub(super) const FIRST_NOISE: Noise = Noise { photo: 20.0, depth: 0.005 };

/// What came of a fit.
#[derive(Debug)]
pub(super) struct Fit {
    pub(super) corrections: Corrections,
    pub(super) layout: Layout,
    pub(super) solved: Solved,
    pub(super) noise: Noise,
}

/// Finds the terms of a layout, from given corrections on; none where the pairs show nothing.
pub(super) fn fit(frames: &[Frame], pairs: &[Pair], layout: Layout, from: &Corrections) -> Option<Fit> {
    let mut corrections = from.clone();
    let n_levels = frames.iter().map(|frame| frame.levels.len()).max()?;
    let mut how =
        Looks { level: n_levels - 1, hidden_frac: HIDDEN_FRAC[n_levels - 1], noise: FIRST_NOISE, part: Part::All };
    how.noise = sums::noise_of(&sums::of_pairs(frames, &corrections.views(frames, &layout), pairs, &how))?;
    let mut last = None;
    for level in (0..n_levels).rev() {
        (how.level, how.hidden_frac) = (level, HIDDEN_FRAC[level]);
        // Coarse levels only have to come near: a part of the pairs does.
        let stride = if level == 0 { 1 } else { pairs.len().div_ceil(120).max(1) };
        let some: Vec<Pair> = pairs.iter().copied().step_by(stride).collect();
        for _ in 0..ROUNDS[level] {
            let sums = sums::of_pairs(frames, &corrections.views(frames, &layout), &some, &how);
            how.noise = sums::noise_of(&sums)?;
            let scales = layout.terms.iter().map(|term| term.scale());
            let values = layout.terms.iter().map(|term| corrections.value(*term));
            let [scales, values] = [scales.collect::<Vec<f64>>(), values.collect()].map(DVector::from);
            let solved = Solved::new(scales, &values, &some, &sums);
            corrections.take(&layout, &solved.step);
            log::debug!("alignment: level {level}, {:?}, step of {:.2} sigma", how.noise, solved.step_in_sigmas());
            let is_small = solved.step_in_sigmas() < SMALL_STEP[level];
            last = Some(solved);
            if is_small {
                break;
            }
        }
    }
    Some(Fit { corrections, layout, solved: last?, noise: how.noise })
}
