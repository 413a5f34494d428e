//! Compares the camera poses that two halves of the keyframes give.
//!
//! The gain of a correction on validation images shows that it explains the images. It does not
//! show that the correction is right: images of a camera that does not move are almost copies of
//! each other, so that their scatter is far smaller than their common error. Two halves of the
//! images that were taken at different times have different errors, for example because a robot or
//! a person was somewhere else.
//!
//! **Test.** Let `a` and `b` be the corrections from the two halves, with six parameters each and
//! covariances that are equal up to an unknown factor. If the camera needs no correction, the mean
//! `(a + b) / 2` and half the difference `(a - b) / 2` are independent and have the same
//! distribution. The ratio of their squared lengths, in units of the covariance, then follows an F
//! distribution with 6 and 6 degrees of freedom, whatever the factor. This is Hotelling's test of a
//! mean for two samples of known shape (Anderson, "An Introduction to Multivariate Statistical
//! Analysis", 2003, section 5.2). Only the shape of the stated covariance is used, because its size
//! may be too small.

use super::align;
use crate::{CameraRefinement, ParamSet};
use keyframe::Keyframe;
use kinematics::Transform;
use nalgebra::{Matrix6, Vector6};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Number of blocks of consecutive keyframes. The halves consist of alternate blocks, so that both
/// contain the whole motion, and a block is longer than most disturbances.
const N_BLOCKS: usize = 4;
/// The ratio that F(6, 6) exceeds with a probability of 5 %.
const MIN_RATIO: f64 = 4.284;

/// The corrections of a camera pose that two halves of the keyframes give.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HalvesAgreement {
    /// Squared length of the mean correction, divided by the squared length of half the difference.
    pub ratio: f64,
    /// Angle (radians) and distance (meters) between the corrections of the two halves.
    pub difference_rad: f64,
    /// See `difference_rad`.
    pub difference_m: f64,
}

impl HalvesAgreement {
    /// * `halves`: translation (meters) and rotation vector (radians) from each half.
    /// * `shape`: covariance of one half up to a factor.
    ///
    /// `None` if the covariance is singular.
    fn new([one, other]: [Vector6<f64>; 2], shape: &Matrix6<f64>) -> Option<Self> {
        let information = shape.try_inverse()?;
        let squared_length = |vector: Vector6<f64>| vector.dot(&(information * vector));
        let difference = pose(&one).inverse() * pose(&other);
        Some(Self {
            ratio: squared_length(0.5 * (one + other)) / squared_length(0.5 * (one - other)),
            difference_rad: difference.rotation.angle(),
            difference_m: difference.translation.vector.norm(),
        })
    }

    /// Whether both halves give the same correction, in contrast to a correction of noise.
    pub fn agrees(&self) -> bool {
        self.ratio > MIN_RATIO
    }
}

fn pose(correction: &Vector6<f64>) -> Transform {
    crate::rigid_transform(
        correction.fixed_rows::<3>(3).into_owned(),
        correction.fixed_rows::<3>(0).into_owned(),
    )
}

/// Estimates the parameters of a set, which contains the extrinsics, from each half of the
/// keyframes. Returns the agreement for each camera that both halves determine. Cameras with too
/// few images are missing.
pub fn compare_halves(
    keyframes: &[Arc<Keyframe>],
    set: ParamSet,
) -> BTreeMap<String, HalvesAgreement> {
    let [Some(one), Some(other)] = halves(keyframes).map(|half| {
        let choice = CameraRefinement::Always(set);
        align(&half, &choice)
    }) else {
        return BTreeMap::new();
    };
    let covariances = [&one, &other].map(|half| half.extrinsics_covariance.as_ref());
    let [Some(covariance), Some(other_covariance)] = covariances else {
        return BTreeMap::new();
    };
    let agreement = |camera: &String| {
        let corrections = [one.corrections.get(camera)?, other.corrections.get(camera)?];
        let halves = corrections.map(|correction| {
            let [x, y, z] = correction.translation_m;
            let [a, b, c] = correction.rotation_rad;
            Vector6::new(x, y, z, a, b, c)
        });
        let shape = covariance.matrix_of(camera)? + other_covariance.matrix_of(camera)?;
        Some((camera.clone(), HalvesAgreement::new(halves, &shape)?))
    };
    covariance.cameras.iter().filter_map(agreement).collect()
}

/// Alternate blocks of the keyframes, in order of time. All cameras change at the same times.
fn halves(keyframes: &[Arc<Keyframe>]) -> [Vec<Arc<Keyframe>>; 2] {
    let mut sorted = keyframes.to_vec();
    sorted.sort_by_key(|keyframe| keyframe.stamp);
    let mut halves = [Vec::new(), Vec::new()];
    let n_keyframes = sorted.len();
    for (ix, keyframe) in sorted.into_iter().enumerate() {
        halves[N_BLOCKS * ix / n_keyframes % 2].push(keyframe);
    }
    halves
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::{Miscalibration, capture, wrong_extrinsics};
    use numbers::random::Random;

    /// Six numbers with mean 0 and these standard deviations.
    fn noise(random: &mut Random, sigmas: &[f64; 6]) -> Vector6<f64> {
        Vector6::from_fn(|ix, _| sigmas[ix] * random.normal())
    }

    #[test]
    fn about_5_percent_of_corrections_of_noise_agree_whatever_the_stated_size_of_the_noise() {
        let sigmas = [0.003, 0.002, 0.005, 0.01, 0.02, 0.003];
        let shape = Matrix6::from_diagonal(&Vector6::from_fn(|ix, _| sigmas[ix] * sigmas[ix]));
        let mut random = Random::new(7);
        let n = 4000;
        let mut n_agree = 0;
        for trial in 0..n {
            let halves = [(); 2].map(|()| noise(&mut random, &sigmas));
            // The stated covariance is too small or too large.
            let stated = shape * if trial % 2 == 0 { 1e-2 } else { 1e2 };
            let agreement = HalvesAgreement::new(halves, &stated).expect("regular");
            n_agree += usize::from(agreement.agrees());
        }
        assert!((140..260).contains(&n_agree), "{n_agree} of {n}");
    }

    #[test]
    fn corrections_well_above_the_noise_agree() {
        let sigmas = [0.001; 6];
        let shape = Matrix6::identity();
        let correction = Vector6::new(0.008, 0.0, 0.0, 0.0, 0.006, 0.0);
        let mut random = Random::new(8);
        let n_agree = (0..200)
            .filter(|_| {
                let halves = [(); 2].map(|()| correction + noise(&mut random, &sigmas));
                HalvesAgreement::new(halves, &shape).is_some_and(|both| both.agrees())
            })
            .count();
        assert!(n_agree > 195, "{n_agree} of 200");
        let opposite = HalvesAgreement::new([correction, -correction], &shape).expect("regular");
        assert!(!opposite.agrees());
        assert!((opposite.difference_m - 0.016).abs() < 1e-4, "{opposite:?}");
        let failed = HalvesAgreement::new([correction * f64::NAN; 2], &shape).expect("regular");
        assert!(!failed.agrees());
        assert_eq!(
            HalvesAgreement::new([correction; 2], &Matrix6::zeros()),
            None
        );
    }

    #[test]
    fn halves_of_a_scene_agree_on_a_wrong_pose() {
        let miscalibration = Miscalibration {
            extrinsics: wrong_extrinsics(),
            ..Miscalibration::none()
        };
        let keyframes = capture(&miscalibration);
        let found = compare_halves(&keyframes, ParamSet::EXTRINSICS);
        let agreement = found.get("wrist").expect("enough images");
        assert!(agreement.agrees(), "{agreement:?}");
        assert!(agreement.difference_m < 2e-3, "{agreement:?}");
        assert!(compare_halves(&keyframes[..6], ParamSet::EXTRINSICS).is_empty());
    }

    #[test]
    fn halves_are_alternate_blocks() {
        let keyframes = capture(&Miscalibration::none());
        let [one, other] = halves(&keyframes);
        assert_eq!(one.len() + other.len(), keyframes.len());
        assert!(
            one[0].stamp < other[0].stamp
                && one.last().map(|k| k.stamp) > other.first().map(|k| k.stamp)
        );
        assert!(halves(&[]).iter().all(Vec::is_empty));
    }
}
