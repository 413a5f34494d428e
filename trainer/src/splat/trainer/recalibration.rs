//! Corrects the cameras of a model in training. The splats move along with the keyframes that show
//! them.
//!
//! A correction moves every point that a keyframe observes. A splat moves by the weighted mean of
//! these motions over the keyframes that observe it. The better a keyframe's depth agrees with the
//! splat, the higher its weight. Coefficients of spherical harmonics are not rotated, because
//! corrections are a few degrees at most.

use super::training::Training;
use crate::corrected_keyframe::replacement;
use crate::splat::buffers::SplatBuffers;
use crate::splat::camera_params::CameraParams;
use crate::splat::trials::SplatTrials;
use crate::{CorrectedKeyframe, Error};
use calibration::{Alignment, CameraCorrection, ParamSet};
use gpu::Gpu;
use keyframe::{DepthMap, Keyframe};
use kinematics::{Intrinsics, Lens, Transform};
use nalgebra::{Point3, Quaternion, UnitQuaternion, Vector3};
use numbers::f32s_of;
use rayon::prelude::*;
use std::sync::Arc;

/// Maximum number of keyframes that determine the motion of the splats. They are spread evenly over
/// all keyframes. Every splat is projected into each of them, so the time is proportional to their
/// number.
const MAX_KEYFRAMES: usize = 64;
/// Maximum distance of a splat from the surface that a depth reading shows, as a fraction of the
/// depth of the splat. A splat that is farther away is hidden by the surface or floats in front of
/// the surface. It then does not belong to the surface.
const SURFACE_FRAC: f64 = 0.05;
/// Depth error, as a fraction of the depth, at which the weight of a keyframe is halved. With wrong
/// cameras, keyframes disagree about a surface. The keyframe from which a splat was seeded agrees
/// best, and should determine its motion.
const AGREEMENT_FRAC: f64 = 0.001;
/// Weight of a keyframe without a depth reading. Such a keyframe shows the splat unless something
/// hides it. The weight of a keyframe with depth is at least 4e-4, at an error of [`SURFACE_FRAC`].
/// The weight without depth is smaller, so it matters only if no keyframe has depth at the splat.
const WITHOUT_DEPTH: f64 = 1e-4;
/// Parameters of single images, which stay enabled. Shared parameters are part of the alignment.
const IMAGE_PARAMS: ParamSet = ParamSet::IMAGE_POSES.union(ParamSet::IMAGE_GAINS);

/// Moves the splats with their keyframes. See [`Method::recalibrate`](crate::Method::recalibrate).
/// No steps may be in flight, and no trial may be running.
pub(super) fn move_with_keyframes(
    training: &mut Training,
    trials: &mut SplatTrials,
    keyframes: &[CorrectedKeyframe],
    alignment: &Alignment,
) -> Result<(), Error> {
    let learned = training.learned_corrections()?;
    // The splats are moved first, because their motion depends on the cameras before the
    // correction.
    let gpu = training.recorder.gpu.clone();
    let motions = motions(keyframes, |camera| learned.get(camera));
    move_splats(&gpu, &training.model.splats, &motions)?;
    // Then everything that refers to the keyframes is replaced. Views come before seeding, because
    // seeding takes the corrected depth from the views.
    let corrected = replacement(keyframes);
    training.recorder.passes.clear_bindings();
    training.views.replace_cameras(&gpu, &corrected);
    training
        .seeding
        .replace_cameras(&corrected, &training.views);
    trials
        .validation
        .iter_mut()
        .for_each(|image| corrected(&mut image.keyframe));
    // Camera parameters start at zero again, because the keyframes now contain the correction.
    let mut params = training.model.cameras.set & IMAGE_PARAMS;
    // Image poses from depth are accurate to a few millimeters. They are refined together with the
    // splats. No trial has to show first that the refinement is useful.
    if alignment.has_image_poses() && trials.remove_candidate(ParamSet::IMAGE_POSES) {
        params |= ParamSet::IMAGE_POSES;
    }
    training.model.cameras =
        CameraParams::new(&gpu, training.options.common.cameras.always() | params)?;
    // The splats must adapt to the corrected cameras, which needs learning rates that are not
    // too small.
    training.schedule.extend_for_arrival();
    Ok(())
}

/// A camera at its pose in the world.
struct PosedCamera {
    world_from_camera: Transform,
    camera_from_world: Transform,
    intrinsics: Intrinsics,
}

impl PosedCamera {
    fn of(keyframe: &Keyframe) -> Self {
        let Keyframe {
            world_from_camera,
            size_px,
            focal_px,
            principal_px,
            ..
        } = *keyframe;
        Self::pinhole(world_from_camera, size_px, focal_px, principal_px)
    }

    fn of_depth(depth: &DepthMap) -> Self {
        let DepthMap {
            world_from_camera,
            size_px,
            focal_px,
            principal_px,
            ..
        } = *depth;
        Self::pinhole(world_from_camera, size_px, focal_px, principal_px)
    }

    fn pinhole(
        world_from_camera: Transform,
        size_px: [u32; 2],
        focal_px: [f64; 2],
        principal_px: [f64; 2],
    ) -> Self {
        let intrinsics = Intrinsics {
            size_px,
            focal_px,
            principal_px,
            lens: Lens::Pinhole,
            rectified: true,
        };
        Self {
            world_from_camera,
            camera_from_world: world_from_camera.inverse(),
            intrinsics,
        }
    }

    /// Pixel and depth of a point in the world, if the image contains it.
    fn project(&self, point: &Point3<f64>) -> Option<([f64; 2], f64)> {
        let point = self.camera_from_world * point;
        let px = self.intrinsics.project(&point.coords)?;
        self.intrinsics.contains(px).then_some((px, point.z))
    }

    /// The point in the world at a pixel and depth.
    fn point(&self, px: [f64; 2], z: f64) -> Option<Point3<f64>> {
        Some(self.world_from_camera * Point3::from(self.intrinsics.unproject(px)? * z))
    }
}

/// The reading at a pixel within the depth map, meters along z.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "pixels within the image"
)]
fn reading_m(depth: &DepthMap, px: [f64; 2]) -> f64 {
    let [x, y] = px.map(|px| px as usize);
    depth.depth_m[y * depth.size_px[0] as usize + x].into()
}

/// The effect of the correction on the points that one keyframe shows.
struct Motion {
    before: PosedCamera,
    after: PosedCamera,
    /// Camera and readings of the depth before the correction.
    depth: Option<(PosedCamera, DepthMap)>,
    rotation: UnitQuaternion<f64>,
}

impl Motion {
    /// The motion of a keyframe. `learned` is the correction of its camera that was learned with
    /// the splats, if any.
    fn of(keyframe: &CorrectedKeyframe, learned: Option<&CameraCorrection>) -> Self {
        let CorrectedKeyframe { before, after } = keyframe;
        // The splats were fitted to the learned cameras, not to the cameras of the keyframes.
        let before =
            learned.map_or_else(|| before.clone(), |learned| Arc::new(learned.moved(before)));
        let rotation =
            after.world_from_camera.rotation * before.world_from_camera.rotation.inverse();
        Self {
            before: PosedCamera::of(&before),
            after: PosedCamera::of(after),
            depth: before
                .depth
                .clone()
                .map(|depth| (PosedCamera::of_depth(&depth), depth)),
            rotation,
        }
    }

    /// The position to which the correction moves a point, and the weight of this motion. `None` if
    /// the keyframe does not show the point.
    fn of_point(&self, point: &Point3<f64>) -> Option<(Point3<f64>, f64)> {
        let (px, z) = self.before.project(point)?;
        let known = self.depth.as_ref().and_then(|(camera, depth)| {
            let (px, z) = camera.project(point)?;
            let reading = reading_m(depth, px);
            (reading > 0.0).then_some((reading - z) / z)
        });
        // The weight falls with the square of the error, as in a robust mean. One keyframe in good
        // agreement therefore outweighs many others.
        let weight = match known {
            Some(error_frac) if error_frac.abs() > SURFACE_FRAC => return None,
            Some(error_frac) => 1.0 / (1.0 + (error_frac / AGREEMENT_FRAC).powi(2)),
            None => WITHOUT_DEPTH,
        };
        // The image content stays at its pixel and depth. Only the camera changes.
        Some((self.after.point(px, z)?, weight))
    }
}

/// The motions of a subset of the keyframes. `learned` returns the correction of a camera that was
/// learned with the splats. It is applied after the corrections in the keyframes.
fn motions<'a>(
    keyframes: &[CorrectedKeyframe],
    learned: impl Fn(&str) -> Option<&'a CameraCorrection>,
) -> Vec<Motion> {
    let n = keyframes.len().min(MAX_KEYFRAMES);
    let subset = (0..n).map(|ix| &keyframes[ix * keyframes.len() / n]);
    subset
        .map(|keyframe| Motion::of(keyframe, learned(&keyframe.before.camera)))
        .collect()
}

/// Position and rotation of a splat after the correction. They are the weighted means over the
/// keyframes that show the splat. If no keyframe shows it, the motion of the nearest camera is
/// used.
fn moved(motions: &[Motion], point: &Point3<f64>) -> Option<(Point3<f64>, UnitQuaternion<f64>)> {
    let mut weights = 0.0;
    let mut shift = Vector3::zeros();
    let mut rotations = Quaternion::from_parts(0.0, Vector3::zeros());
    for motion in motions {
        let Some((position, weight)) = motion.of_point(point) else {
            continue;
        };
        // Both signs of a quaternion are the same rotation, but their sum would cancel. For small
        // rotations, the normalized sum of quaternions is their mean.
        let rotation = motion.rotation.into_inner();
        rotations += if rotation.w < 0.0 {
            -rotation
        } else {
            rotation
        } * weight;
        shift += (position - point) * weight;
        weights += weight;
    }
    if weights > 0.0 {
        return Some((
            point + shift / weights,
            UnitQuaternion::from_quaternion(rotations),
        ));
    }
    // No keyframe shows the point. It may belong to the background, which moves rigidly with a
    // camera near it.
    let distance = |motion: &&Motion| {
        (motion.before.world_from_camera.translation.vector - point.coords).norm_squared()
    };
    let nearest = motions
        .iter()
        .min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
    let in_camera = nearest.before.camera_from_world * point;
    Some((
        nearest.after.world_from_camera * in_camera,
        nearest.rotation,
    ))
}

/// Moves the splats on the GPU.
fn move_splats(gpu: &Gpu, splats: &SplatBuffers, motions: &[Motion]) -> Result<(), Error> {
    let n = splats.n_splats as usize;
    if n == 0 {
        return Ok(());
    }
    let mut means: Vec<[f32; 4]> = gpu.read(&splats.means, n)?;
    let mut rotations_wxyz: Vec<[f32; 4]> = gpu.read(&splats.rotations, n)?;
    means
        .par_iter_mut()
        .zip(&mut rotations_wxyz)
        .for_each(|(mean, rotation_wxyz)| {
            let [x, y, z, w] = mean.map(f64::from);
            let Some((position, rotation)) = moved(motions, &Point3::new(x, y, z)) else {
                return;
            };
            let [qw, qx, qy, qz] = rotation_wxyz.map(f64::from);
            let turned = rotation.into_inner() * Quaternion::new(qw, qx, qy, qz);
            *mean = f32s_of([position.x, position.y, position.z, w]);
            *rotation_wxyz = f32s_of([turned.w, turned.i, turned.j, turned.k]);
        });
    gpu.write(&splats.means, 0, bytemuck::cast_slice(&means));
    gpu.write(&splats.rotations, 0, bytemuck::cast_slice(&rotations_wxyz));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Method;
    use crate::model_options::ModelOptions;
    use crate::splat::{SplatOptions, SplatTrainer};
    use calibration::scenes::{Miscalibration, capture, wrong_extrinsics};
    use gpu::testing::test_gpu;
    use numbers::quantile::{Rank, quantile};

    /// Median distance of the splats from the depth readings of these keyframes, meters along z.
    fn surface_error_m(trainer: &mut SplatTrainer, keyframes: &[Arc<Keyframe>]) -> f64 {
        let depths: Vec<_> = keyframes
            .iter()
            .filter_map(|keyframe| keyframe.depth.clone())
            .map(|depth| (PosedCamera::of_depth(&depth), depth))
            .collect();
        let mut errors = Vec::new();
        for mean in trainer.arrays().unwrap().means {
            let point = Point3::from(mean.map(f64::from));
            for (camera, depth) in &depths {
                let Some((px, z)) = camera.project(&point) else {
                    continue;
                };
                let error = (reading_m(depth, px) - z).abs();
                errors.extend((error < 0.1).then_some(error));
            }
        }
        quantile(&mut errors, 0.5, Rank::Upper).unwrap()
    }

    #[test]
    fn splats_move_to_the_surfaces_of_the_corrected_keyframes() {
        let gpu = test_gpu();
        let miscalibration = Miscalibration {
            extrinsics: wrong_extrinsics(),
            ..Miscalibration::none()
        };
        let [wrong, right] = [miscalibration, Miscalibration::none()].map(|miscalibration| {
            let mut keyframes = capture(&miscalibration);
            keyframes.retain(|keyframe| keyframe.split == keyframe::Split::Train);
            keyframes
        });
        let specific = SplatOptions {
            max_splats: 4000,
            sh_degree: 0,
            ..SplatOptions::default()
        };
        let start = |keyframes: &[Arc<Keyframe>]| {
            let options = ModelOptions {
                specific: specific.clone(),
                ..ModelOptions::default()
            };
            let mut trainer = SplatTrainer::new(gpu.clone(), options).unwrap();
            keyframes
                .iter()
                .for_each(|keyframe| trainer.push(keyframe.clone()).unwrap());
            trainer.seed().unwrap();
            trainer
        };
        let right_error_m = surface_error_m(&mut start(&right), &right);
        let mut trainer = start(&wrong);
        let wrong_error_m = surface_error_m(&mut trainer, &right);
        let (n_splats, n_seeds) = (trainer.progress().primitives, trainer.n_seeds());
        let pairs = wrong.iter().zip(&right);
        let corrected: Vec<_> = pairs
            .map(|(before, after)| CorrectedKeyframe {
                before: before.clone(),
                after: after.clone(),
            })
            .collect();
        trainer
            .recalibrate(&corrected, &Alignment::default())
            .unwrap();
        let moved_error_m = surface_error_m(&mut trainer, &right);
        assert!(
            wrong_error_m > 3.0 * right_error_m,
            "{wrong_error_m} m must exceed {right_error_m} m"
        );
        assert!(
            moved_error_m < 1.5 * right_error_m,
            "{moved_error_m} m, seeded there: {right_error_m} m"
        );
        assert_eq!(
            trainer.progress().primitives,
            n_splats,
            "no splats are added or removed"
        );
        assert!(
            trainer.n_seeds() > n_seeds / 2 && trainer.n_seeds() < 2 * n_seeds,
            "{} of {n_seeds}",
            trainer.n_seeds()
        );
        trainer.seed().unwrap();
        assert_eq!(
            trainer.progress().primitives,
            n_splats,
            "the keyframes are not seeded again"
        );
    }

    #[test]
    fn points_that_no_keyframe_shows_move_with_the_nearest_camera() {
        let keyframes = capture(&Miscalibration::none());
        let shift = Transform::new(Vector3::new(0.0, 0.0, 0.01), Vector3::new(0.0, 0.02, 0.0));
        let after = |keyframe: &Arc<Keyframe>| Arc::new(keyframe.with_base_correction(&shift));
        let corrected: Vec<_> = keyframes
            .iter()
            .map(|keyframe| CorrectedKeyframe {
                before: keyframe.clone(),
                after: after(keyframe),
            })
            .collect();
        let motions = motions(&corrected, |_| None);
        for point in [Point3::new(0.0, 0.0, 1e3), Point3::new(0.3, 0.1, 0.0)] {
            let (position, rotation) = moved(&motions, &point).unwrap();
            assert!(
                (position - shift * point).norm() < 1e-9 * point.coords.norm().max(1.0),
                "{position} {point}"
            );
            assert!(rotation.angle_to(&shift.rotation) < 1e-9);
        }
        assert!(moved(&[], &Point3::origin()).is_none());
    }
}
