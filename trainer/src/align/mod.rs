//! What is wrong with cameras, found before a scene is learned: pairs of keyframes with depth are laid over each other.
//!
//! Few causes explain most errors of poses: how a camera is mounted, by how much its poses lag, where joints have their zero, the
//! lens, where depth sits. Their effect on each pair of images is known, so a handful of numbers explains thousands of small
//! differences, by Gauss and Newton's steps from coarse to fine. A term stays when it predicts images better that were not
//! used for finding it; what the motion does not show is named and stays at zero.
//!
//! Pure functions of keyframes: no clock, no I/O, and sums in a fixed order however many threads there are.

mod beside;
mod corrections;
mod fit;
mod frame;
mod judge;
mod layout;
mod pairs;
mod poses;
mod report;
mod residual;
mod solve;
mod stand;
mod sums;
#[cfg(test)]
pub(crate) mod tests;
mod view;

pub use beside::beside_training;
pub(crate) use beside::{Aligning, taken_at};
pub use report::{Alignment, Found, Moved, Number, Unseen};
pub use stand::{Stand, stand};

use crate::splat::{CameraChoice, Candidate, TermSet, Trial};
use crate::{Keyframe, Split};
use corrections::Corrections;
use fit::Fit;
use frame::Frame;
use layout::Layout;
use pairs::Pair;
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::sync::Arc;
use sums::Part;

/// Frames that shared terms are found from, and partners of each.
const MOST_FRAMES: usize = 100;
const PARTNERS: usize = 4;
/// Selection images that decide, and fewest that can.
const MOST_JUDGES: usize = 32;
const LEAST_JUDGES: usize = 4;
const LEAST_PAIRS: usize = 4;
/// A correction below this many standard deviations is none.
const SURE: f64 = 3.0;

/// Frames and the pairs that are looked at.
struct Scene {
    frames: Vec<Frame>,
    cameras: Vec<Arc<str>>,
    /// For shared terms.
    pairs: Vec<Pair>,
    /// For poses of images: all that are learned from.
    all_pairs: Vec<Pair>,
    /// From images that are learned from to selection images.
    judging: Vec<Pair>,
}

/// What alignment can find, the likelier first.
pub fn candidates() -> Vec<TermSet> {
    vec![
        TermSet { mount: true, ..TermSet::NONE },
        TermSet { delay: true, ..TermSet::NONE },
        TermSet { joints: true, ..TermSet::NONE },
        TermSet { depth_pose: true, ..TermSet::NONE },
        TermSet { lens: true, ..TermSet::NONE },
        TermSet { depth_scale: true, ..TermSet::NONE },
        TermSet { readout: true, ..TermSet::NONE },
        TermSet { image_poses: true, ..TermSet::NONE },
    ]
}

/// Finds what is asked for; none where keyframes have no depth, or too few of them see the same.
///
/// Only keyframes for training are learned from, selection keyframes judge, test keyframes are not looked at.
pub fn align(keyframes: &[Arc<Keyframe>], choice: &CameraChoice) -> Option<Alignment> {
    let scene = Scene::new(keyframes, wants_poses(choice))?;
    let nothing = Model { set: TermSet::default(), fit: None, corrections: Corrections::none(scene.cameras.len()) };
    let (mut trials, mut unseen) = (Vec::new(), Vec::new());
    let kept = match choice {
        CameraChoice::Given(set) => {
            let with = scene.model(*set, &nothing)?;
            trials.push(scene.judge(*set, &nothing, &with));
            with
        }
        CameraChoice::Try(candidates) => scene.choose(candidates, nothing, &mut trials, &mut unseen),
    };
    if let Some(fit) = &kept.fit {
        unseen.extend(report::unseen(&scene, fit));
    }
    let kept = if kept.set.image_poses { scene.with_judges(kept) } else { kept };
    Some(report::alignment(&scene, &kept, trials, unseen))
}

fn wants_poses(choice: &CameraChoice) -> bool {
    match choice {
        CameraChoice::Given(set) => set.image_poses,
        CameraChoice::Try(candidates) => candidates.iter().any(|set| set.image_poses),
    }
}

/// Corrections of a set of terms.
struct Model {
    set: TermSet,
    /// Of the shared terms.
    fit: Option<Fit>,
    corrections: Corrections,
}

impl Scene {
    fn new(keyframes: &[Arc<Keyframe>], for_poses: bool) -> Option<Self> {
        let used: Vec<&Arc<Keyframe>> =
            keyframes.iter().filter(|keyframe| keyframe.split != Split::Test && keyframe.depth.is_some()).collect();
        let names: BTreeSet<Arc<str>> = used.iter().map(|keyframe| keyframe.camera.clone()).collect();
        let cameras: Vec<Arc<str>> = names.into_iter().collect();
        let camera_of = |keyframe: &Keyframe| cameras.partition_point(|name| *name < keyframe.camera);
        let frames: Vec<Frame> =
            used.par_iter().filter_map(|keyframe| Frame::new(keyframe, camera_of(keyframe))).collect();
        let of = |split: Split| -> Vec<usize> {
            (0..frames.len()).filter(|ix| frames[*ix].keyframe.split == split).collect()
        };
        let thinned = |ixs: &[usize], most: usize| -> Vec<usize> {
            let n = ixs.len().min(most);
            (0..n).map(|ix| ixs[ix * ixs.len() / n]).collect()
        };
        let (train, judges) = (of(Split::Train), of(Split::Selection));
        let views = Corrections::none(cameras.len()).views(&frames, &Layout::default());
        let some = thinned(&train, MOST_FRAMES);
        let pairs = pairs::choose(&frames, &views, &some, &some, PARTNERS);
        let all_pairs = match for_poses && some.len() < train.len() {
            true => pairs::choose(&frames, &views, &train, &train, PARTNERS),
            false => pairs.clone(),
        };
        let judging = pairs::choose(&frames, &views, &some, &thinned(&judges, MOST_JUDGES), PARTNERS);
        (pairs.len() >= LEAST_PAIRS).then_some(Self { frames, cameras, pairs, all_pairs, judging })
    }

    /// The corrections of a set of terms, starting from those of another.
    fn model(&self, set: TermSet, from: &Model) -> Option<Model> {
        let shared = TermSet { image_poses: false, image_gains: false, ..set };
        let layout = Layout::new(shared, &self.frames, self.cameras.len());
        let mut fit = None;
        let mut corrections = self.only(&layout, &from.corrections);
        if layout.n() > 0 {
            let found = fit::fit(&self.frames, &self.pairs, layout, &corrections)?;
            corrections = found.corrections.clone();
            fit = Some(found);
        }
        if set.image_poses {
            corrections = poses::fit(&self.frames, &self.all_pairs, &corrections)?;
        }
        Some(Model { set, fit, corrections })
    }

    /// Gives selection images poses of their own, too, when all is decided: they are learned from later.
    fn with_judges(&self, mut model: Model) -> Model {
        let of = |split: Split| -> Vec<usize> {
            (0..self.frames.len()).filter(|ix| self.frames[*ix].keyframe.split == split).collect()
        };
        let views = model.corrections.views(&self.frames, &Layout::default());
        let own = |to: &usize| {
            let pairs = pairs::choose(&self.frames, &views, &of(Split::Train), &[*to], PARTNERS);
            let frame = &self.frames[*to];
            let fix = poses::fit_one(&self.frames, &views, &pairs, &model.corrections.fixes[frame.camera], Part::All)?;
            Some((frame.camera, frame.keyframe.stamp.0, fix.drift_at(frame.keyframe.stamp)))
        };
        let found: Vec<_> = of(Split::Selection).par_iter().filter_map(own).collect();
        for (camera, stamp, drift) in found {
            model.corrections.fixes[camera].drift.insert(stamp, drift);
        }
        model
    }

    /// What given corrections say about the terms of a layout, and nothing about others.
    fn only(&self, layout: &Layout, given: &Corrections) -> Corrections {
        let mut only = Corrections::none(self.cameras.len());
        let values = layout.terms.iter().map(|term| given.value(*term));
        only.take(layout, &nalgebra::DVector::from_iterator(layout.n(), values));
        only
    }

    /// Adds one candidate after the other where it pays, then takes away what no longer does.
    ///
    /// A hand-eye transform that is not corrected may be wrong all the same where the motion does not show it: that is added to `unseen`.
    fn choose(
        &self,
        candidates: &[TermSet],
        nothing: Model,
        trials: &mut Vec<Trial>,
        unseen: &mut Vec<Unseen>,
    ) -> Model {
        let mut kept = nothing;
        let mut parts: Vec<TermSet> = Vec::new();
        for candidate in candidates {
            let layout = Layout::new(*candidate, &self.frames, self.cameras.len());
            if layout.n() == 0 && !candidate.image_poses {
                continue;
            }
            let Some(with) = self.model(kept.set.and(*candidate), &kept) else { continue };
            let mut trial = self.judge(*candidate, &kept, &with);
            trial.kept &= candidate.image_poses || with.is_sure_of(&layout);
            if trial.kept {
                parts.push(*candidate);
                kept = with;
            } else if candidate.mount {
                unseen.extend(with.fit.iter().flat_map(|fit| report::unseen(self, fit)));
            }
            trials.push(trial);
        }
        for part in parts.clone().into_iter().rev().skip(1) {
            let rest =
                parts.iter().filter(|other| **other != part).fold(TermSet::default(), |set, other| set.and(*other));
            let Some(without) = self.model(rest, &kept) else { continue };
            let trial = self.judge(part, &without, &kept);
            if !trial.kept {
                parts.retain(|other| *other != part);
                trials.retain(|earlier| earlier.candidate != Candidate::Cameras(part));
                trials.push(trial);
                kept = without;
            }
        }
        kept
    }

    /// How much better a set of terms predicts the selection images.
    fn judge(&self, terms: TermSet, without: &Model, with: &Model) -> Trial {
        let noise = with.fit.as_ref().map_or(sums::Noise { photo: 5.0, depth: 0.005 }, |fit| fit.noise);
        let compared = judge::Compared {
            frames: &self.frames,
            pairs: &self.judging,
            without: &without.corrections,
            with: &with.corrections,
            noise,
        };
        let trial = |(without_db, with_db): (Vec<f64>, Vec<f64>)| {
            log::debug!("alignment: {terms}: without {without_db:.2?}, with {with_db:.2?} dB");
            let mut trial = Trial::of(Candidate::Cameras(terms), &without_db, &with_db);
            trial.kept &= trial.n_images >= LEAST_JUDGES;
            trial
        };
        match (terms.image_poses, without.set.image_poses) {
            (true, _) => trial(compared.own_scores()),
            (false, false) => trial(compared.scores()),
            // Images that move on their own hide what all share: it goes only where neither way shows it.
            (false, true) => Some(trial(compared.scores()))
                .filter(|trial| trial.kept)
                .unwrap_or_else(|| trial(compared.own_scores())),
        }
    }
}

impl Model {
    /// Whether any of the terms is clearly not zero.
    fn is_sure_of(&self, terms: &Layout) -> bool {
        let Some(fit) = &self.fit else { return false };
        let is_sure = |ix: usize| {
            let value = self.corrections.value(fit.layout.terms[ix]);
            value.abs() > SURE * fit.solved.sigma(ix) && fit.solved.unseen_share(ix) < 0.5
        };
        (0..fit.layout.n()).any(|ix| terms.terms.contains(&fit.layout.terms[ix]) && is_sure(ix))
    }
}
