//! Tests of the whole trainer: quality on test views, reproducibility, and limits of memory and
//! splats.

use super::{SplatOptions, SplatTrainer};
use crate::eval::{PixelPair, psnr};
use crate::model_options::{CommonOptions, ModelOptions};
use crate::test_scenes::calibrated_camera;
use crate::view::Camera;
use crate::{Method, Packing, Projection, RenderRequest, Rendered};
use calibration::{CameraRefinement, ParamSet};
use gpu::Gpu;
use gpu::testing::test_gpu;
use keyframe::{DepthMap, Keyframe, Split};
use kinematics::{Stamp, Transform};
use model_files::splat::arrays::SplatArrays;
use model_files::splat::cloud::synthetic_cloud;
use model_files::{Aabb, InitialPoints};
use nalgebra::{Point3, Vector3};
use numbers::f32s_of;
use std::sync::Arc;

const SIZE_PX: [u32; 2] = [96, 80];
const FOCAL_PX: f64 = 90.0;

/// The inside of a colorful sphere, which is a closed surface with well-defined depth.
pub(super) fn scene() -> SplatArrays {
    const N_DISCS: usize = 400;
    let mut arrays = synthetic_cloud(N_DISCS, 3);
    for ix in 0..N_DISCS {
        // The discs are evenly distributed on a sphere (Vogel 1979) and face its center.
        let height = 1.0 - (2 * ix + 1) as f64 / N_DISCS as f64;
        let (angle, radius) = (ix as f64 * 2.399_963, (1.0 - height * height).sqrt());
        let out = Vector3::new(radius * angle.cos(), height, radius * angle.sin());
        let facing = nalgebra::UnitQuaternion::rotation_between(&Vector3::z(), &out)
            .expect("no disc is opposite to z");
        arrays.means[ix] = f32s_of((6.0 * out).into());
        arrays.rotations_wxyz[ix] = f32s_of([facing.w, facing.i, facing.j, facing.k]);
    }
    arrays.log_scales.fill([-0.6, -0.6, -4.0]);
    arrays.opacity_logits.fill(4.0);
    arrays
        .sh
        .chunks_exact_mut(16)
        .for_each(|coeffs| coeffs[1..].fill([0.0; 3])); // View-independent.
    arrays
}

pub(super) fn pose(ix: usize) -> Transform {
    let angle = ix as f64 * 0.12;
    let eye = Point3::new(
        3.2 * angle.sin(),
        -0.4 + 0.05 * ix as f64,
        -3.2 * angle.cos(),
    );
    // `face_towards` returns a frame with z forward. The rotation makes y point down.
    Transform::face_towards(&eye, &Point3::origin(), &Vector3::new(0.0, -1.0, 0.0))
        * nalgebra::UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI)
}

pub(super) fn request(world_from_camera: Transform) -> RenderRequest {
    RenderRequest {
        world_from_camera,
        size_px: SIZE_PX,
        projection: Projection::Pinhole {
            focal_px: [FOCAL_PX; 2],
            principal_px: [48.0, 40.0],
        },
        shutter: None,
        near_m: 0.01,
        far_m: 100.0,
        crop: None,
        edits: Arc::default(),
        background_srgb: [0.0; 3],
        appearance_of: None,
        depth: true,
    }
}

pub(super) fn keyframes(gpu: &Arc<Gpu>, with_depth: bool) -> Vec<Arc<Keyframe>> {
    n_keyframes(gpu, 10, with_depth)
}

pub(super) fn n_keyframes(gpu: &Arc<Gpu>, n: usize, with_depth: bool) -> Vec<Arc<Keyframe>> {
    let mut truth =
        SplatTrainer::from_arrays(gpu.clone(), ModelOptions::default(), &scene()).unwrap();
    (0..n)
        .map(|ix| {
            let world_from_camera = pose(ix);
            let picture = truth.render(&request(world_from_camera)).unwrap();
            let mut rgba = picture.rgba_srgb;
            rgba.chunks_exact_mut(4).for_each(|pixel| pixel[3] = 255);
            let (focal_px, principal_px) = ([FOCAL_PX; 2], [48.0, 40.0]);
            let depth = DepthMap {
                size_px: SIZE_PX,
                focal_px,
                principal_px,
                depth_m: picture.depth_m.into(),
                world_from_camera,
            };
            Arc::new(Keyframe {
                camera: "test".into(),
                stamp: Stamp(ix as i64),
                size_px: SIZE_PX,
                focal_px,
                principal_px,
                rgba_srgb: rgba.into(),
                depth: with_depth.then_some(depth),
                world_from_camera,
                twist: None,
                readout_secs: 0.0,
                joint_twists: [].into(),
                base: None,
                split: Split::of(ix),
                truth: None,
                robot: None,
            })
        })
        .collect()
}

/// Adds noise of up to a quarter of the value range. No model can score much more than 21 dB on
/// such images.
pub(super) fn noisy(keyframes: &[Arc<Keyframe>]) -> Vec<Arc<Keyframe>> {
    let noisy = |keyframe: &Arc<Keyframe>| {
        let mut state = keyframe.stamp.0.cast_unsigned();
        let mut rgba = keyframe.rgba_srgb.to_vec();
        for pixel in rgba.chunks_exact_mut(4) {
            for color in &mut pixel[..3] {
                state = state
                    .wrapping_mul(6_364_136_223_846_793_005)
                    .wrapping_add(1_442_695_040_888_963_407);
                let noise = i16::try_from((state >> 33) % 129).unwrap() - 64;
                *color = u8::try_from((i16::from(*color) + noise).clamp(0, 255)).unwrap();
            }
        }
        Arc::new(Keyframe {
            rgba_srgb: rgba.into(),
            ..keyframe.as_ref().clone()
        })
    };
    keyframes.iter().map(noisy).collect()
}

pub(super) fn options() -> ModelOptions<SplatOptions> {
    ModelOptions {
        common: CommonOptions {
            n_planned_steps: 300,
            ..CommonOptions::default()
        },
        specific: SplatOptions {
            max_splats: 4000,
            coarse_steps: Some([20, 60]),
            sh_degree: 1,
            ..SplatOptions::default()
        },
    }
}

pub(super) fn train(trainer: &mut SplatTrainer, n_steps: u64) {
    let end = trainer.progress().step + n_steps;
    while trainer.progress().step < end {
        trainer.step(end - trainer.progress().step).unwrap();
    }
}

/// Trains step by step, with one submit per step.
fn train_one_by_one(trainer: &mut SplatTrainer, n_steps: u64) {
    let end = trainer.progress().step + n_steps;
    while trainer.progress().step < end {
        trainer.step(1).unwrap();
    }
}

/// Trains in submits of up to 40 steps. One submit is always in flight.
fn train_in_long_submits(trainer: &mut SplatTrainer, n_steps: u64) {
    let end = trainer.progress().step + n_steps;
    while trainer.progress().step < end {
        trainer.assume_step_millis(0.5);
        trainer.step(end - trainer.progress().step).unwrap();
    }
}

pub(super) fn test_psnr(trainer: &mut SplatTrainer, keyframes: &[Arc<Keyframe>]) -> f64 {
    let tests: Vec<f64> = keyframes
        .iter()
        .filter(|keyframe| keyframe.split == Split::Test)
        .map(|keyframe| {
            let background_srgb = trainer.background_srgb();
            let request = RenderRequest {
                background_srgb,
                ..request(keyframe.world_from_camera)
            };
            let picture = trainer.render(&request).unwrap();
            psnr(&PixelPair::new(SIZE_PX, &picture.rgba_srgb, &keyframe.rgba_srgb).unwrap())
                .unwrap()
        })
        .collect();
    tests.iter().sum::<f64>() / tests.len() as f64
}

#[test]
fn training_predicts_test_views_and_is_reproducible() {
    let gpu = test_gpu();
    let keyframes = keyframes(&gpu, true);
    let run = |seed| {
        let mut trainer = SplatTrainer::new(
            gpu.clone(),
            options().with(|options| options.common.seed = seed),
        )
        .unwrap();
        for keyframe in &keyframes {
            trainer.push(keyframe.clone()).unwrap();
        }
        let before = test_psnr(&mut trainer, &keyframes);
        train(&mut trainer, 220);
        (
            before,
            test_psnr(&mut trainer, &keyframes),
            trainer.arrays().unwrap(),
        )
    };
    let (before, after, arrays) = run(1);
    // The seeds alone predict the views well.
    assert!(
        after > before + 1.0 && after > 28.0,
        "{before} -> {after} dB"
    );
    assert!(
        arrays.clone().checked().is_ok(),
        "a parameter is not finite"
    );
    assert!(run(1).2 == arrays, "the same seed gave a different result");
    assert!(
        run(2).2 != arrays,
        "the seed has no effect: the comparison cannot fail"
    );
}

/// A software adapter evicts images, which bounds the memory for any number of keyframes.
#[test]
fn image_memory_limit_holds_and_does_not_change_the_result() {
    const LEVEL_0_BYTES: u64 = 8 * SIZE_PX[0] as u64 * SIZE_PX[1] as u64;
    let gpu = test_gpu();
    let keyframes = n_keyframes(&gpu, 20, true);
    let n_train = keyframes
        .iter()
        .filter(|keyframe| keyframe.split == Split::Train)
        .count() as u64;
    let run = |max_bytes: u64, train: fn(&mut SplatTrainer, u64)| {
        let mut trainer = SplatTrainer::new(gpu.clone(), options()).unwrap();
        trainer.limit_image_bytes(max_bytes);
        for keyframe in &keyframes {
            trainer.push(keyframe.clone()).unwrap();
        }
        train(&mut trainer, 130);
        (
            trainer.image_bytes(),
            gpu.live_bytes(),
            trainer.arrays().unwrap(),
        )
    };
    let (image_bytes, live_bytes, arrays) = run(u64::MAX, train);
    // On a real GPU, the number of images that are uploaded ahead depends on the speed of the GPU.
    if gpu.is_software() {
        assert!(
            image_bytes >= n_train * LEVEL_0_BYTES
                && image_bytes < keyframes.len() as u64 * LEVEL_0_BYTES
        );
        assert!(
            image_bytes.is_multiple_of(LEVEL_0_BYTES),
            "coarse images are removed once training has passed their resolution"
        );
    }

    let max_bytes = 3 * LEVEL_0_BYTES;
    let (bounded_bytes, bounded_live, bounded) = run(max_bytes, train_one_by_one);
    // A real GPU uploads the images of many steps for one submit, which may exceed the limit.
    if gpu.is_software() {
        assert!(
            (1..=max_bytes).contains(&bounded_bytes),
            "{bounded_bytes} bytes of images"
        );
    }
    // Longer submits have slightly larger buffers, but the difference is smaller than any image.
    let unexplained = (live_bytes - bounded_live).abs_diff(image_bytes - bounded_bytes);
    assert!(
        unexplained < LEVEL_0_BYTES / 4,
        "evicted images were not freed: {unexplained} bytes"
    );
    assert!(bounded == arrays, "the memory limit changed the result");

    // A submit of many steps needs more images than the limit allows.
    let (_, _, bounded) = run(max_bytes, train_in_long_submits);
    assert!(
        bounded == arrays,
        "the memory limit changed the result of long submits"
    );
}

#[test]
fn trains_without_depth_from_random_points() {
    let gpu = test_gpu();
    let keyframes = keyframes(&gpu, false);
    let mut trainer = SplatTrainer::new(gpu, options()).unwrap();
    for keyframe in &keyframes {
        trainer.push(keyframe.clone()).unwrap();
    }
    train(&mut trainer, 10);
    let before = test_psnr(&mut trainer, &keyframes);
    train(&mut trainer, 120);
    let after = test_psnr(&mut trainer, &keyframes);
    assert!(after > before + 2.0, "{before} -> {after} dB");
}

#[test]
fn training_without_depth_starts_from_initial_points() {
    let gpu = test_gpu();
    let truth = scene();
    let points = Arc::new(InitialPoints {
        points_in_world_m: truth.means,
        colors_srgb: Vec::new(),
    });
    let started =
        |keyframes: &[Arc<Keyframe>], points: Option<&Arc<InitialPoints>>, max_splats: u32| {
            let mut trainer = SplatTrainer::new(
                gpu.clone(),
                options().with(|options| options.specific.max_splats = max_splats),
            )
            .unwrap();
            keyframes
                .iter()
                .for_each(|keyframe| trainer.push(keyframe.clone()).unwrap());
            if let Some(points) = points {
                assert!(trainer.set_initial_points(points));
            }
            trainer.prepare_for_test();
            trainer
        };
    let [without_depth, with_depth] = [false, true].map(|with_depth| keyframes(&gpu, with_depth));
    let n_points = points.points_in_world_m.len();
    let mut trainer = started(&without_depth, Some(&points), 1000);
    let seeds = trainer.arrays().unwrap();
    assert_eq!(
        (&seeds.means[..n_points], seeds.n_splats()),
        (&points.points_in_world_m[..], 1000)
    );
    let random = started(&without_depth, None, 1000).arrays().unwrap();
    assert_eq!(
        seeds.means[n_points..],
        random.means[..1000 - n_points],
        "the rest is random"
    );
    let few = started(&without_depth, Some(&points), 100)
        .arrays()
        .unwrap();
    let regular: Vec<[f32; 3]> = points
        .points_in_world_m
        .iter()
        .step_by(4)
        .copied()
        .collect();
    assert_eq!(few.means, regular, "at most the limit");
    let with_points = started(&with_depth, Some(&points), 1000).arrays().unwrap();
    assert!(
        with_points == started(&with_depth, None, 1000).arrays().unwrap(),
        "depth has priority"
    );

    // The same points give the same model, and a resumed run uses them, too.
    train(&mut trainer, 40);
    let mut again = started(&without_depth, Some(&points), 1000);
    train(&mut again, 20);
    let checkpoint = again.checkpoint().unwrap().finish().unwrap();
    let (mut resumed, untrained) =
        SplatTrainer::resume(gpu.clone(), &checkpoint, &without_depth).unwrap();
    untrained
        .into_iter()
        .for_each(|keyframe| resumed.push(keyframe).unwrap());
    resumed.set_initial_points(&points);
    train(&mut resumed, 20);
    assert!(resumed.arrays().unwrap() == trainer.arrays().unwrap());
}

/// The depth covers a band of coarse cells, as from a range scanner.
#[test]
fn areas_outside_a_depth_band_are_seeded_at_its_depth() {
    const SHARE: u32 = 4;
    let gpu = test_gpu();
    let with_band = |keyframe: Arc<Keyframe>| {
        let full = keyframe.depth.as_ref().unwrap();
        let size_px = full.size_px.map(|side| side / SHARE);
        let cell = |ix: u32| {
            let [column, row] = [ix % size_px[0], ix / size_px[0]];
            let middle = SHARE * row * full.size_px[0] + SHARE * column;
            if (8..12).contains(&row) {
                full.depth_m[middle as usize]
            } else {
                0.0
            }
        };
        let depth = DepthMap {
            size_px,
            focal_px: full.focal_px.map(|px| px / f64::from(SHARE)),
            principal_px: full.principal_px.map(|px| px / f64::from(SHARE)),
            depth_m: (0..size_px[0] * size_px[1]).map(cell).collect(),
            world_from_camera: full.world_from_camera,
        };
        Arc::new(Keyframe {
            depth: Some(depth),
            ..keyframe.as_ref().clone()
        })
    };
    let keyframes: Vec<_> = keyframes(&gpu, true).into_iter().map(with_band).collect();
    let mut trainer = SplatTrainer::new(gpu, options()).unwrap();
    trainer.push(keyframes[1].clone()).unwrap();
    trainer.step(1).unwrap();
    let camera_from_world = keyframes[1].world_from_camera.inverse();
    let mut n_in_rows = [0; 5]; // Rows of 16 pixels; the band is the third.
    for mean in trainer.arrays().unwrap().means {
        let point = camera_from_world * Point3::from(mean).cast::<f64>();
        let row = FOCAL_PX * point.y / point.z + 40.0;
        assert!(
            (0.5..12.0).contains(&point.z),
            "the band is 2 to 9 m away, a seed is at {} m",
            point.z
        );
        n_in_rows[[16.0, 32.0, 48.0, 64.0]
            .iter()
            .filter(|edge| row >= **edge)
            .count()] += 1;
    }
    assert!(n_in_rows.iter().all(|n| *n > 30), "{n_in_rows:?}");
    for keyframe in &keyframes[2..] {
        trainer.push(keyframe.clone()).unwrap();
    }
    train(&mut trainer, 150);
    assert!(
        test_psnr(&mut trainer, &keyframes) > 20.0,
        "{}",
        test_psnr(&mut trainer, &keyframes)
    );
}

/// A live scan may last longer than planned. Areas that arrive late must still get splats.
#[test]
fn late_keyframe_resumes_growth() {
    let gpu = test_gpu();
    let keyframes = keyframes(&gpu, true);
    let mut trainer = SplatTrainer::new(
        gpu,
        options().with(|options| options.specific.max_splats = 8_000),
    )
    .unwrap();
    for keyframe in &keyframes {
        trainer.push(keyframe.clone()).unwrap();
    }
    let n_splats_after = |trainer: &mut SplatTrainer, n_steps| {
        train(trainer, n_steps);
        trainer.progress().primitives
    };
    let planned = n_splats_after(&mut trainer, 300);
    assert_eq!(
        n_splats_after(&mut trainer, 200),
        planned,
        "growth has ended"
    );
    // A second copy of an image has no uncovered area in which splats could be seeded.
    trainer
        .push(Arc::new(Keyframe {
            stamp: Stamp(99),
            ..keyframes[1].as_ref().clone()
        }))
        .unwrap();
    assert!(
        n_splats_after(&mut trainer, 120) > planned,
        "growth continues"
    );
}

#[test]
fn crop_box_limits_the_picture() {
    /// The margin is larger than the radius of a disc.
    const MARGIN_M: f64 = 2.0;
    let gpu = test_gpu();
    let mut model = SplatTrainer::from_arrays(gpu, ModelOptions::default(), &scene()).unwrap();
    let whole = request(pose(0));
    let picture = model.render(&whole).unwrap();
    // A rotated box with one face through the middle of the view.
    let crop = Aabb {
        world_from_box: pose(0),
        min_m: [0.0, -20.0, -20.0],
        max_m: [20.0; 3],
    };
    let cropped = model
        .render(&RenderRequest {
            crop: Some(crop),
            ..whole.clone()
        })
        .unwrap();
    let [mut n_inside, mut n_outside] = [0; 2];
    for (ix, depth_m) in picture.depth_m.iter().enumerate() {
        let x_m = ((ix % SIZE_PX[0] as usize) as f64 + 0.5 - 48.0) / FOCAL_PX * f64::from(*depth_m);
        let pixels = [&picture, &cropped].map(|picture| &picture.rgba_srgb[4 * ix..4 * ix + 4]);
        if x_m > MARGIN_M {
            n_inside += 1;
            assert_eq!(pixels[0], pixels[1], "pixel {ix}");
        } else if x_m < -MARGIN_M {
            n_outside += 1;
            assert_eq!(
                (pixels[1], cropped.depth_m[ix]),
                (&[0; 4][..], 0.0),
                "pixel {ix}"
            );
        }
    }
    assert!(n_inside > 500 && n_outside > 500, "{n_inside} {n_outside}");
}

/// The newest image must not wait for the next image.
#[test]
fn newest_keyframe_is_trained_on() {
    let gpu = test_gpu();
    let keyframes = keyframes(&gpu, true);
    let mut trainer = SplatTrainer::new(gpu, options()).unwrap();
    trainer.push(keyframes[1].clone()).unwrap();
    train(&mut trainer, 60);
    // Only the newest image shows a white scene.
    let white = vec![255; keyframes[6].rgba_srgb.len()];
    let newest = Arc::new(Keyframe {
        rgba_srgb: white.clone().into(),
        ..keyframes[6].as_ref().clone()
    });
    let whiteness_db = |trainer: &mut SplatTrainer| {
        let picture = trainer.render(&request(newest.world_from_camera)).unwrap();
        psnr(&PixelPair::new(SIZE_PX, &picture.rgba_srgb, &white).unwrap()).unwrap()
    };
    let before_db = whiteness_db(&mut trainer);
    trainer.push(newest.clone()).unwrap();
    train(&mut trainer, 60);
    let after_db = whiteness_db(&mut trainer);
    assert!(
        after_db > before_db + 1.5,
        "{before_db} dB, then {after_db} dB"
    );
}

/// A trainer on many images with a trial of lens parameters.
fn trainer_with_lens_trial(
    keyframes: &[Arc<Keyframe>],
    gpu: Arc<Gpu>,
    max_splats: u32,
) -> SplatTrainer {
    let cameras = CameraRefinement::Try(vec![ParamSet::LENS]);
    let options = options().with(|options| {
        options.common.cameras = cameras;
        options.common.n_planned_steps = 1500;
        options.specific.max_splats = max_splats;
    });
    let mut trainer = SplatTrainer::new(gpu, options).unwrap();
    for keyframe in keyframes {
        trainer.push(keyframe.clone()).unwrap();
    }
    trainer
}

/// A focal length that is off by 10 % is detected on the validation images.
#[test]
fn wrong_lens_is_corrected_by_trial() {
    const FOCAL_ERROR: f64 = 1.1;
    let gpu = test_gpu();
    let true_keyframes = n_keyframes(&gpu, 60, true);
    let miscalibrated = true_keyframes.iter().map(|keyframe| {
        let focal_px = keyframe.focal_px.map(|focal| FOCAL_ERROR * focal);
        Arc::new(Keyframe {
            focal_px,
            ..keyframe.as_ref().clone()
        })
    });
    let miscalibrated: Vec<_> = miscalibrated.collect();
    let mut trainer = trainer_with_lens_trial(&miscalibrated, gpu, 2000);
    train(&mut trainer, 900);
    let found_focal_px = calibrated_camera(&mut trainer, &miscalibrated[0]).focal_px;
    assert!(
        trainer.trials()[0].kept,
        "{:?}, focal length {found_focal_px:?}",
        trainer.trials()
    );
    // The cameras rotate only about the vertical axis, so only the horizontal focal length is
    // determined. 400 steps correct about half of the error.
    assert!(
        (found_focal_px[0] / FOCAL_PX - 1.0).abs() < 0.6 * (FOCAL_ERROR - 1.0),
        "{found_focal_px:?}, expected {FOCAL_PX}"
    );
}

#[test]
fn running_trial_is_not_saved_but_repeated() {
    let gpu = test_gpu();
    let keyframes = n_keyframes(&gpu, 36, true);
    let mut trainer = trainer_with_lens_trial(&keyframes, gpu, 300);
    train(&mut trainer, 750);
    trainer.step(40).unwrap();
    assert!(trainer.progress().step < 750, "a lens trial is running");
    assert!(
        trainer.camera_corrections().unwrap().is_empty(),
        "corrections of a running trial are not reported"
    );
    let folder = tempfile::tempdir().unwrap();
    trainer.save(folder.path()).unwrap();
    assert!(
        trainer.camera_corrections().unwrap().is_empty(),
        "corrections of a running trial are not saved"
    );
    assert_eq!((trainer.progress().step, trainer.trials().len()), (750, 0));
    train(&mut trainer, 260);
    assert_eq!(trainer.trials().len(), 1);
}

/// Black splats are invisible in front of a black background, but they must still occlude and have
/// a depth.
#[test]
fn black_objects_stay_opaque() {
    let gpu = test_gpu();
    let mut trainer = SplatTrainer::new(gpu.clone(), options()).unwrap();
    let keyframes = keyframes(&gpu, true);
    for keyframe in &keyframes {
        let rgba = keyframe
            .rgba_srgb
            .chunks_exact(4)
            .flat_map(|pixel| [0, 0, 0, pixel[3]])
            .collect();
        trainer
            .push(Arc::new(Keyframe {
                rgba_srgb: rgba,
                ..keyframe.as_ref().clone()
            }))
            .unwrap();
    }
    train(&mut trainer, 250);
    let picture = trainer
        .render(&request(keyframes[0].world_from_camera))
        .unwrap();
    let expected_depth_m = &keyframes[0].depth.as_ref().unwrap().depth_m;
    let solid = expected_depth_m
        .iter()
        .zip(picture.rgba_srgb.chunks_exact(4))
        .filter(|(expected_m, _)| **expected_m > 0.0);
    let coverage: Vec<f64> = solid
        .map(|(_, pixel)| f64::from(pixel[3]) / 255.0)
        .collect();
    let mean = coverage.iter().sum::<f64>() / coverage.len() as f64;
    // The measured coverage is 0.89, and 0.003 with a constant black background.
    assert!(mean > 0.8, "coverage of pixels with depth: {mean}");
}

#[test]
fn byte_limit_holds() {
    let gpu = test_gpu();
    let keyframes = keyframes(&gpu, true);
    let base = options();
    let cap_bytes = 500 * base.specific.bytes_per_splat();
    let mut trainer = SplatTrainer::new(
        gpu,
        base.with(|options| options.common.max_bytes = Some(cap_bytes)),
    )
    .unwrap();
    for keyframe in &keyframes {
        trainer.push(keyframe.clone()).unwrap();
    }
    train(&mut trainer, 210);
    let progress = trainer.progress();
    assert!(
        progress.primitives > 0 && progress.bytes <= cap_bytes,
        "{progress:?}, limit {cap_bytes} bytes"
    );
}

#[test]
fn scratch_memory_grows_when_a_view_needs_more() {
    let gpu = test_gpu();
    let mut arrays = scene();
    arrays
        .log_scales
        .iter_mut()
        .for_each(|scale| *scale = [0.5; 3]); // Every splat covers every tile.
    arrays
        .opacity_logits
        .iter_mut()
        .for_each(|opacity| *opacity = -3.0);
    let keyframes = keyframes(&gpu, true);
    let mut trainer = SplatTrainer::from_arrays(
        gpu,
        options().with(|options| options.specific.coarse_steps = Some([0, 0])),
        &arrays,
    )
    .unwrap();
    for keyframe in &keyframes[1..4] {
        trainer
            .push(Arc::new(Keyframe {
                depth: None,
                ..keyframe.as_ref().clone()
            }))
            .unwrap();
    }
    // The buffers are too small at first. The result must come from the second attempt, with larger
    // buffers.
    let large = RenderRequest {
        size_px: [640, 480],
        ..request(pose(0))
    };
    let [first, second] = [0, 1].map(|_| trainer.render(&large).unwrap());
    assert!(first.rgba_srgb == second.rgba_srgb && first.depth_m == second.depth_m);
    assert!(first.rgba_srgb.iter().any(|byte| *byte > 0));
    train(&mut trainer, 12);
    let picture = trainer.render(&large).unwrap();
    assert!(picture.rgba_srgb.iter().any(|byte| *byte > 0));
    assert_eq!(trainer.progress().step, 12);
}

#[test]
fn equirectangular_agrees_with_pinhole() {
    let gpu = test_gpu();
    let mut trainer = SplatTrainer::from_arrays(gpu, ModelOptions::default(), &scene()).unwrap();
    let around = trainer
        .render(&RenderRequest {
            size_px: [512, 256],
            projection: Projection::Equirectangular,
            ..request(pose(2))
        })
        .unwrap();
    let ahead = trainer.render(&request(pose(2))).unwrap();
    for projection in [Projection::Equirectangular, request(pose(2)).projection] {
        let with_depth = RenderRequest {
            projection,
            ..request(pose(2))
        };
        let [with, without] = [true, false].map(|depth| {
            trainer
                .render(&RenderRequest {
                    depth,
                    ..with_depth.clone()
                })
                .unwrap()
        });
        assert!(with.rgba_srgb == without.rgba_srgb);
        assert_eq!(
            (with.depth_m.len(), without.depth_m.len()),
            ((SIZE_PX[0] * SIZE_PX[1]) as usize, 0)
        );
    }
    let middle = |picture: &crate::Picture| {
        let at = ((picture.size_px[1] / 2) * picture.size_px[0] + picture.size_px[0] / 2) as usize;
        (picture.rgba_srgb[4 * at], picture.depth_m[at])
    };
    let ((gray_around, depth_around), (gray_ahead, depth_ahead)) =
        (middle(&around), middle(&ahead));
    assert!(
        gray_around.abs_diff(gray_ahead) < 40 && (depth_around - depth_ahead).abs() < 0.1,
        "{:?} {:?}",
        middle(&around),
        middle(&ahead)
    );
}

/// The number of steps per submit depends on timing, so it must not affect splats or camera
/// parameters.
#[test]
fn submit_length_does_not_change_the_result() {
    let gpu = test_gpu();
    let keyframes = keyframes(&gpu, true);
    let params = ParamSet::EXTRINSICS | ParamSet::TIME_OFFSET;
    let learned = |train: fn(&mut SplatTrainer, u64)| {
        let options =
            options().with(|options| options.common.cameras = CameraRefinement::Always(params));
        let mut trainer = SplatTrainer::new(gpu.clone(), options).unwrap();
        for keyframe in &keyframes {
            trainer.push(keyframe.clone()).unwrap();
        }
        train(&mut trainer, 130);
        (
            trainer.arrays().unwrap(),
            trainer.camera_corrections().unwrap(),
        )
    };
    assert!(learned(train_in_long_submits) == learned(train_one_by_one));
}

/// With a viewer, submits are shorter and images are uploaded in smaller batches. This must not
/// change the result.
#[test]
fn viewers_shorten_submits_but_do_not_change_the_result() {
    let gpu = test_gpu();
    let keyframes = keyframes(&gpu, true);
    let learned = |watched: bool| {
        let mut trainer = SplatTrainer::new(gpu.clone(), options()).unwrap();
        for keyframe in &keyframes {
            trainer.push(keyframe.clone()).unwrap();
        }
        train(&mut trainer, 100);
        trainer.set_watched(watched);
        for _ in 0..2 {
            trainer.assume_step_millis(1.0);
            assert_eq!(trainer.step(100).unwrap(), if watched { 2 } else { 20 });
            if watched {
                let render_request = RenderRequest {
                    depth: false,
                    ..request(keyframes[0].world_from_camera)
                };
                assert!(trainer.render(&render_request).unwrap().depth_m.is_empty());
            }
        }
        let n_left = 160 - trainer.progress().step;
        train(&mut trainer, n_left);
        trainer.arrays().unwrap()
    };
    assert!(learned(true) == learned(false));
}

/// Submit lengths must not affect the end of a trial, after which validation images become training
/// images.
#[test]
fn submit_length_does_not_change_the_result_of_a_trial() {
    let gpu = test_gpu();
    let keyframes = n_keyframes(&gpu, 36, true);
    let learned = |train: fn(&mut SplatTrainer, u64)| {
        let mut trainer = trainer_with_lens_trial(&keyframes, gpu.clone(), 300);
        train(&mut trainer, 790);
        assert_eq!(
            (trainer.trials().len(), trainer.n_total_steps().unwrap()),
            (1, 790 + 250)
        );
        (
            trainer.arrays().unwrap(),
            trainer.camera_corrections().unwrap(),
        )
    };
    assert!(learned(train_in_long_submits) == learned(train_one_by_one));
}

/// A submit that overflows the intersection buffers is repeated together with the submit after it.
/// No step may count twice.
#[test]
fn buffer_overflow_does_not_change_the_result() {
    const N_STEPS: u64 = 90;
    let gpu = test_gpu();
    let keyframes = keyframes(&gpu, false);
    let mut cloud = synthetic_cloud(4000, 5);
    cloud.log_scales.fill([1.5; 3]); // Every splat covers every image, which overflows the buffers at full resolution.
    let learned = |train: fn(&mut SplatTrainer, u64)| {
        let mut trainer = SplatTrainer::from_arrays(gpu.clone(), options(), &cloud).unwrap();
        for keyframe in &keyframes {
            trainer.push(keyframe.clone()).unwrap();
        }
        train(&mut trainer, N_STEPS);
        // Learning rates and noise depend on the GPU's step counter.
        (
            trainer.n_total_steps().unwrap(),
            trainer.n_steps_on_gpu(),
            trainer.arrays().unwrap(),
        )
    };
    let (one_by_one, together) = (learned(train_one_by_one), learned(train_in_long_submits));
    assert_eq!((one_by_one.0, one_by_one.1), (N_STEPS, N_STEPS));
    assert_eq!((together.0, together.1), (N_STEPS, N_STEPS));
    assert!(one_by_one.2 == together.2);
}

/// Pictures are queued before any of them is read. The first pictures do not fit into the buffers.
#[test]
fn queued_pictures_equal_rendered_ones() {
    const MAX_MEAN_DIFFERENCE: f64 = 1.0; // JPEG error at quality 95, in units of 1/255.
    let gpu = test_gpu();
    let mut cloud = synthetic_cloud(2000, 5);
    cloud.log_scales.fill([1.5; 3]); // Every splat covers every image, which overflows the buffers.
    let packing = Packing {
        jpeg_quality: Some(95),
        depth: true,
    };
    let projection = Projection::Pinhole {
        focal_px: [4.0 * FOCAL_PX; 2],
        principal_px: [192.0, 160.0],
    };
    let requests = [0, 3].map(|ix| RenderRequest {
        size_px: SIZE_PX.map(|px| 4 * px),
        projection,
        ..request(pose(ix))
    });
    let mut trainer = SplatTrainer::from_arrays(gpu.clone(), options(), &cloud).unwrap();
    let queue = |trainer: &mut SplatTrainer| {
        requests.clone().map(|request| {
            let Projection::Pinhole {
                focal_px,
                principal_px,
            } = request.projection
            else {
                unreachable!()
            };
            let camera = Camera::from_request(&request, focal_px, principal_px);
            trainer
                .queue_view(&camera, request.background_srgb, packing)
                .unwrap()
        })
    };
    for queued in queue(&mut trainer) {
        assert!(
            queued.finish(&gpu).unwrap().is_none(),
            "the buffers must be too small"
        );
    }
    let rendered = requests
        .clone()
        .map(|request| trainer.render(&request).unwrap());
    for (queued, rendered) in queue(&mut trainer).into_iter().zip(rendered) {
        let Some(Rendered::Packed(packed)) = queued.finish(&gpu).unwrap() else {
            panic!("the picture is not packed")
        };
        let decoded = image::load_from_memory(&packed.jpeg.unwrap())
            .unwrap()
            .to_rgb8();
        let pixels = rendered
            .rgba_srgb
            .chunks_exact(4)
            .flat_map(|pixel| &pixel[..3]);
        let sum: f64 = decoded
            .as_raw()
            .iter()
            .zip(pixels)
            .map(|(a, b)| f64::from(a.abs_diff(*b)))
            .sum();
        let mean = sum / decoded.as_raw().len() as f64;
        assert!(
            mean < MAX_MEAN_DIFFERENCE,
            "colors differ by {mean} on average"
        );
        let depth = packed.depth.unwrap();
        let furthest_m = rendered.depth_m.iter().copied().fold(0.0, f32::max);
        assert!((depth.meters_per_count * 65535.0 / f64::from(furthest_m) - 1.0).abs() < 0.1);
        assert_eq!(depth.counts.len(), 2 * 192 * 160);
    }
}
