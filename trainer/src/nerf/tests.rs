//! Tests of the whole model: accuracy, determinism and resuming.

use super::carve;
use super::extent::Extent;
use super::options::{NerfBudget, NerfOptions};
use super::rays::{self, RayImage, RaySampling};
use super::reference::march::March;
use super::sizes::Sizes;
use super::{NerfModel, params};
use crate::eval::{self, PixelPair};
use crate::model_options::{CommonOptions, ModelOptions};
use crate::test_scenes as scenes;
use crate::{CorrectedKeyframe, Error, Method, ModelKind, Picture, Projection, RenderRequest};
use calibration::{Alignment, CameraCorrection, CameraRefinement, ParamSet, rigid_transform};
use gpu::Gpu;
use gpu::testing::test_gpu;
use keyframe::{DepthMap, Keyframe, Split};
use kinematics::{Stamp, Transform, Twist};
use model_files::Aabb;
use model_files::edits::{Edit, Edits};
use nalgebra::{Point3, Vector3};
use std::sync::Arc;

/// Center of the ball.
const BALL_CENTER: Point3<f64> = Point3::new(0.3, -0.2, 0.1);
const N_STEPS: u64 = 160;

fn options() -> ModelOptions<NerfOptions> {
    let nerf_budget = NerfBudget {
        n_rays: 256,
        n_samples: 1 << 13,
        n_hidden: 16,
        n_cells: 32,
        n_steps: 64,
        max_log2_entries: 13,
        max_levels: 6,
        picture_rays: 1 << 10,
    };
    ModelOptions {
        common: CommonOptions {
            n_planned_steps: 300,
            ..CommonOptions::default()
        },
        specific: NerfOptions {
            nerf_budget: Some(nerf_budget),
            ..NerfOptions::default()
        },
    }
}

/// Options for a number of planned steps with these camera parameters.
fn with_cameras(cameras: CameraRefinement, n_planned_steps: u64) -> ModelOptions<NerfOptions> {
    options().with(|options| {
        options.common.cameras = cameras;
        options.common.n_planned_steps = n_planned_steps;
    })
}

/// The ball without a floor. The pixels around the ball are black and have no depth.
fn ball(n: usize) -> Vec<Arc<Keyframe>> {
    scenes::ring(&[scenes::ball(BALL_CENTER)], BALL_CENTER, n)
}

/// A ball on a floor, seen from above so that everything visible is near.
fn ball_on_floor(n: usize) -> Vec<Arc<Keyframe>> {
    let view = |ix: usize| {
        let angle = 0.8 * ix as f64;
        let eye = BALL_CENTER + Vector3::new(0.6 * angle.cos(), 0.6 * angle.sin(), 1.1);
        let shapes = [scenes::ball(BALL_CENTER), scenes::floor()];
        Arc::new(scenes::keyframe(
            i64::try_from(ix).unwrap(),
            &shapes,
            scenes::look_at(eye, BALL_CENTER),
        ))
    };
    (0..n).map(view).collect()
}

fn gpu() -> Arc<Gpu> {
    test_gpu()
}

fn model_with(options: ModelOptions<NerfOptions>, keyframes: &[Arc<Keyframe>]) -> NerfModel {
    let mut model = NerfModel::new(gpu(), options).unwrap();
    for keyframe in keyframes {
        model.push(keyframe.clone()).unwrap();
    }
    model
}

/// Trains up to a step.
fn train_until(model: &mut NerfModel, end: u64) {
    while model.progress().step < end {
        model.step(end - model.progress().step).unwrap();
    }
}

fn trained_model(keyframes: &[Arc<Keyframe>]) -> NerfModel {
    let mut model = model_with(options(), keyframes);
    train_until(&mut model, N_STEPS);
    model
}

/// The view of a keyframe.
fn request(keyframe: &Keyframe) -> RenderRequest {
    let Keyframe {
        size_px,
        focal_px,
        principal_px,
        ..
    } = *keyframe;
    let projection = Projection::Pinhole {
        focal_px,
        principal_px,
    };
    let background_srgb = [0.0; 3];
    RenderRequest {
        size_px,
        projection,
        background_srgb,
        ..scenes::request(keyframe.world_from_camera)
    }
}

fn psnr(picture: &Picture, keyframe: &Keyframe) -> f64 {
    eval::psnr(&PixelPair::new(keyframe.size_px, &picture.rgba_srgb, &keyframe.rgba_srgb).unwrap())
        .unwrap()
}

fn state(model: &mut NerfModel) -> model_files::checkpoint::Checkpoint {
    model.checkpoint().unwrap().finish().unwrap()
}

#[test]
fn novel_view_is_accurate_and_deterministic() {
    const MIN_PSNR: f64 = 20.0;
    let all = ball_on_floor(9);
    let test_view = &all[4];
    let mut seen = all.clone();
    seen.remove(4);
    let mut model = trained_model(&seen);
    let picture = model.render(&request(test_view)).unwrap();
    let psnr = psnr(&picture, test_view);
    assert!(psnr > MIN_PSNR, "{psnr:.2} dB");
    let [width, height] = test_view.size_px;
    let middle = (height / 2 * width + width / 2) as usize;
    let eye = test_view.world_from_camera.translation.vector;
    let expected_m = (eye - BALL_CENTER.coords).norm() - 0.3;
    assert!(
        (f64::from(picture.depth_m[middle]) - expected_m).abs() < 0.05,
        "{} m",
        picture.depth_m[middle]
    );
    assert!(picture.depth_m.iter().all(|depth| depth.is_finite()));
    let without_depth = model
        .render(&RenderRequest {
            depth: false,
            ..request(test_view)
        })
        .unwrap();
    assert!(without_depth.depth_m.is_empty() && without_depth.rgba_srgb == picture.rgba_srgb);

    // Renders before all keyframes have been pushed.
    let mut one_by_one = model_with(options(), &seen[..2]);
    one_by_one.seed().unwrap();
    assert!(
        one_by_one
            .render(&request(test_view))
            .unwrap()
            .depth_m
            .iter()
            .all(|depth| *depth == 0.0)
    );
    seen[2..]
        .iter()
        .for_each(|keyframe| one_by_one.push(keyframe.clone()).unwrap());
    while one_by_one.progress().step < N_STEPS {
        one_by_one.step(1).unwrap();
    }
    assert!(
        state(&mut model) == state(&mut one_by_one),
        "results must not depend on the number of steps per submit"
    );
    let mut other = model_with(options().with(|options| options.common.seed = 1), &seen);
    train_until(&mut other, 4);
    let mut first = model_with(options(), &seen);
    train_until(&mut first, 4);
    assert!(
        state(&mut other).arrays != state(&mut first).arrays,
        "the seed must change the result"
    );
}

/// Without depth, the occupancy is updated from the first steps on. A resumed model with depth is
/// compared in `drifting_poses_are_corrected`.
#[test]
fn resume_and_load_are_bit_exact() {
    const HALF: u64 = 35;
    const END: u64 = 80;
    let keyframes = without_depth(&ball(6));
    let mut half = model_with(options(), &keyframes[..4]);
    train_until(&mut half, HALF);
    half.push(keyframes[4].clone()).unwrap();
    let checkpoint = state(&mut half);
    let (mut rest, test_view) = NerfModel::resume(gpu(), &checkpoint, &keyframes).unwrap();
    assert_eq!(test_view.len(), 1);
    train_until(&mut half, END);
    train_until(&mut rest, END);
    assert!(state(&mut half) == state(&mut rest));

    let folder = tempfile::tempdir().unwrap();
    half.save(folder.path()).unwrap();
    assert_eq!(
        ModelKind::of_saved(folder.path())
            .unwrap()
            .map(ModelKind::name),
        Some("nerf")
    );
    let mut loaded = NerfModel::load(gpu(), folder.path()).unwrap();
    let request = request(&keyframes[1]);
    let drawn = half.render(&request).unwrap();
    let again = loaded.render(&request).unwrap();
    assert!(drawn.rgba_srgb == again.rgba_srgb && drawn.depth_m == again.depth_m);
    assert!(loaded.is_idle() && loaded.step(3).unwrap() == 0);

    let other_lens = Arc::new(Keyframe {
        focal_px: [80.0; 2],
        ..(*keyframes[2]).clone()
    });
    let mut changed = keyframes.clone();
    changed[2] = other_lens;
    let error = NerfModel::resume(gpu(), &checkpoint, &changed).unwrap_err();
    assert!(
        error.to_string().contains("has different intrinsics"),
        "{error}"
    );
}

fn without_depth(keyframes: &[Arc<Keyframe>]) -> Vec<Arc<Keyframe>> {
    let strip = |keyframe: &Arc<Keyframe>| {
        Arc::new(Keyframe {
            depth: None,
            ..(**keyframe).clone()
        })
    };
    keyframes.iter().map(strip).collect()
}

#[test]
fn trains_without_depth() {
    let keyframes = without_depth(&ball(9));
    let mut model = model_with(options(), &keyframes);
    train_until(&mut model, 2);
    let before = psnr(
        &model.render(&request(&keyframes[2])).unwrap(),
        &keyframes[2],
    );
    train_until(&mut model, N_STEPS);
    let after = psnr(
        &model.render(&request(&keyframes[2])).unwrap(),
        &keyframes[2],
    );
    assert!(after > before + 4.0, "{before:.2} dB, then {after:.2} dB");
}

#[test]
fn renders_crop_range_and_equirectangular() {
    let keyframes = ball(8);
    let mut model = trained_model(&keyframes);
    let request = request(&keyframes[0]);
    let covered = |model: &mut NerfModel, request: &RenderRequest| {
        let picture = model.render(request).unwrap();
        picture
            .rgba_srgb
            .chunks_exact(4)
            .filter(|pixel| pixel[3] > 128)
            .count()
    };
    let whole = covered(&mut model, &request);
    assert!(whole > 1000, "{whole} pixels");
    let to = |x: f64| Transform::translation(BALL_CENTER.x, BALL_CENTER.y + x, BALL_CENTER.z);
    let crop = |x: f64| {
        Some(Aabb {
            world_from_box: to(x),
            min_m: [-0.5; 3],
            max_m: [0.5; 3],
        })
    };
    let n_covered_in_crop = covered(
        &mut model,
        &RenderRequest {
            crop: crop(0.0),
            ..request.clone()
        },
    );
    assert!(
        n_covered_in_crop > 1000,
        "{n_covered_in_crop} pixels of the ball in its box"
    );
    assert_eq!(
        covered(
            &mut model,
            &RenderRequest {
                crop: crop(5.0),
                ..request.clone()
            }
        ),
        0,
        "the box is empty"
    );
    assert_eq!(
        covered(
            &mut model,
            &RenderRequest {
                far_m: 0.2,
                ..request.clone()
            }
        ),
        0,
        "`far_m` ends in front of the ball"
    );
    // From the center of the ball, there is a surface in all directions.
    let all = RenderRequest {
        world_from_camera: Transform::translation(BALL_CENTER.x, BALL_CENTER.y, BALL_CENTER.z),
        size_px: [64, 32],
        projection: Projection::Equirectangular,
        ..request
    };
    let picture = model.render(&all).unwrap();
    assert_eq!(
        (picture.size_px, picture.depth_m.len()),
        ([64, 32], 64 * 32)
    );
}

/// With dense depth, cells are refined during training. Resuming from a checkpoint before or after
/// the refinement gives the same result.
#[test]
fn occupancy_cells_are_refined() {
    const PLANNED: u64 = 40;
    const END: u64 = 8;
    let nerf_budget = NerfBudget {
        n_cells: NerfBudget::FULL.n_cells,
        ..options().specific.nerf_budget.unwrap()
    };
    let options = options().with(|options| {
        options.common.n_planned_steps = PLANNED;
        options.specific.nerf_budget = Some(nerf_budget);
    });
    let keyframes = ball_on_floor(5);
    let mut whole = model_with(options.clone(), &keyframes);
    let mut parts = Vec::new();
    for step in [3, 6] {
        train_until(&mut whole, step);
        parts.push(state(&mut whole));
    }
    train_until(&mut whole, END);
    let n_bytes = |checkpoint: &model_files::checkpoint::Checkpoint| {
        checkpoint.array("cell_occupancy", 4 << 24).map(<[u8]>::len)
    };
    assert!(
        n_bytes(&parts[0]).is_err() && n_bytes(&parts[1]).is_ok(),
        "the cells must be refined between these steps"
    );
    let expected = state(&mut whole);
    for part in parts {
        let (mut resumed, _) = NerfModel::resume(gpu(), &part, &keyframes).unwrap();
        train_until(&mut resumed, END);
        assert!(
            state(&mut resumed) == expected,
            "resumed from step {}",
            part.state["step"]
        );
    }
}

/// Poses with drift are corrected during training if a trial finds a significant gain. Resuming in
/// the middle of the trial gives the same result.
#[test]
fn drifting_poses_are_corrected() {
    const AFTER_TRIAL: u64 = 300;
    let true_keyframes = ball_on_floor(24);
    let drifted = |keyframe: &Arc<Keyframe>| {
        let phase = 0.35 * keyframe.stamp.0 as f64;
        let rotation_rad = Vector3::new(0.02 * phase.sin(), 0.02 * phase.cos(), 0.0);
        let translation_m = Vector3::new(0.0, 0.01, -0.015) * phase.cos();
        let off = rigid_transform(rotation_rad, translation_m);
        let depth = keyframe.depth.as_ref().map(|depth| DepthMap {
            world_from_camera: depth.world_from_camera * off,
            ..depth.clone()
        });
        let split = if keyframe.stamp.0 % 4 == 2 {
            Split::Validation
        } else {
            Split::Train
        };
        Arc::new(Keyframe {
            world_from_camera: keyframe.world_from_camera * off,
            depth,
            split,
            ..(**keyframe).clone()
        })
    };
    let drifted_keyframes: Vec<Arc<Keyframe>> = true_keyframes.iter().map(drifted).collect();
    let position_error_m = |found: &Transform, true_keyframes: &Keyframe| {
        // Compares the positions of a point half a meter ahead.
        let ahead = Point3::new(0.0, 0.0, 0.5);
        (found * ahead - true_keyframes.world_from_camera * ahead).norm()
    };
    let mean_position_error_m = |model: &mut NerfModel, given: &[Arc<Keyframe>]| {
        let off = given
            .iter()
            .zip(&true_keyframes)
            .map(|(given, true_keyframes)| {
                position_error_m(
                    &scenes::calibrated_camera(model, given).world_from_camera,
                    true_keyframes,
                )
            });
        off.sum::<f64>() / given.len() as f64
    };
    let poses = ParamSet::IMAGE_POSES;
    let options = |cameras| with_cameras(cameras, 600);
    let mut model = model_with(
        options(CameraRefinement::Try(vec![poses])),
        &drifted_keyframes,
    );
    let before_m = mean_position_error_m(&mut model, &drifted_keyframes);
    train_until(&mut model, 90); // In the middle of the trial.
    let checkpoint = state(&mut model);
    train_until(&mut model, AFTER_TRIAL);
    assert_eq!(model.report().len(), 1, "the trial has ended");
    let after_trial = state(&mut model);
    train_until(&mut model, 600);
    let after_m = mean_position_error_m(&mut model, &drifted_keyframes);
    assert!(model.report()[0].kept, "{:?}", model.report());
    // A few hundred small steps cannot remove all drift, and common motion is unobservable. The
    // drift was reduced from 15 to 9 mm.
    assert!(after_m < 0.75 * before_m, "{before_m} m, then {after_m} m");

    let (mut resumed, rest) = NerfModel::resume(gpu(), &checkpoint, &drifted_keyframes).unwrap();
    assert_eq!(rest.len(), 6, "validation images must be returned");
    rest.into_iter()
        .for_each(|keyframe| resumed.push(keyframe).unwrap());
    train_until(&mut resumed, AFTER_TRIAL);
    assert!(
        after_trial.arrays == state(&mut resumed).arrays,
        "the trial must restart and end the same"
    );

    let folder = tempfile::tempdir().unwrap();
    model.save(folder.path()).unwrap();
    let mut loaded = NerfModel::load(gpu(), folder.path()).unwrap();
    assert_eq!(
        scenes::calibrated_camera(&mut loaded, &drifted_keyframes[3]),
        scenes::calibrated_camera(&mut model, &drifted_keyframes[3])
    );

    let mut with_removed = NerfModel::resume(gpu(), &checkpoint, &drifted_keyframes)
        .unwrap()
        .0;
    drifted_keyframes
        .iter()
        .filter(|keyframe| keyframe.split == Split::Validation)
        .for_each(|keyframe| {
            with_removed.push(keyframe.clone()).unwrap();
        });
    train_until(&mut with_removed, 96);
    with_removed
        .remove(&drifted_keyframes[1].camera, drifted_keyframes[1].stamp)
        .unwrap();
    let position_error_m = mean_position_error_m(&mut with_removed, &drifted_keyframes);
    assert!(
        (position_error_m - before_m).abs() < 1e-12 && with_removed.report().is_empty(),
        "the trial must be aborted, because its snapshot no longer fits"
    );
    train_until(&mut with_removed, 120);

    // No trial is possible without validation images.
    let mut without_validation =
        model_with(options(CameraRefinement::Try(vec![poses])), &true_keyframes);
    train_until(&mut without_validation, 120);
    assert!(
        without_validation.report().is_empty()
            && mean_position_error_m(&mut without_validation, &true_keyframes) == 0.0
    );
}

/// Changing light is modeled during training if a trial finds a significant gain. Images that were
/// not trained on use an embedding that is interpolated in time. Pictures without a time use the
/// mean embedding.
#[test]
fn changing_light_is_modeled() {
    let options = |cameras| with_cameras(cameras, 480).with(|options| options.common.seed = 3);
    let is_validation = |keyframe: &Keyframe| keyframe.stamp.0 % 4 == 2;
    let even: Vec<Arc<Keyframe>> = ball_on_floor(32)
        .iter()
        .map(|keyframe| {
            let split = if is_validation(keyframe) {
                Split::Validation
            } else {
                Split::Train
            };
            Arc::new(Keyframe {
                split,
                ..(**keyframe).clone()
            })
        })
        .collect();
    // A lamp is off in the second half.
    let lit = |keyframe: &Arc<Keyframe>| {
        let mut rgba = keyframe.rgba_srgb.to_vec();
        if keyframe.stamp.0 >= 16 {
            rgba.as_chunks_mut::<4>()
                .0
                .iter_mut()
                .for_each(|[color @ .., _]| color.iter_mut().for_each(|c| *c /= 2));
        }
        Arc::new(Keyframe {
            rgba_srgb: rgba.into(),
            ..(**keyframe).clone()
        })
    };
    let changing: Vec<Arc<Keyframe>> = even.iter().map(lit).collect();
    let mut unchanged = model_with(
        options(CameraRefinement::Try(vec![ParamSet::IMAGE_GAINS])),
        &even,
    );
    train_until(&mut unchanged, 100);
    assert!(!unchanged.report()[0].kept, "{:?}", unchanged.report());
    assert_eq!(
        unchanged.n_total_steps().unwrap(),
        100,
        "no steps must be discarded under constant light"
    );
    let mut model = model_with(
        options(CameraRefinement::Try(vec![ParamSet::IMAGE_GAINS])),
        &changing,
    );
    train_until(&mut model, 75); // In the middle of the trial.
    let checkpoint = state(&mut model);
    train_until(&mut model, 200);
    assert!(
        model.report()[0].kept && model.report()[0].gain_db > 1.0,
        "{:?}",
        model.report()
    );
    let (mut resumed, rest) = NerfModel::resume(gpu(), &checkpoint, &changing).unwrap();
    assert_eq!(rest.len(), 8, "validation images must be returned");
    rest.into_iter()
        .for_each(|keyframe| resumed.push(keyframe).unwrap());
    train_until(&mut resumed, 200);
    assert!(
        state(&mut model) == state(&mut resumed),
        "the trial must restart and end the same"
    );

    let like = |keyframe: &Keyframe, stamp: i64| RenderRequest {
        appearance_of: Some((keyframe.camera.clone(), Stamp(stamp))),
        ..request(keyframe)
    };
    let brightness = |picture: &Picture| {
        picture
            .rgba_srgb
            .iter()
            .map(|value| f64::from(*value))
            .sum::<f64>()
    };
    let [bright, dark] =
        [0, 31].map(|stamp| brightness(&model.render(&like(&changing[5], stamp)).unwrap()));
    let mean = model.render(&request(&changing[5])).unwrap();
    assert!(
        dark < brightness(&mean) && brightness(&mean) < bright,
        "{dark}, {}, {bright}",
        brightness(&mean)
    );
    let own = psnr(
        &model.render(&like(&changing[20], 20)).unwrap(),
        &changing[20],
    );
    assert!(
        own > psnr(
            &model.render(&like(&changing[20], 5)).unwrap(),
            &changing[20]
        ) + 2.0,
        "{own} dB"
    );

    let folder = tempfile::tempdir().unwrap();
    model.save(folder.path()).unwrap();
    let mut loaded = NerfModel::load(gpu(), folder.path()).unwrap();
    for request in [like(&changing[5], 5), request(&changing[5])] {
        let drawn = model.render(&request).unwrap();
        let again = loaded.render(&request).unwrap();
        assert!(drawn.rgba_srgb == again.rgba_srgb && drawn.depth_m == again.depth_m);
    }

    // The remaining images keep their embeddings.
    let before = model.render(&like(&changing[25], 25)).unwrap();
    model
        .remove(&changing[3].camera, changing[3].stamp)
        .unwrap();
    assert!(model.render(&like(&changing[25], 25)).unwrap().rgba_srgb == before.rgba_srgb);
    train_until(&mut model, 203);
}

/// Non-finite values in keyframes must not spread to the model.
#[test]
fn non_finite_keyframes_leave_no_nan() {
    let keyframes = ball(6);
    let depth = keyframes[0].depth.as_ref().unwrap();
    let mut depth_m = depth.depth_m.to_vec();
    let n = depth_m.len();
    depth_m[n / 2 - 200..n / 2].fill(f32::NAN);
    depth_m[n / 2..n / 2 + 200].fill(f32::INFINITY);
    depth_m[n / 4..n / 4 + 50].fill(-1.0);
    depth_m[n / 4 + 50..n / 4 + 90].fill(1e30);
    let non_finite = Keyframe {
        depth: Some(DepthMap {
            depth_m: depth_m.into(),
            ..depth.clone()
        }),
        ..(*keyframes[0]).clone()
    };
    let masked = Keyframe {
        rgba_srgb: vec![0; keyframes[1].rgba_srgb.len()].into(),
        ..(*keyframes[1]).clone()
    };
    let one_pixel = Keyframe {
        size_px: [1, 1],
        rgba_srgb: [255; 4].into(),
        depth: None,
        ..(*keyframes[2]).clone()
    };
    let all = [
        Arc::new(non_finite),
        Arc::new(masked),
        Arc::new(one_pixel),
        keyframes[3].clone(),
        keyframes[5].clone(),
    ];
    let mut model = model_with(options(), &all);
    train_until(&mut model, 40);
    let checkpoint = state(&mut model);
    for name in [
        "grid",
        "weights",
        "grid_moments",
        "weight_moments",
        "scales",
        "cell_occupancy",
    ] {
        let array = checkpoint
            .arrays
            .iter()
            .find(|array| array.name == name)
            .expect(name);
        let values: Vec<f32> = bytemuck::pod_collect_to_vec(&array.bytes);
        assert!(values.iter().all(|value| value.is_finite()), "{name}");
    }
    assert!(
        model
            .render(&request(&keyframes[4]))
            .unwrap()
            .depth_m
            .iter()
            .all(|depth| depth.is_finite())
    );
    let torn = Keyframe {
        rgba_srgb: vec![0; 12].into(),
        ..(*keyframes[1]).clone()
    };
    assert!(matches!(
        model.push(Arc::new(torn)),
        Err(Error::Keyframe(keyframe::Error::ImageBytes { .. }))
    ));
}

#[test]
fn test_and_removed_keyframes_are_not_trained_on() {
    let keyframes = ball(3);
    let mut model = model_with(
        options(),
        &[Arc::new(Keyframe {
            split: Split::Test,
            ..(*keyframes[0]).clone()
        })],
    );
    assert!(model.is_idle() && model.step(5).unwrap() == 0);
    let empty = model.render(&request(&keyframes[0])).unwrap();
    assert!(
        empty.depth_m.iter().all(|depth| *depth == 0.0),
        "the picture must be empty"
    );
    model.push(keyframes[1].clone()).unwrap();
    assert!(!model.is_idle());
    train_until(&mut model, 2);
    model
        .remove(&keyframes[1].camera, keyframes[1].stamp)
        .unwrap();
    assert!(model.is_idle() && model.step(5).unwrap() == 0);
}

#[test]
fn rays_pass_pixel_centers_at_row_time() {
    let linear_m_s = Vector3::new(0.5, -0.25, 0.125);
    let twist = Some(Twist {
        linear_m_s,
        angular_rad_s: Vector3::new(0.0, 0.0, 2.0),
    });
    let still = ball(1)[0].clone();
    let Keyframe {
        size_px,
        focal_px,
        principal_px,
        world_from_camera,
        ..
    } = *still;
    let depth_m = vec![1.5; (size_px[0] * size_px[1]) as usize].into();
    let depth = Some(DepthMap {
        size_px,
        focal_px,
        principal_px,
        depth_m,
        world_from_camera,
    });
    let keyframe = Keyframe {
        twist,
        readout_secs: 0.04,
        depth,
        ..(*still).clone()
    };
    let extent = Extent {
        center_m: [0.1, 0.2, 0.3],
        radius_m: 2.0,
    };
    let image = RayImage::new(Arc::new(keyframe.clone()));
    let [width, height] = keyframe.size_px;
    for (x, y) in [(0, 0), (width - 1, height - 1), (width / 2, height / 2)] {
        let (origin, direction, distance) = image.reading(&extent, (y * width + x) as usize);
        let tau = ((f64::from(y) + 0.5) / f64::from(height) - 0.5) * 0.04;
        let normalized = |pixel: u32, axis: usize| {
            (f64::from(pixel) + 0.5 - keyframe.principal_px[axis]) / keyframe.focal_px[axis]
        };
        // A rotation about z moves the ray's x and y.
        let u = normalized(x, 0);
        let v = normalized(y, 1);
        let seen = Vector3::new(u - tau * 2.0 * v, v + tau * 2.0 * u, 1.0);
        let pose = &keyframe.world_from_camera;
        let expected =
            (pose * Point3::from(linear_m_s * tau) - Point3::from(extent.center_m)) / 2.0;
        assert!((Vector3::from(origin) - expected).norm() < 1e-12);
        assert!((Vector3::from(direction) - pose.rotation * seen.normalize()).norm() < 1e-12);
        assert!((distance - 1.5 * seen.norm() / 2.0).abs() < 1e-12);
    }
}

#[test]
fn images_are_sampled_evenly_without_masked_pixels() {
    let mut keyframes = ball(5);
    let mut half_masked = keyframes[0].rgba_srgb.to_vec();
    let n_bytes = half_masked.len();
    half_masked[..n_bytes / 2]
        .chunks_exact_mut(4)
        .for_each(|pixel| pixel[3] = 0);
    keyframes[0] = Arc::new(Keyframe {
        rgba_srgb: half_masked.into(),
        ..(*keyframes[0]).clone()
    });
    let images: Vec<RayImage> = keyframes.into_iter().map(RayImage::new).collect();
    let extent = Extent {
        center_m: [0.0; 3],
        radius_m: 1.0,
    };
    let draw = RaySampling {
        seed: 3,
        step: 9,
        n_rays: 1000,
        begin: 0.1,
    };
    let drawn: Vec<params::Ray> = rays::draw(&images, &extent, &draw);
    for embedding in 0..5 {
        let n = drawn
            .iter()
            .filter(|ray| ray.embedding == embedding)
            .count();
        assert!((195..=205).contains(&n), "{n} rays of image {embedding}");
    }
    assert!(drawn.is_sorted_by_key(|ray| ray.embedding));
    let n_masked = drawn.iter().filter(|ray| ray.target_rgb >> 24 == 0).count();
    assert!(
        n_masked < 30,
        "{n_masked} of 200 rays of the half masked image are in its mask"
    );
    assert_eq!(drawn, rays::draw(&images, &extent, &draw));
    assert_ne!(
        drawn,
        rays::draw(&images, &extent, &RaySampling { step: 10, ..draw })
    );
}

#[test]
fn extent_covers_cameras_and_ignores_far_points() {
    let keyframes = scenes::ring(
        &[scenes::ball(BALL_CENTER), scenes::floor()],
        BALL_CENTER,
        18,
    );
    let extent = Extent::of(keyframes.iter().map(|keyframe| &**keyframe));
    assert!(
        (1.0..2.5).contains(&extent.radius_m),
        "an endless floor must not enlarge the extent: {extent:?}"
    );
    let off = Vector3::from(extent.center_m) - BALL_CENTER.coords;
    assert!(off.norm() < extent.radius_m, "{extent:?}");
    let without_depth_keyframes: Vec<Keyframe> = keyframes
        .iter()
        .map(|keyframe| Keyframe {
            depth: None,
            ..(**keyframe).clone()
        })
        .collect();
    let extent = Extent::of(without_depth_keyframes.iter());
    assert!(
        (Vector3::from(extent.center_m) - BALL_CENTER.coords).norm() < 0.05,
        "the center must be near the ball, which all cameras face: {extent:?}"
    );
    assert!((1.0..1.5).contains(&extent.radius_m), "{extent:?}");
    let alone = Extent::of(without_depth_keyframes[..1].iter());
    assert!(
        alone.radius_m > 0.0 && alone.center_m.iter().all(|along| along.is_finite()),
        "{alone:?}"
    );
    assert!(!extent.is_outgrown_by(&Extent {
        radius_m: 1.8 * extent.radius_m,
        ..extent
    }));
    assert!(extent.is_outgrown_by(&Extent {
        radius_m: 2.2 * extent.radius_m,
        ..extent
    }));
}

#[test]
fn outgrown_field_restarts_and_budget_is_enforced() {
    let near = scenes::ring(&[scenes::ball(BALL_CENTER)], BALL_CENTER, 2);
    let far_at = BALL_CENTER + Vector3::new(9.0, 0.0, 0.0);
    let far = scenes::ring(&[scenes::ball(far_at)], far_at, 2);
    let mut model = model_with(options(), &near);
    train_until(&mut model, 3);
    let before = *model.extent().unwrap();
    far.iter()
        .for_each(|keyframe| model.push(keyframe.clone()).unwrap());
    train_until(&mut model, 6);
    assert!(model.extent().unwrap().radius_m > 2.0 * before.radius_m);
    assert_eq!(model.progress().step, 6);

    let bytes = model.progress().bytes;
    let mut small = model_with(
        options().with(|options| options.common.max_bytes = Some(bytes / 2)),
        &near,
    );
    train_until(&mut small, 1);
    let keyframes = || near.iter().map(|keyframe| &**keyframe);
    let sizes = |max_bytes| {
        let options = options().with(|options| options.common.max_bytes = Some(max_bytes));
        Sizes::choose(
            &options,
            options.specific.nerf_budget.unwrap(),
            1 << 27,
            keyframes(),
            &before,
        )
    };
    let n_entries = |sizes: &Sizes| sizes.shape().n_entries_total();
    assert!(n_entries(&sizes(900_000).unwrap()) < n_entries(&sizes(1 << 30).unwrap()));
    assert!(matches!(sizes(1000), Err(Error::BudgetTooSmall { .. })));
}

#[test]
fn depth_marks_free_and_occupied_cells() {
    let keyframes = ball(1);
    let depth = keyframes[0].depth.as_ref().unwrap();
    let extent = Extent {
        center_m: BALL_CENTER.into(),
        radius_m: 1.0,
    };
    let march = March {
        step: 1.0 / 32.0,
        max_samples: 64,
        n_cells: 32,
    };
    let hints = carve::hints(&[&*keyframes[0]], &extent, &march);
    let hint_at = |at: Point3<f64>| {
        let in_scene_units: [f64; 3] = (at - BALL_CENTER).into();
        let cell = u32::try_from(march.cell(in_scene_units).0).unwrap();
        hints
            .iter()
            .filter(|hint| **hint & 0x3fff_ffff == cell)
            .map(|hint| hint >> 30)
            .max()
    };
    let eye = Point3::from(depth.world_from_camera.translation.vector);
    let towards = (BALL_CENTER - eye).normalize();
    let surface = eye + towards * ((BALL_CENTER - eye).norm() - 0.3);
    assert_eq!(hint_at(surface), Some(2), "near side of the ball");
    assert_eq!(
        hint_at(eye + (surface - eye) * 0.5),
        Some(1),
        "between camera and ball"
    );
    assert_eq!(hint_at(BALL_CENTER), None, "inside the ball");
    let mut cells: Vec<u32> = hints
        .iter()
        .filter(|hint| **hint >> 30 != 0)
        .map(|hint| hint & 0x3fff_ffff)
        .collect();
    cells.sort_unstable();
    assert!(
        cells.windows(2).all(|pair| pair[0] != pair[1]),
        "a cell has two hints"
    );
    assert!(
        hints.iter().any(|hint| hint >> 30 == 0),
        "the space around the ball must be unbounded"
    );
}

#[test]
fn depth_holes_mark_no_free_space() {
    let whole = ball(1).remove(0);
    let extent = Extent {
        center_m: BALL_CENTER.into(),
        radius_m: 1.0,
    };
    let march = March {
        step: 1.0 / 32.0,
        max_samples: 64,
        n_cells: 32,
    };
    let inside = u32::try_from(march.cell([0.0; 3]).0).unwrap();
    let hint_inside = |depth: Option<DepthMap>| {
        let keyframe = Keyframe {
            depth,
            ..(*whole).clone()
        };
        let hints = carve::hints(&[&keyframe], &extent, &march);
        hints
            .iter()
            .filter(|hint| **hint & 0x3fff_ffff == inside)
            .map(|hint| hint >> 30)
            .max()
    };
    let depth = whole.depth.as_ref().unwrap();
    let [width, height] = depth.size_px;
    // Removes the reading of every third pixel along both axes, or of a whole window.
    let punched = |is_hole: &dyn Fn(u32, u32) -> bool| {
        let mut depth_m = depth.depth_m.to_vec();
        for (ix, z_m) in (0..width * height).zip(&mut depth_m) {
            if is_hole(ix % width, ix / width) {
                *z_m = 0.0;
            }
        }
        DepthMap {
            depth_m: depth_m.into(),
            ..depth.clone()
        }
    };
    assert_eq!(
        hint_inside(Some(punched(&|x, y| x % 3 == 0 && y % 3 == 0))),
        None,
        "small holes must not mark cells as unbounded"
    );
    assert_eq!(
        hint_inside(Some(punched(
            &|x, y| x.abs_diff(width / 2) < 12 && y.abs_diff(height / 2) < 12
        ))),
        Some(0)
    );
    assert_eq!(
        hint_inside(None),
        Some(0),
        "an image without depth must mark cells as unbounded"
    );
    let [wide, _] = depth.focal_px.map(|focal| focal * 1e3);
    let narrow = DepthMap {
        focal_px: [wide; 2],
        ..punched(&|_, _| false)
    };
    let hint_next_to_hole = carve::hints(
        &[&Keyframe {
            depth: Some(narrow),
            ..(*whole).clone()
        }],
        &extent,
        &march,
    );
    assert!(
        hint_next_to_hole
            .iter()
            .filter(|hint| **hint >> 30 == 0)
            .count()
            > 500,
        "pixels outside the depth image must mark cells as unbounded"
    );
}

/// Errors of the extrinsics: 1 degree and 5 mm.
fn with_wrong_extrinsics(keyframe: &Arc<Keyframe>) -> Arc<Keyframe> {
    let correction = CameraCorrection {
        rotation_rad: [0.01, 0.012, -0.008],
        translation_m: [0.003, -0.0035, 0.002],
        ..CameraCorrection::default()
    };
    Arc::new(correction.corrected(keyframe))
}

#[test]
fn training_continues_with_corrected_cameras() {
    const N_BEFORE: u64 = 120;
    const N_AFTER: u64 = 40;
    let all = ball_on_floor(9);
    let test_view = &all[4];
    let seen = [&all[..4], &all[5..]].concat();
    let psnr_of =
        |model: &mut NerfModel| psnr(&model.render(&request(test_view)).unwrap(), test_view);
    let wrong: Vec<_> = seen.iter().map(with_wrong_extrinsics).collect();
    let corrected: Vec<_> = wrong
        .iter()
        .zip(&seen)
        .map(|(before, after)| CorrectedKeyframe {
            before: before.clone(),
            after: after.clone(),
        })
        .collect();
    let mut continued = model_with(options(), &wrong);
    train_until(&mut continued, N_BEFORE);
    let before = psnr_of(&mut continued);
    continued
        .recalibrate(&corrected, &Alignment::default())
        .unwrap();
    assert_eq!(continued.n_total_steps().unwrap(), N_BEFORE);
    let mut restarted = model_with(options(), &seen);
    let mut scores = Vec::new();
    for n in [N_AFTER, 2 * N_AFTER, 4 * N_AFTER] {
        train_until(&mut continued, N_BEFORE + n);
        train_until(&mut restarted, n);
        scores.push([psnr_of(&mut continued), psnr_of(&mut restarted)]);
    }
    let report = format!("{before:.2} dB before; continued, restarted: {scores:.2?}");
    assert!(
        scores[0][0] > scores[0][1] + 1.0 && scores[2][0] > scores[2][1] - 0.2,
        "{report}"
    );
}

#[test]
fn erased_object_is_not_drawn() {
    let keyframes = ball(8);
    let mut model = trained_model(&keyframes);
    let request = request(&keyframes[0]);
    let render = |model: &mut NerfModel, at: f64| {
        let world_from_box =
            Transform::translation(BALL_CENTER.x, BALL_CENTER.y + at, BALL_CENTER.z);
        let mut edits = Edits::default();
        edits
            .push(Edit::Box(Aabb {
                world_from_box,
                min_m: [-0.5; 3],
                max_m: [0.5; 3],
            }))
            .unwrap();
        model
            .render(&RenderRequest {
                edits: Arc::new(edits),
                ..request.clone()
            })
            .unwrap()
    };
    // The field is black outside the ball.
    let is_bright = |pixel: &&[u8]| {
        pixel[..3]
            .iter()
            .map(|value| u32::from(*value))
            .sum::<u32>()
            > 100
    };
    let n_bright = |picture: &Picture| picture.rgba_srgb.chunks_exact(4).filter(is_bright).count();
    let whole = model.render(&request).unwrap();
    let [n_whole, n_erased] = [n_bright(&whole), n_bright(&render(&mut model, 0.0))];
    assert!(
        n_whole > 1000 && 100 * n_erased < n_whole,
        "{n_whole} pixels of the ball, then {n_erased}"
    );
    let elsewhere = render(&mut model, 5.0);
    assert!(
        elsewhere.rgba_srgb == whole.rgba_srgb && elsewhere.depth_m == whole.depth_m,
        "the box is empty"
    );
    // The near side of the ball is erased, so that its far side is drawn.
    let to_camera = keyframes[0].world_from_camera.translation.vector - BALL_CENTER.coords;
    let half = Transform::face_towards(&BALL_CENTER, &(BALL_CENTER + to_camera), &Vector3::z());
    let mut edits = Edits::default();
    edits
        .push(Edit::Box(Aabb {
            world_from_box: half,
            min_m: [-0.5, -0.5, 0.0],
            max_m: [0.5; 3],
        }))
        .unwrap();
    let far_side = model
        .render(&RenderRequest {
            edits: Arc::new(edits),
            ..request.clone()
        })
        .unwrap();
    let n_farther = far_side
        .depth_m
        .iter()
        .zip(&whole.depth_m)
        .filter(|(far, near)| **far > **near + 0.1)
        .count();
    assert!(n_farther > 300, "{n_farther} pixels show the far side");
    let undone = model.render(&request).unwrap();
    assert!(
        undone.rgba_srgb == whole.rgba_srgb && undone.depth_m == whole.depth_m,
        "after an undo"
    );
    assert!(matches!(
        model.find_floaters(&Arc::default()),
        Err(Error::CannotFindFloaters)
    ));
}
