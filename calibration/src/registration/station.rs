//! Correction of a mobile base's pose at a new station, by registering images of the station to
//! earlier images.
//!
//! The six parameters of the base's pose are estimated in the same way as the parameters of
//! cameras. Depth samples of one image are projected into another image, and Gauss-Newton steps
//! from coarse to fine minimize the differences of brightness and depth. Each pair has one image
//! from the new station and one image from an earlier station. Pairs are formed in both directions,
//! because a distant view contains a near view, but a near view does not contain a distant view.

use super::corrections::Corrections;
use super::fit::{INITIAL_NOISE, OCCLUSION_FRAC};
use super::layout::Layout;
use super::pairs::{self, Pair};
use super::prepared_image::PreparedImage;
use super::solve::Solution;
use super::sums::{self, Noise, PixelSubset, ResidualOptions};
use super::validation;
use super::view::CorrectedView;
use super::{MAX_IMAGES, MIN_PAIRS, MIN_SIGNIFICANT_SIGMAS, PARTNERS_PER_IMAGE};
use crate::{Candidate, ParamSet, Trial};
use keyframe::{Keyframe, Split};
use kinematics::Transform;
use nalgebra::{DVector, Point3, UnitQuaternion, Vector3};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeSet;
use std::sync::Arc;

/// Typical error of the position of the base, meters. The next constant is the typical error of the
/// rotation of the base, radians.
const PRIOR_TRANSLATION_M: f64 = 0.02;
const PRIOR_ROTATION_RAD: f64 = 0.0175;

/// Maximum number of steps at each level. Weights that depend on the residuals make convergence
/// slower than plain Gauss-Newton.
const MAX_ITERATIONS: usize = 20;
/// A step smaller than this number of standard deviations ends a level. The value of the finest
/// level comes first.
const CONVERGED_STEP_SIGMAS: [f64; 4] = [0.1, 0.3, 0.3, 0.3];
/// Factor on the brightness noise. Near occlusions and reflections, all pairs of two stations have
/// the same brightness errors. Their depth errors differ.
const BRIGHTNESS_NOISE_INFLATION: f64 = 4.0;

/// Correction of the reported pose of a base at a station. Each sigma is a standard deviation.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StationCorrection {
    /// Translation from the reported to the estimated position of the base, along the axes of the
    /// world, meters.
    pub translation_m: [f64; 3],
    /// Standard deviations, meters.
    pub translation_sigma_m: [f64; 3],
    /// Rotation of the base about its own position, as a rotation vector in the axes of the world,
    /// radians.
    pub rotation_rad: [f64; 3],
    /// Standard deviations, radians.
    pub rotation_sigma_rad: [f64; 3],
    /// Descriptions of directions that are not observable. The correction along these directions is
    /// zero.
    pub unobservable: Vec<String>,
    /// How much better the corrected poses predict validation images across the stations, dB.
    pub gain_db: f64,
    /// Standard error of the gain, dB.
    pub standard_error_db: f64,
    /// Number of validation images.
    pub n_validation_images: usize,
    /// Number of compared pairs of images.
    pub n_pairs: usize,
    /// Whether the correction and its gain are significant.
    pub kept: bool,
}

/// Estimates the pose of the base from the keyframes of the new station (`new`) and of earlier
/// stations (`reference`). Returns `None` if they have no depth or too little overlap.
///
/// Poses are estimated from training keyframes and evaluated on validation keyframes. Test
/// keyframes are not used.
///
/// * `world_from_base`: the reported base pose from which the poses of the new station's keyframes
///   were computed.
/// * `initial_motion`: world-frame motion of the base with which the search begins.
pub fn register_station(
    reference: &[Arc<Keyframe>],
    new: &[Arc<Keyframe>],
    world_from_base: &Transform,
    initial_motion: &Transform,
) -> Option<StationCorrection> {
    // A base has one pose per station, so its six parameters are always estimated together. The
    // criteria are the same as for cameras: the correction must be significant, and improve the
    // prediction of validation images.
    let scene = StationScene::new(reference, new, world_from_base)?;
    let (estimate, solution, noise) = scene.fit(parameters(world_from_base, initial_motion))?;
    let trial = scene.evaluate(&estimate, noise);
    let sigma = |begin: usize| [0, 1, 2].map(|axis| solution.sigma(begin + axis));
    let is_significant = |ix: usize| {
        estimate[ix].abs() > MIN_SIGNIFICANT_SIGMAS * solution.sigma(ix)
            && solution.unobservable_frac(ix) < 0.5
    };
    let part = |begin: usize| [estimate[begin], estimate[begin + 1], estimate[begin + 2]];
    Some(StationCorrection {
        translation_m: part(0),
        translation_sigma_m: sigma(0),
        rotation_rad: part(3),
        rotation_sigma_rad: sigma(3),
        unobservable: solution
            .unobservable(|ix| ix >= 3)
            .iter()
            .map(describe)
            .collect(),
        gain_db: trial.gain_db,
        standard_error_db: trial.standard_error_db,
        n_validation_images: trial.n_images,
        n_pairs: scene.pairs.len(),
        kept: trial.kept && (0..6).any(is_significant),
    })
}

impl StationCorrection {
    /// Transform by which poses must be multiplied from the left to correct them. It is the
    /// identity unless the correction is accepted. `world_from_base` is the reported pose of the
    /// base.
    ///
    /// * `share`: fraction of the path to the station, 0 to 1. It scales the correction, because
    ///   the error grows along the path.
    pub fn map_from_odom(&self, world_from_base: &Transform, share: f64) -> Transform {
        if !self.kept {
            return Transform::identity();
        }
        let [translation, rotation] =
            [self.translation_m, self.rotation_rad].map(|part| Vector3::from(part) * share);
        base_motion(world_from_base, &translation, &rotation)
    }
}

impl std::fmt::Display for StationCorrection {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let length = |of: [f64; 3]| Vector3::from(of).norm();
        write!(
            f,
            "moved by {:.1} +- {:.1} mm, rotated by {:.2} +- {:.2} degrees ({:+.2} dB, standard error {:.2}, on {} validation images)",
            1e3 * length(self.translation_m),
            1e3 * length(self.translation_sigma_m),
            length(self.rotation_rad).to_degrees(),
            length(self.rotation_sigma_rad).to_degrees(),
            self.gain_db,
            self.standard_error_db,
            self.n_validation_images
        )
    }
}

/// World-frame motion of a base that is translated, and rotated about its own position.
fn base_motion(
    world_from_base: &Transform,
    translation_m: &Vector3<f64>,
    rotation_rad: &Vector3<f64>,
) -> Transform {
    let position = world_from_base.translation.vector;
    let rotation = UnitQuaternion::from_scaled_axis(*rotation_rad);
    Transform::from_parts(
        (position + translation_m - rotation * position).into(),
        rotation,
    )
}

/// Translation of a base and rotation about its own position that give a world-frame motion. See
/// [`base_motion`].
fn parameters(world_from_base: &Transform, motion: &Transform) -> DVector<f64> {
    let position = Point3::from(world_from_base.translation.vector);
    let translation_m = motion * position - position;
    let rotation_rad = motion.rotation.scaled_axis();
    DVector::from_iterator(6, translation_m.iter().chain(&rotation_rad).copied())
}

/// Describes an unobservable direction.
fn describe(direction: &DVector<f64>) -> String {
    // If one part is much smaller than the other in units of the scales, it is omitted.
    const MIN_SHARE: f64 = 0.1;
    let vector = |begin: usize| Vector3::from_fn(|row, _| direction[begin + row]);
    let translation = vector(0);
    let rotation = vector(3);
    let sizes = [
        translation.norm() / PRIOR_TRANSLATION_M,
        rotation.norm() / PRIOR_ROTATION_RAD,
    ];
    let along = |of: Vector3<f64>| {
        let axis = of.normalize();
        format!("({:.2} {:.2} {:.2})", axis.x, axis.y, axis.z)
    };
    let mut parts = Vec::new();
    if sizes[0] > MIN_SHARE * sizes[1] {
        parts.push(format!("translation along {}", along(translation)));
    }
    if sizes[1] > MIN_SHARE * sizes[0] {
        parts.push(format!("rotation about {}", along(rotation)));
    }
    parts.join(" together with ")
}

/// Images of the new station and of earlier stations, and the pairs between them.
struct StationScene {
    images: Vec<PreparedImage>,
    /// Index of the first image of the new station.
    first_new: usize,
    /// Views with uncorrected poses.
    initial_views: Vec<CorrectedView>,
    world_from_base: Transform,
    pairs: Vec<Pair>,
    /// Pairs of a training and a validation image.
    validation_pairs: Vec<Pair>,
}

impl StationScene {
    fn new(
        reference: &[Arc<Keyframe>],
        new: &[Arc<Keyframe>],
        world_from_base: &Transform,
    ) -> Option<Self> {
        let names: BTreeSet<Arc<str>> = reference
            .iter()
            .chain(new)
            .map(|keyframe| keyframe.camera.clone())
            .collect();
        let names: Vec<Arc<str>> = names.into_iter().collect();
        let mut images = prepared(reference, &names);
        let first_new = images.len();
        images.extend(prepared(new, &names));
        let initial_views = Corrections::none(names.len()).views(&images, &Layout::default());
        let mut scene = Self {
            first_new,
            initial_views,
            world_from_base: *world_from_base,
            pairs: Vec::new(),
            validation_pairs: Vec::new(),
            images,
        };
        // Validation images of the new station are predicted from training images of earlier
        // stations. Validation images of earlier stations are predicted from training images of the
        // new station.
        scene.pairs = scene.pairs_across([Split::Train, Split::Train]);
        scene.validation_pairs = [
            scene.pairs_across([Split::Train, Split::Validation]),
            scene.pairs_across([Split::Validation, Split::Train]),
        ]
        .concat();
        (scene.pairs.len() >= MIN_PAIRS).then_some(scene)
    }

    /// Indices of the images of a split at the new station or at earlier stations.
    fn images_of(&self, in_new_station: bool, split: Split) -> Vec<usize> {
        (0..self.images.len())
            .filter(|ix| {
                (*ix >= self.first_new) == in_new_station
                    && self.images[*ix].keyframe.split == split
            })
            .collect()
    }

    /// Pairs between earlier images and new images of these splits, in both directions.
    fn pairs_across(&self, [earlier, later]: [Split; 2]) -> Vec<Pair> {
        let earlier = self.images_of(false, earlier);
        let later = self.images_of(true, later);
        [
            self.choose_pairs(&later, &earlier),
            self.choose_pairs(&earlier, &later),
        ]
        .concat()
    }

    fn choose_pairs(&self, candidates: &[usize], targets: &[usize]) -> Vec<Pair> {
        pairs::choose(
            &self.images,
            &self.initial_views,
            candidates,
            targets,
            PARTNERS_PER_IMAGE,
        )
    }

    /// Views with the base moved by the estimate. Only views of the new station move. They have
    /// columns for a further motion of the base.
    fn views(&self, estimate: &DVector<f64>) -> Vec<CorrectedView> {
        let part = |begin: usize| Vector3::from_fn(|row, _| estimate[begin + row]);
        let motion = base_motion(&self.world_from_base, &part(0), &part(3));
        // A frame with the axes of the world at the position of the base.
        let world_from_pivot = Transform::from_parts(
            (self.world_from_base.translation.vector + part(0)).into(),
            UnitQuaternion::identity(),
        );
        self.initial_views
            .iter()
            .enumerate()
            .map(|(ix, view)| {
                if ix < self.first_new {
                    return view.clone();
                }
                let world_from_camera = motion * self.images[ix].keyframe.world_from_camera;
                view.moved_with_frame(&world_from_camera, &world_from_pivot)
            })
            .collect()
    }

    /// Estimates translation and rotation, from coarse to fine.
    fn fit(&self, mut estimate: DVector<f64>) -> Option<(DVector<f64>, Solution, Noise)> {
        let scales = DVector::from_fn(6, |ix, _| {
            if ix < 3 {
                PRIOR_TRANSLATION_M
            } else {
                PRIOR_ROTATION_RAD
            }
        });
        let n_levels = self.images.iter().map(|image| image.levels.len()).max()?;
        let mut options = ResidualOptions {
            level: n_levels - 1,
            occlusion_frac: OCCLUSION_FRAC[n_levels - 1],
            noise: INITIAL_NOISE,
            part: PixelSubset::All,
        };
        let sums_of = |estimate: &DVector<f64>, options: &ResidualOptions| {
            let sums = sums::of_pairs(&self.images, &self.views(estimate), &self.pairs, options);
            sums::noise_of(&sums).map(|noise| (sums, noise))
        };
        let mut noise = sums_of(&estimate, &options)?.1;
        let mut last = None;
        for level in (0..n_levels).rev() {
            options.level = level;
            options.occlusion_frac = OCCLUSION_FRAC[level];
            for _ in 0..MAX_ITERATIONS {
                options.noise = Noise {
                    photo: BRIGHTNESS_NOISE_INFLATION * noise.photo,
                    ..noise
                };
                let sums;
                (sums, noise) = sums_of(&estimate, &options)?;
                let solution = Solution::new(scales.clone(), &estimate, &self.pairs, &sums);
                estimate = compose_step(&estimate, &solution.step);
                let n_sigmas = solution.step_in_sigmas();
                log::debug!("station: level {level}, {noise:?}, step of {n_sigmas:.2} sigma");
                last = Some(solution);
                if n_sigmas < CONVERGED_STEP_SIGMAS[level] {
                    break;
                }
            }
        }
        Some((estimate, last?, noise))
    }

    /// Evaluates how much the estimate improves the prediction of validation images of each station
    /// from the other.
    fn evaluate(&self, estimate: &DVector<f64>, noise: Noise) -> Trial {
        let views = [&DVector::zeros(6), estimate].map(|estimate| self.views(estimate));
        // Pairs go in both directions, so the validation image may be the first or the second.
        let (baseline_db, variant_db) = validation::scores(
            &self.images,
            &self.validation_pairs,
            &views,
            noise,
            |pair| {
                if self.images[pair.to].keyframe.split == Split::Validation {
                    pair.to
                } else {
                    pair.from
                }
            },
        );
        log::debug!("station: without {baseline_db:.2?}, with {variant_db:.2?} dB");
        Trial::of(
            Candidate::Cameras(ParamSet::empty()),
            &baseline_db,
            &variant_db,
        )
        .with_enough_images()
    }
}

/// Prepares at most [`MAX_IMAGES`] keyframes with depth, spread evenly.
///
/// * `names`: names of the cameras in ascending order.
fn prepared(keyframes: &[Arc<Keyframe>], names: &[Arc<str>]) -> Vec<PreparedImage> {
    let used: Vec<&Arc<Keyframe>> = keyframes
        .iter()
        .filter(|keyframe| keyframe.split != Split::Test && keyframe.depth.is_some())
        .collect();
    let n = used.len().min(MAX_IMAGES);
    (0..n)
        .into_par_iter()
        .filter_map(|ix| {
            let keyframe = used[ix * used.len() / n];
            let camera_ix = names.partition_point(|name| *name < keyframe.camera);
            PreparedImage::new(keyframe, camera_ix)
        })
        .collect()
}

/// Composes a motion with a small motion that follows it.
fn compose_step(estimate: &DVector<f64>, step: &DVector<f64>) -> DVector<f64> {
    let rotation = |of: &DVector<f64>| {
        UnitQuaternion::from_scaled_axis(Vector3::from_fn(|row, _| of[3 + row]))
    };
    let composed_rotation = (rotation(step) * rotation(estimate)).scaled_axis();
    DVector::from_fn(6, |ix, _| {
        if ix < 3 {
            estimate[ix] + step[ix]
        } else {
            composed_rotation[ix - 3]
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::MIN_VALIDATION_IMAGES;
    use crate::scenes::{Miscalibration, capture};
    use kinematics::transform;

    /// Reported pose of the base at the second station.
    fn reported_base() -> Transform {
        Transform::new(Vector3::new(0.3, -0.2, 0.1), Vector3::new(0.0, 0.0, 0.2))
    }

    /// The reported pose of the base is the true pose moved by this drift.
    fn drift() -> Transform {
        base_motion(
            &reported_base(),
            &Vector3::new(0.014, -0.013, 0.004),
            &Vector3::new(0.005, -0.004, 0.016),
        )
        .inverse()
    }

    /// Images of two stations. The images of the second station have a wrong base pose.
    fn keyframes_of_two_stations(
        odom_from_true: &Transform,
        noise: f64,
    ) -> [Vec<Arc<Keyframe>>; 2] {
        let all = capture(&Miscalibration {
            noise,
            ..Miscalibration::none()
        });
        let (first, second) = all.split_at(all.len() / 2);
        [
            first.to_vec(),
            second
                .iter()
                .map(|keyframe| Arc::new(keyframe.with_base_correction(odom_from_true)))
                .collect(),
        ]
    }

    fn register(reference: &[Arc<Keyframe>], new: &[Arc<Keyframe>]) -> Option<StationCorrection> {
        register_station(reference, new, &reported_base(), &Transform::identity())
    }

    /// Error of a pose, in millimeters at the base and in degrees.
    fn pose_error(remaining: &Transform) -> (f64, f64) {
        let position = reported_base().translation.vector;
        (
            1e3 * (remaining * nalgebra::Point3::from(position) - position)
                .coords
                .norm(),
            remaining.rotation.angle().to_degrees(),
        )
    }

    #[test]
    fn wrong_station_pose_is_corrected() {
        let [reference, new] = keyframes_of_two_stations(&drift(), 1.0);
        let estimate = register(&reference, &new).unwrap();
        assert!(
            estimate.kept && estimate.unobservable.is_empty() && estimate.gain_db > 3.0,
            "{estimate:?}"
        );
        let (mm, degrees) = pose_error(&(estimate.map_from_odom(&reported_base(), 1.0) * drift()));
        let (mm_before, degrees_before) = pose_error(&drift());
        assert!(
            mm_before > 15.0 && degrees_before > 0.9,
            "{mm_before} mm, {degrees_before} degrees before correction"
        );
        assert!(
            mm < 0.3 && degrees < 0.03,
            "{mm} mm, {degrees} degrees left: {estimate}"
        );
        let sigma_mm = 1e3 * Vector3::from(estimate.translation_sigma_m).norm();
        assert!(
            (0.02..1.0).contains(&sigma_mm),
            "standard deviation {sigma_mm} mm, error {mm} mm"
        );
        // A search that begins elsewhere ends at the same pose.
        let initial = transform::interpolate(&Transform::identity(), &drift().inverse(), 0.9);
        let again = register_station(&reference, &new, &reported_base(), &initial).unwrap();
        let [one, other] = [&estimate, &again].map(|of| of.map_from_odom(&reported_base(), 1.0));
        let (mm, degrees) = pose_error(&(other * one.inverse()));
        assert!(mm < 0.1 && degrees < 0.01, "{mm} mm, {degrees} degrees");
        // At half of the path, half of the error is corrected.
        let half = estimate.map_from_odom(&reported_base(), 0.5);
        let (mm_half, degrees_half) = pose_error(&half);
        assert!(
            (mm_half / mm_before - 0.5).abs() < 0.02
                && (degrees_half / degrees_before - 0.5).abs() < 0.02
        );
    }

    #[test]
    fn correct_station_pose_is_kept() {
        for noise in [0.3, 1.0, 3.0] {
            let [reference, new] = keyframes_of_two_stations(&Transform::identity(), noise);
            let estimate = register(&reference, &new).unwrap();
            assert!(
                !estimate.kept && estimate.n_validation_images >= MIN_VALIDATION_IMAGES,
                "{estimate:?}"
            );
            assert_eq!(
                estimate.map_from_odom(&reported_base(), 1.0),
                Transform::identity()
            );
        }
    }

    #[test]
    fn station_without_overlap_gives_none() {
        let [reference, new] =
            keyframes_of_two_stations(&Transform::translation(50.0, 0.0, 0.0), 1.0);
        assert_eq!(register(&reference, &new), None);
        assert_eq!(register(&[], &new), None);
        let flat: Vec<_> = new
            .iter()
            .map(|keyframe| {
                Arc::new(Keyframe {
                    depth: None,
                    ..keyframe.as_ref().clone()
                })
            })
            .collect();
        assert_eq!(register(&reference, &flat), None);
    }

    #[test]
    fn ignores_test_images_and_thread_count() {
        let [reference, new] = keyframes_of_two_stations(&drift(), 1.0);
        let corrupted = |keyframes: &[Arc<Keyframe>]| -> Vec<Arc<Keyframe>> {
            let corrupt = |keyframe: &Arc<Keyframe>| match keyframe.split {
                Split::Test => {
                    Arc::new(keyframe.with_base_correction(&Transform::translation(0.1, 0.2, 0.3)))
                }
                Split::Train | Split::Validation => keyframe.clone(),
            };
            keyframes.iter().map(corrupt).collect()
        };
        let with_threads = |n: usize, reference: &[Arc<Keyframe>], new: &[Arc<Keyframe>]| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(n)
                .build()
                .unwrap();
            pool.install(|| register(reference, new)).unwrap()
        };
        assert_eq!(
            with_threads(1, &reference, &new),
            with_threads(3, &corrupted(&reference), &corrupted(&new))
        );
    }

    #[test]
    fn textureless_wall_leaves_in_plane_motion_unobservable() {
        use keyframe::scenes::{TestShape, keyframe, look_at};
        use nalgebra::Point3;
        let wall = [TestShape::Plane {
            normal: Vector3::x(),
            offset_m: 1.5,
        }];
        let at = |ix: i64| {
            let (y, z) = (0.1 * (ix as f64).sin(), 0.1 * (2.0 * ix as f64).cos());
            let mut keyframe = keyframe(
                ix,
                &wall,
                look_at(Point3::new(0.0, y, z), Point3::new(1.5, 2.0 * z, y)),
            );
            keyframe.rgba_srgb = keyframe
                .rgba_srgb
                .chunks(4)
                .flat_map(|_| [90, 90, 90, 255])
                .collect();
            keyframe.split = Split::of(usize::try_from(ix).unwrap() + 1);
            Arc::new(keyframe)
        };
        let all: Vec<_> = (0..24).map(at).collect();
        let pose_error = base_motion(
            &reported_base(),
            &Vector3::new(0.01, 0.02, 0.0),
            &Vector3::zeros(),
        );
        let new: Vec<_> = all[12..]
            .iter()
            .map(|keyframe| Arc::new(keyframe.with_base_correction(&pose_error)))
            .collect();
        let estimate = register(&all[..12], &new).unwrap();
        assert_eq!(estimate.unobservable.len(), 3, "{estimate:?}");
        assert!(
            (estimate.translation_m[0] + 0.01).abs() < 3e-4
                && estimate.translation_m[1].abs() < 1e-3,
            "{estimate:?}"
        );
        assert!(
            estimate
                .unobservable
                .iter()
                .any(|parts| parts.contains("translation along (")),
            "{estimate:?}"
        );
    }
}
