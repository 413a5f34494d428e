//! Where a base that walks came to stand: what its camera sees there is laid over what it saw before.
//!
//! The six numbers of the base's pose are found like the terms of cameras: spots with depth of one image in another, differences
//! of brightness and depth, Gauss and Newton's steps from coarse to fine. A pair has one image of the new stand and one of
//! earlier ones; which of both shows the other's spots does not matter, for a near view lies within a far one and not the other
//! way round.

use super::corrections::Corrections;
use super::fit::{FIRST_NOISE, HIDDEN_FRAC};
use super::frame::Frame;
use super::judge;
use super::layout::Layout;
use super::pairs::{self, Pair};
use super::solve::Solved;
use super::sums::{self, Looks, Noise, Part};
use super::view::View;
use super::{LEAST_JUDGES, LEAST_PAIRS, MOST_FRAMES, PARTNERS, SURE};
use crate::splat::{Candidate, TermSet, Trial};
use crate::{Keyframe, Split};
use kinematics::Transform;
use nalgebra::{DVector, UnitQuaternion, Vector3};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeSet;
use std::sync::Arc;

/// How large an error of the base's pose may be before one would call it a mistake, metres and radians.
const USUAL_SHIFT_M: f64 = 0.02;
const USUAL_TURN_RAD: f64 = 0.0175;

/// Most steps at each level: weights that change with the residuals make the way slower than Gauss and Newton's.
const MOST_ROUNDS: usize = 20;
/// A step below this many standard deviations ends a level, the finest first.
const SMALL_STEP: [f64; 4] = [0.1, 0.3, 0.3, 0.3];
/// Brightness errs in the same way in all pairs across two stands, near what hides other things and where light is reflected, and
/// depth does not: by so many times its scatter it is taken to be less sure.
const BRIGHTNESS_ERRS: f64 = 4.0;

/// What the source of a base's poses got wrong on the way to a stand. Deviations are standard ones.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Stand {
    /// The base stands so far from where its source has it, metres, along the axes of the world.
    pub shift_m: [f64; 3],
    /// Metres.
    pub shift_sigma_m: [f64; 3],
    /// It is turned so, about its own place: a rotation vector in the axes of the world, radians.
    pub turn_rad: [f64; 3],
    /// Radians.
    pub turn_sigma_rad: [f64; 3],
    /// Directions that the images do not show, in words; nothing was found along them.
    pub unseen: Vec<String>,
    /// How much better the corrected poses predict selection images across the stands, dB.
    pub gain_db: f64,
    /// Its standard error, dB.
    pub standard_error_db: f64,
    /// Selection images that judged.
    pub n_judges: usize,
    /// Pairs of images that were compared.
    pub n_pairs: usize,
    /// Whether it is clearly not zero and pays.
    pub kept: bool,
}

/// Finds where a base stands from the keyframes of the new stand (`new`) and of earlier ones (`seen`); none where they have no depth, or
/// too few of them see the same.
///
/// Training keyframes are learned from, selection keyframes judge, test keyframes are not looked at.
///
/// * `world_from_base`: the pose of the base that the keyframes of the new stand were placed with.
pub fn stand(seen: &[Arc<Keyframe>], new: &[Arc<Keyframe>], world_from_base: &Transform) -> Option<Stand> {
    let scene = Scene::new(seen, new, world_from_base)?;
    let (found, solved, noise) = scene.fit()?;
    let trial = scene.judge(&found, noise);
    let sigma = |begin: usize| [0, 1, 2].map(|axis| solved.sigma(begin + axis));
    let is_sure = |ix: usize| found[ix].abs() > SURE * solved.sigma(ix) && solved.unseen_share(ix) < 0.5;
    let part = |begin: usize| [found[begin], found[begin + 1], found[begin + 2]];
    Some(Stand {
        shift_m: part(0),
        shift_sigma_m: sigma(0),
        turn_rad: part(3),
        turn_sigma_rad: sigma(3),
        unseen: solved.unseen(|ix| ix >= 3).iter().map(named).collect(),
        gain_db: trial.gain_db,
        standard_error_db: trial.standard_error_db,
        n_judges: trial.n_images,
        n_pairs: scene.pairs.len(),
        kept: trial.kept && trial.n_images >= LEAST_JUDGES && (0..6).any(is_sure),
    })
}

impl Stand {
    /// What poses on the base are to be multiplied by from the left, where its source has it at `world_from_base`.
    ///
    /// * `share`: of the way to the stand that was walked, 0 to 1: the error grew with the way.
    pub fn world_from_told(&self, world_from_base: &Transform, share: f64) -> Transform {
        if !self.kept {
            return Transform::identity();
        }
        let [shift, turn] = [self.shift_m, self.turn_rad].map(|part| Vector3::from(part) * share);
        moved(world_from_base, &shift, &turn)
    }
}

impl std::fmt::Display for Stand {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let length = |of: [f64; 3]| Vector3::from(of).norm();
        write!(
            f,
            "moved by {:.1} +- {:.1} mm, turned by {:.2} +- {:.2} degrees ({:+.2} dB, standard error {:.2}, on {} selection images)",
            1e3 * length(self.shift_m),
            1e3 * length(self.shift_sigma_m),
            length(self.turn_rad).to_degrees(),
            length(self.turn_sigma_rad).to_degrees(),
            self.gain_db,
            self.standard_error_db,
            self.n_judges
        )
    }
}

/// The motion of what a base carries when the base is shifted, and turned about its own place.
fn moved(world_from_base: &Transform, shift_m: &Vector3<f64>, turn_rad: &Vector3<f64>) -> Transform {
    let place = world_from_base.translation.vector;
    let turn = UnitQuaternion::from_scaled_axis(*turn_rad);
    Transform::from_parts((place + shift_m - turn * place).into(), turn)
}

/// A direction that cannot be seen.
fn named(direction: &DVector<f64>) -> String {
    const SMALL: f64 = 0.1;
    let vector = |begin: usize| Vector3::from_fn(|row, _| direction[begin + row]);
    let (shift, turn) = (vector(0), vector(3));
    let sizes = [shift.norm() / USUAL_SHIFT_M, turn.norm() / USUAL_TURN_RAD];
    let along = |of: Vector3<f64>| {
        let axis = of.normalize();
        format!("({:.2} {:.2} {:.2})", axis.x, axis.y, axis.z)
    };
    let mut parts = Vec::new();
    if sizes[0] > SMALL * sizes[1] {
        parts.push(format!("translation along {}", along(shift)));
    }
    if sizes[1] > SMALL * sizes[0] {
        parts.push(format!("turn about {}", along(turn)));
    }
    parts.join(" together with ")
}

/// The frames of the new stand and of earlier ones, and the pairs across.
struct Scene {
    frames: Vec<Frame>,
    /// From here on they are of the new stand.
    first_new: usize,
    /// As the keyframes have them.
    given: Vec<View>,
    world_from_base: Transform,
    pairs: Vec<Pair>,
    /// Between a training and a selection image.
    judging: Vec<Pair>,
}

impl Scene {
    fn new(seen: &[Arc<Keyframe>], new: &[Arc<Keyframe>], world_from_base: &Transform) -> Option<Self> {
        let names: BTreeSet<Arc<str>> = seen.iter().chain(new).map(|keyframe| keyframe.camera.clone()).collect();
        let names: Vec<Arc<str>> = names.into_iter().collect();
        let frames = |keyframes: &[Arc<Keyframe>]| -> Vec<Frame> {
            let used: Vec<&Arc<Keyframe>> =
                keyframes.iter().filter(|keyframe| keyframe.split != Split::Test && keyframe.depth.is_some()).collect();
            let n = used.len().min(MOST_FRAMES);
            let camera_of = |keyframe: &Keyframe| names.partition_point(|name| *name < keyframe.camera);
            (0..n)
                .into_par_iter()
                .filter_map(|ix| {
                    let keyframe = used[ix * used.len() / n];
                    Frame::new(keyframe, camera_of(keyframe))
                })
                .collect()
        };
        let mut all = frames(seen);
        let first_new = all.len();
        all.extend(frames(new));
        let given = Corrections::none(names.len()).views(&all, &Layout::default());
        let of = |is_new: bool, split: Split| -> Vec<usize> {
            (0..all.len()).filter(|ix| (*ix >= first_new) == is_new && all[*ix].keyframe.split == split).collect()
        };
        let across = |splits: [Split; 2]| -> Vec<Pair> {
            let (earlier, later) = (of(false, splits[0]), of(true, splits[1]));
            let pairs = |candidates: &[usize], tos: &[usize]| pairs::choose(&all, &given, candidates, tos, PARTNERS);
            [pairs(&later, &earlier), pairs(&earlier, &later)].concat()
        };
        let pairs = across([Split::Train, Split::Train]);
        let judging = [across([Split::Train, Split::Selection]), across([Split::Selection, Split::Train])].concat();
        let scene = Self { first_new, given, world_from_base: *world_from_base, pairs, judging, frames: all };
        (scene.pairs.len() >= LEAST_PAIRS).then_some(scene)
    }

    /// The cameras with the base shifted and turned: those of the new stand moved along, with what a further motion does.
    fn views(&self, found: &DVector<f64>) -> Vec<View> {
        let part = |begin: usize| Vector3::from_fn(|row, _| found[begin + row]);
        let motion = moved(&self.world_from_base, &part(0), &part(3));
        // Axes of the world, in the place of the base.
        let world_from_pivot = Transform::from_parts(
            (self.world_from_base.translation.vector + part(0)).into(),
            UnitQuaternion::identity(),
        );
        let view = |(ix, view): (usize, &View)| match ix >= self.first_new {
            true => view.carried(&(motion * self.frames[ix].keyframe.world_from_camera), &world_from_pivot),
            false => view.clone(),
        };
        self.given.iter().enumerate().map(view).collect()
    }

    /// Shift, then turn, from coarse to fine.
    fn fit(&self) -> Option<(DVector<f64>, Solved, Noise)> {
        let scales = DVector::from_fn(6, |ix, _| if ix < 3 { USUAL_SHIFT_M } else { USUAL_TURN_RAD });
        let mut found = DVector::zeros(6);
        let n_levels = self.frames.iter().map(|frame| frame.levels.len()).max()?;
        let (level, hidden_frac) = (n_levels - 1, HIDDEN_FRAC[n_levels - 1]);
        let mut how = Looks { level, hidden_frac, noise: FIRST_NOISE, part: Part::All };
        let sums_of = |found: &DVector<f64>, how: &Looks| {
            let sums = sums::of_pairs(&self.frames, &self.views(found), &self.pairs, how);
            sums::noise_of(&sums).map(|noise| (sums, noise))
        };
        let mut noise = sums_of(&found, &how)?.1;
        let mut last = None;
        for level in (0..n_levels).rev() {
            (how.level, how.hidden_frac) = (level, HIDDEN_FRAC[level]);
            for _ in 0..MOST_ROUNDS {
                how.noise = Noise { photo: BRIGHTNESS_ERRS * noise.photo, ..noise };
                let sums;
                (sums, noise) = sums_of(&found, &how)?;
                let solved = Solved::new(scales.clone(), &found, &self.pairs, &sums);
                found = stepped(&found, &solved.step);
                let n_sigmas = solved.step_in_sigmas();
                log::debug!("stand: level {level}, {noise:?}, step of {n_sigmas:.2} sigma");
                last = Some(solved);
                if n_sigmas < SMALL_STEP[level] {
                    break;
                }
            }
        }
        Some((found, last?, noise))
    }

    /// How much better the selection images of either side are predicted from the other.
    fn judge(&self, found: &DVector<f64>, noise: Noise) -> Trial {
        let views = [&DVector::zeros(6), found].map(|found| self.views(found));
        let judge_of = |pair: &Pair| {
            if self.frames[pair.to].keyframe.split == Split::Selection { pair.to } else { pair.from }
        };
        let (without_db, with_db) = judge::scores(&self.frames, &self.judging, &views, noise, judge_of);
        log::debug!("stand: without {without_db:.2?}, with {with_db:.2?} dB");
        Trial::of(Candidate::Cameras(TermSet::NONE), &without_db, &with_db)
    }
}

/// A motion that is followed by a small one.
fn stepped(found: &DVector<f64>, step: &DVector<f64>) -> DVector<f64> {
    let turn = |of: &DVector<f64>| UnitQuaternion::from_scaled_axis(Vector3::from_fn(|row, _| of[3 + row]));
    let turned = (turn(step) * turn(found)).scaled_axis();
    DVector::from_fn(6, |ix, _| if ix < 3 { found[ix] + step[ix] } else { turned[ix - 3] })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::tests::{Wrong, capture};

    /// Where the base was told to be at the second stand.
    fn told() -> Transform {
        Transform::new(Vector3::new(0.3, -0.2, 0.1), Vector3::new(0.0, 0.0, 0.2))
    }

    /// What was told of the base is what it was, moved by this.
    fn drift() -> Transform {
        moved(&told(), &Vector3::new(0.014, -0.013, 0.004), &Vector3::new(0.005, -0.004, 0.016)).inverse()
    }

    /// The images of two stands, the second as a wrong base pose places them.
    fn stands(told_from_true: &Transform, noise: f64) -> [Vec<Arc<Keyframe>>; 2] {
        let all = capture(&Wrong { noise, ..Wrong::nothing() });
        let (first, second) = all.split_at(all.len() / 2);
        [first.to_vec(), second.iter().map(|keyframe| Arc::new(keyframe.carried(told_from_true))).collect()]
    }

    /// Millimetres at the base, and degrees, that a pose is off.
    fn off(left: &Transform) -> (f64, f64) {
        let place = told().translation.vector;
        (1e3 * (left * nalgebra::Point3::from(place) - place).coords.norm(), left.rotation.angle().to_degrees())
    }

    #[test]
    fn a_wrong_stand_is_found() {
        let [seen, new] = stands(&drift(), 1.0);
        let found = stand(&seen, &new, &told()).unwrap();
        assert!(found.kept && found.unseen.is_empty() && found.gain_db > 3.0, "{found:?}");
        let (mm, degrees) = off(&(found.world_from_told(&told(), 1.0) * drift()));
        let (mm_before, degrees_before) = off(&drift());
        assert!(mm_before > 15.0 && degrees_before > 0.9, "{mm_before} mm, {degrees_before} degrees to begin with");
        assert!(mm < 0.3 && degrees < 0.03, "{mm} mm, {degrees} degrees left: {found}");
        let sigma_mm = 1e3 * Vector3::from(found.shift_sigma_m).norm();
        assert!((0.02..1.0).contains(&sigma_mm), "{sigma_mm} mm of deviation, {mm} mm of error");
        // Half way it is off by half of it.
        let half = found.world_from_told(&told(), 0.5);
        let (mm_half, degrees_half) = off(&half);
        assert!((mm_half / mm_before - 0.5).abs() < 0.02 && (degrees_half / degrees_before - 0.5).abs() < 0.02);
    }

    #[test]
    fn a_right_stand_stays() {
        for noise in [0.3, 1.0, 3.0] {
            let [seen, new] = stands(&Transform::identity(), noise);
            let found = stand(&seen, &new, &told()).unwrap();
            assert!(!found.kept && found.n_judges >= LEAST_JUDGES, "{found:?}");
            assert_eq!(found.world_from_told(&told(), 1.0), Transform::identity());
        }
    }

    #[test]
    fn a_stand_that_shows_nothing_of_the_others_is_none() {
        let [seen, new] = stands(&Transform::translation(50.0, 0.0, 0.0), 1.0);
        assert_eq!(stand(&seen, &new, &told()), None);
        assert_eq!(stand(&[], &new, &told()), None);
        let flat: Vec<_> =
            new.iter().map(|keyframe| Arc::new(Keyframe { depth: None, ..keyframe.as_ref().clone() })).collect();
        assert_eq!(stand(&seen, &flat, &told()), None);
    }

    #[test]
    fn test_images_are_not_looked_at_and_threads_do_not_matter() {
        let [seen, new] = stands(&drift(), 1.0);
        let spoiled = |keyframes: &[Arc<Keyframe>]| -> Vec<Arc<Keyframe>> {
            let spoil = |keyframe: &Arc<Keyframe>| match keyframe.split {
                Split::Test => Arc::new(keyframe.carried(&Transform::translation(0.1, 0.2, 0.3))),
                Split::Train | Split::Selection => keyframe.clone(),
            };
            keyframes.iter().map(spoil).collect()
        };
        let with = |n: usize, seen: &[Arc<Keyframe>], new: &[Arc<Keyframe>]| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
            pool.install(|| stand(seen, new, &told())).unwrap()
        };
        assert_eq!(with(1, &seen, &new), with(3, &spoiled(&seen), &spoiled(&new)));
    }

    #[test]
    fn a_wall_without_marks_does_not_show_ways_along_it() {
        use crate::test_scenes::{Shape, keyframe, looking};
        use nalgebra::Point3;
        let wall = [Shape::Plane { normal: Vector3::x(), offset_m: 1.5 }];
        let at = |ix: i64| {
            let (y, z) = (0.1 * (ix as f64).sin(), 0.1 * (2.0 * ix as f64).cos());
            let mut keyframe = keyframe(ix, &wall, looking(Point3::new(0.0, y, z), Point3::new(1.5, 2.0 * z, y)));
            keyframe.rgba_srgb = keyframe.rgba_srgb.chunks(4).flat_map(|_| [90, 90, 90, 255]).collect();
            keyframe.split = Split::of(usize::try_from(ix).unwrap() + 1);
            Arc::new(keyframe)
        };
        let all: Vec<_> = (0..24).map(at).collect();
        let off = moved(&told(), &Vector3::new(0.01, 0.02, 0.0), &Vector3::zeros());
        let new: Vec<_> = all[12..].iter().map(|keyframe| Arc::new(keyframe.carried(&off))).collect();
        let found = stand(&all[..12], &new, &told()).unwrap();
        assert_eq!(found.unseen.len(), 3, "{found:?}");
        assert!((found.shift_m[0] + 0.01).abs() < 3e-4 && found.shift_m[1].abs() < 1e-3, "{found:?}");
        assert!(found.unseen.iter().any(|parts| parts.contains("translation along (")), "{found:?}");
    }
}
