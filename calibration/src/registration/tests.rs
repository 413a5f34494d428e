//! Tests in a room of textured planes, observed by a camera on an arm with four joints, with one
//! calibration error at a time.

use super::*;
use crate::scenes::*;
use keyframe::Keyframe;
use kinematics::{Transform, Twist, transform};
use nalgebra::Vector3;
use numbers::quantile::{Rank, quantile};
use numbers::random::Random;

fn align_given(miscalibration: &Miscalibration, set: ParamSet) -> Alignment {
    align(&capture(miscalibration), &CameraRefinement::Always(set)).unwrap()
}

fn align_by_trials(miscalibration: &Miscalibration) -> Alignment {
    align(
        &capture(miscalibration),
        &CameraRefinement::Try(candidates()),
    )
    .unwrap()
}

#[test]
fn wrong_extrinsics_are_found() {
    let miscalibration = Miscalibration {
        extrinsics: wrong_extrinsics(),
        ..Miscalibration::none()
    };
    let alignment = align_given(&miscalibration, ParamSet::EXTRINSICS);
    let (degrees, mm) = remaining(&alignment.corrections["wrist"], &miscalibration.extrinsics);
    assert!(degrees < 0.05 && mm < 0.5, "{degrees} degrees, {mm} mm");
}

#[test]
fn wrong_time_offset_is_found() {
    let alignment = align_given(
        &Miscalibration {
            time_offset_secs: 0.02,
            ..Miscalibration::none()
        },
        ParamSet::TIME_OFFSET,
    );
    assert!((alignment.corrections["wrist"].time_offset_secs - 0.02).abs() < 5e-4);
}

#[test]
fn wrong_joint_offsets_are_found() {
    let miscalibration = Miscalibration {
        joints: [0.0, 0.009, -0.007, 0.002],
        ..Miscalibration::none()
    };
    let alignment = align_given(&miscalibration, ParamSet::JOINTS);
    let offsets = &alignment.corrections["wrist"].joint_offsets;
    for joint in 1..4 {
        assert!(
            (offsets[joint] - miscalibration.joints[joint]).abs() < 5e-4,
            "{offsets:?}"
        );
    }
    // The first joint rotates the whole world.
    assert!(
        offsets[0].abs() < 1e-4 && alignment.unobservable.len() == 1,
        "{offsets:?} {:?}",
        alignment.unobservable
    );
    assert_eq!(alignment.unobservable[0].parts, ["offset of joint 0"]);
}

#[test]
fn wrong_depth_pose_is_found() {
    let deviation = Transform::new(
        Vector3::new(0.004, -0.003, 0.002),
        Vector3::new(-0.006, 0.008, 0.005),
    );
    let alignment = align_given(
        &Miscalibration {
            depth_pose: deviation,
            ..Miscalibration::none()
        },
        ParamSet::DEPTH_POSE,
    );
    let correction = &alignment.corrections["wrist"];
    // The input pose is the true pose times the deviation. The correction is applied from the left
    // to `color_from_depth`.
    let base = Transform::new(Vector3::new(0.02, 0.0, 0.0), Vector3::zeros());
    let estimated = crate::rigid_transform(
        correction.depth_rotation_rad.into(),
        correction.depth_translation_m.into(),
    ) * base
        * deviation;
    let remaining = base.inverse() * estimated;
    assert!(
        remaining.rotation.angle().to_degrees() < 0.06
            && remaining.translation.vector.norm() < 1e-3,
        "{remaining:?}"
    );
}

#[test]
fn wrong_lens_is_found() {
    let alignment = align_given(
        &Miscalibration {
            focal_frac: 0.01,
            ..Miscalibration::none()
        },
        ParamSet::LENS,
    );
    let correction = &alignment.corrections["wrist"];
    assert!(
        correction
            .log_focal
            .iter()
            .all(|log| (log.exp() * 1.01 - 1.0).abs() < 1.5e-3),
        "{correction:?}"
    );
    assert!(
        correction
            .principal_offset_focals
            .iter()
            .all(|translation| translation.abs() < 1.5e-3),
        "{correction:?}"
    );
}

#[test]
fn wrong_depth_scale_is_found() {
    let alignment = align_given(
        &Miscalibration {
            depth_frac: 0.01,
            ..Miscalibration::none()
        },
        ParamSet::DEPTH_SCALE,
    );
    assert!((alignment.corrections["wrist"].log_depth_scale.exp() * 0.99 - 1.0).abs() < 1e-3);
}

#[test]
fn wrong_readout_time_is_found() {
    let miscalibration = Miscalibration {
        has_rolling_shutter: true,
        readout_secs: 0.012,
        ..Miscalibration::none()
    };
    let alignment = align_given(&miscalibration, ParamSet::READOUT);
    assert!((alignment.corrections["wrist"].readout_secs - 0.012).abs() < 1.5e-3);
}

#[test]
fn unobservable_extrinsics_are_reported_even_if_correct() {
    let alignment = align_by_trials(&Miscalibration {
        azimuth_only: true,
        ..Miscalibration::none()
    });
    assert!(!alignment.has_corrections(), "{alignment:?}");
    let parts: Vec<_> = alignment
        .unobservable
        .iter()
        .flat_map(|unobservable| &unobservable.parts)
        .collect();
    assert!(
        parts
            .iter()
            .any(|part| part.starts_with("translation of camera \"wrist\" along")),
        "{parts:?}"
    );
    assert!(
        align_by_trials(&Miscalibration::none())
            .unobservable
            .is_empty(),
        "all directions are observable with full motion"
    );
}

#[test]
fn rotation_about_one_axis_leaves_extrinsics_unobservable() {
    let miscalibration = Miscalibration {
        extrinsics: wrong_extrinsics(),
        azimuth_only: true,
        ..Miscalibration::none()
    };
    let alignment = align_given(&miscalibration, ParamSet::EXTRINSICS);
    assert_eq!(
        alignment.unobservable.len(),
        2,
        "{:?}",
        alignment.unobservable
    );
    assert_eq!(alignment.unobservable[0].parts.len(), 1);
    assert!(
        alignment.unobservable[0].parts[0].starts_with("translation of camera \"wrist\" along")
    );
    // This is the vertical direction of the base in the camera's axes. The correction along this
    // direction is zero.
    let up = (camera_at(joints_at(0.0, true)) * miscalibration.extrinsics)
        .rotation
        .inverse()
        * Vector3::z();
    let translation: Vector3<f64> = alignment.corrections["wrist"].translation_m.into();
    assert!(
        translation.dot(&up).abs() < 1e-4,
        "{translation:?} along {up:?}"
    );
}

#[test]
fn correct_calibration_is_left_unchanged() {
    for has_rolling_shutter in [false, true] {
        let alignment = align_by_trials(&Miscalibration {
            has_rolling_shutter,
            ..Miscalibration::none()
        });
        assert!(!alignment.has_corrections(), "{:?}", alignment.estimates);
        assert_eq!(
            alignment.trials.len(),
            if has_rolling_shutter { 8 } else { 7 }
        );
    }
}

#[test]
fn only_the_cause_is_corrected() {
    let kept = |miscalibration: &Miscalibration| -> Vec<String> {
        align_by_trials(miscalibration)
            .trials
            .iter()
            .filter(|trial| trial.kept)
            .map(|trial| trial.candidate.to_string())
            .collect()
    };
    assert_eq!(
        kept(&Miscalibration {
            extrinsics: wrong_extrinsics(),
            ..Miscalibration::none()
        }),
        ["extrinsics"]
    );
    assert_eq!(
        kept(&Miscalibration {
            time_offset_secs: 0.02,
            ..Miscalibration::none()
        }),
        ["time offsets"]
    );
}

#[test]
fn reported_sigmas_match_actual_errors() {
    const SEEDS: u64 = 6;
    let mut squares = Vec::new();
    for seed in 0..SEEDS {
        let miscalibration = Miscalibration {
            extrinsics: wrong_extrinsics(),
            seed,
            noise: 3.0,
            ..Miscalibration::none()
        };
        let scene = AlignmentScene::new(&capture(&miscalibration), false).unwrap();
        let layout = scene.layout(ParamSet::EXTRINSICS);
        let fit = fit::fit(&scene.images, &scene.pairs, layout, &Corrections::none(1)).unwrap();
        let correction = &fit.corrections.by_camera[0];
        let remaining = transform::log(
            &(miscalibration.extrinsics
                * crate::rigid_transform(
                    correction.rotation_rad.into(),
                    correction.translation_m.into(),
                )
                .inverse()),
            1.0,
        );
        let errors = remaining
            .linear_m_s
            .iter()
            .chain(remaining.angular_rad_s.iter());
        squares.extend(
            errors
                .enumerate()
                .map(|(ix, error)| (error / fit.solution.sigma(ix)).powi(2)),
        );
    }
    let mean = squares.iter().sum::<f64>() / squares.len() as f64;
    assert!((0.25..4.0).contains(&mean), "{mean} of {squares:.1?}");
}

/// Squared errors of the extrinsics, in units of their stated variances, along and about the axes
/// of the camera.
fn squared_extrinsics_errors(miscalibration: &Miscalibration, set: ParamSet) -> [f64; 6] {
    let alignment = align_given(miscalibration, set);
    let correction = &alignment.corrections["wrist"];
    let corrected = crate::rigid_transform(
        correction.rotation_rad.into(),
        correction.translation_m.into(),
    )
    .inverse();
    let error = transform::log(&(miscalibration.extrinsics * corrected), 1.0);
    let covariance = alignment.extrinsics_covariance.as_ref();
    let sigmas = covariance
        .and_then(|known| known.of_camera("wrist"))
        .expect("extrinsics were estimated");
    std::array::from_fn(|ix| {
        let in_sigmas = match ix {
            0..3 => error.linear_m_s[ix] / sigmas.m[ix],
            _ => error.angular_rad_s[ix - 3] / sigmas.rad[ix - 3],
        };
        in_sigmas.powi(2)
    })
}

#[test]
fn errors_match_stated_variances_with_a_time_offset() {
    const SEEDS: u64 = 6;
    // The mean is over 36 squares, of which only some are independent. The stated variances contain
    // a discretization error, which is larger than the real discretization error in small images.
    const MAX_RATIO: f64 = 1.5;
    let mut squares = Vec::new();
    for seed in 0..SEEDS {
        let miscalibration = Miscalibration {
            extrinsics: wrong_extrinsics(),
            time_offset_secs: 0.05,
            seed,
            ..Miscalibration::none()
        };
        let set = ParamSet::EXTRINSICS | ParamSet::TIME_OFFSET;
        squares.extend(squared_extrinsics_errors(&miscalibration, set));
    }
    let mean = squares.iter().sum::<f64>() / squares.len() as f64;
    assert!(mean < MAX_RATIO, "{mean} of {squares:.1?}");
}

#[test]
fn accelerations_reduce_the_error_of_extrinsics_with_a_time_offset() {
    // With this offset, constant velocities give pose errors of about 0.8 mm, which exceed the
    // discretization error. Less than half of the error of the extrinsics may be left.
    const OFFSET_SECS: f64 = 0.08;
    const MAX_RATIO: f64 = 0.5;
    let miscalibration = Miscalibration {
        extrinsics: wrong_extrinsics(),
        time_offset_secs: OFFSET_SECS,
        noise: 0.1,
        ..Miscalibration::none()
    };
    let keyframes = capture(&miscalibration);
    let mut scene = AlignmentScene::new(&keyframes, false).unwrap();
    let uncorrected = CalibrationModel {
        set: ParamSet::empty(),
        fit: None,
        corrections: Corrections::none(1),
    };
    let set = ParamSet::EXTRINSICS | ParamSet::TIME_OFFSET;
    let first = scene.model(set, &uncorrected).unwrap();
    let error_mm = |model: &CalibrationModel| {
        remaining(&model.corrections.by_camera[0], &miscalibration.extrinsics).1
    };
    let first_mm = error_mm(&first);
    let second_mm = error_mm(&scene.with_accelerations(first, &keyframes));
    assert!(
        second_mm < MAX_RATIO * first_mm,
        "{first_mm} mm with constant velocities, {second_mm} mm with accelerations"
    );
}

/// The reported uncertainty contains the error that all pairs have in common.
#[test]
fn truth_is_within_the_stated_extrinsics() {
    const MAX_SIGMAS: f64 = 3.0;
    let (mut error_norms, mut sigma_norms) = (0.0, 0.0);
    for seed in 0..4 {
        for noise in [0.1, 1.0] {
            let miscalibration = Miscalibration {
                extrinsics: wrong_extrinsics(),
                seed,
                noise,
                ..Miscalibration::none()
            };
            let alignment = align_given(&miscalibration, ParamSet::EXTRINSICS);
            let correction = &alignment.corrections["wrist"];
            let corrected = crate::rigid_transform(
                correction.rotation_rad.into(),
                correction.translation_m.into(),
            )
            .inverse();
            let error = transform::log(&(miscalibration.extrinsics * corrected), 1.0);
            let covariance = alignment
                .extrinsics_covariance
                .as_ref()
                .expect("extrinsics were estimated");
            let sigmas = covariance
                .of_camera("wrist")
                .expect("extrinsics were estimated");
            for axis in 0..3 {
                let (m, rad) = (
                    error.linear_m_s[axis].abs(),
                    error.angular_rad_s[axis].abs(),
                );
                assert!(m < MAX_SIGMAS * sigmas.m[axis], "{m} m of {sigmas:?}");
                assert!(
                    rad < MAX_SIGMAS * sigmas.rad[axis],
                    "{rad} rad of {sigmas:?}"
                );
            }
            error_norms += error.linear_m_s.norm();
            sigma_norms += Vector3::from(sigmas.m).norm();
        }
    }
    assert!(
        sigma_norms < 10.0 * error_norms,
        "stated {sigma_norms}, measured {error_norms}"
    );
}

#[test]
fn result_does_not_depend_on_thread_count() {
    let keyframes = capture(&Miscalibration {
        extrinsics: wrong_extrinsics(),
        ..Miscalibration::none()
    });
    let choice = CameraRefinement::Always(ParamSet::EXTRINSICS | ParamSet::IMAGE_POSES);
    let with_threads = |n: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(n)
            .build()
            .unwrap();
        pool.install(|| align(&keyframes, &choice)).unwrap()
    };
    assert_eq!(with_threads(1), with_threads(3));
}

/// Sets a linear brightness ramp, so that interpolated brightness and its gradient are exact.
fn set_linear_brightness(image: &mut PreparedImage) {
    let [width, height] = SIZE_PX.map(|side| side as usize);
    let value = |ix: usize| 40.0 + 0.5 * (ix % width) as f32 + 0.7 * (ix / width) as f32;
    image.levels = vec![prepared_image::GrayImage::new(
        [width, height],
        1.0,
        &(0..width * height).map(value).collect::<Vec<_>>(),
    )];
}

/// Differences between a pair's Jacobian and central differences, as fractions of the largest
/// derivative of each parameter. The result is the 90th percentile, because a few samples cross
/// between depth readings and have a kink there.
fn max_jacobian_errors(has_rolling_shutter: bool) -> Vec<(layout::CalibrationParam, f64, f64)> {
    const STEP: f64 = 1e-3; // Relative to the parameter's scale.
    let miscalibration = Miscalibration {
        noise: 0.0,
        has_rolling_shutter,
        ..Miscalibration::none()
    };
    let mut scene = AlignmentScene::new(&capture(&miscalibration), false).unwrap();
    scene.images.iter_mut().for_each(set_linear_brightness);
    let all: ParamSet = candidates().into_iter().collect();
    let layout = scene.layout(all);
    let mut here = Corrections::none(1);
    // Joint offsets are zero. To first order, their columns are the columns at the measured joint
    // positions.
    let displaced = layout
        .params
        .iter()
        .enumerate()
        .map(|(ix, param)| match param {
            layout::CalibrationParam::Joint(_) => 0.0,
            param => 0.3 * param.scale() * (ix as f64 * 1.3).sin(),
        });
    here.apply_step(
        &layout,
        &nalgebra::DVector::from_iterator(layout.n(), displaced),
    );
    let tone = residual::Tone {
        gain: 0.9,
        offset: 4.0,
    };
    let pair = scene.pairs[scene.pairs.len() / 2];
    let options = sums::ResidualOptions {
        level: 0,
        occlusion_frac: 0.1,
        noise: sums::Noise {
            photo: 1.0,
            depth: 1.0,
        },
        part: sums::PixelSubset::All,
    };
    let cast_pixel = |corrections: &Corrections| {
        let views = corrections.views(&scene.images, &layout);
        let correspondences = sums::correspondences(
            sums::sides(&scene.images, &views, pair),
            &scene.images[pair.from].samples,
            &options,
        );
        (correspondences, views)
    };
    let (correspondences, views) = cast_pixel(&here);
    let param_columns =
        [pair.from, pair.to].map(|ix| residual::ParamColumns::new(&views[ix], |param| param));
    let max_errors = |ix: usize, param: layout::CalibrationParam| {
        let perturbed = |sign: f64| {
            let mut there = here.clone();
            let mut step = nalgebra::DVector::zeros(layout.n());
            step[ix] = sign * STEP * param.scale();
            there.apply_step(&layout, &step);
            cast_pixel(&there).0
        };
        let (ahead, behind) = (perturbed(1.0), perturbed(-1.0));
        let mut row = vec![0.0; layout.n() + 2];
        let (mut max_gradients, mut deviation) = ([0.0f64; 2], [Vec::new(), Vec::new()]);
        for ((correspondence, ahead), behind) in correspondences.iter().zip(&ahead).zip(&behind) {
            let (Some(correspondence), Some(ahead), Some(behind)) = (correspondence, ahead, behind)
            else {
                continue;
            };
            let numeric = [
                ahead.photo(tone) - behind.photo(tone),
                ahead.depth() - behind.depth(),
            ];
            correspondence.photo_jacobian(&param_columns[0], &param_columns[1], tone, &mut row);
            let photo = row[ix];
            correspondence.depth_jacobian(&param_columns[0], &param_columns[1], &mut row);
            for (kind, gradient) in [photo, row[ix]].into_iter().enumerate() {
                max_gradients[kind] = max_gradients[kind].max(gradient.abs() * param.scale());
                deviation[kind]
                    .push((gradient * param.scale() - numeric[kind] / (2.0 * STEP)).abs());
            }
        }
        let share = |kind: usize| {
            let deviation =
                quantile(&mut deviation[kind].clone(), 0.9, Rank::Upper).expect("residuals");
            // The first joint does not affect pairs, so the only difference is the rounding of
            // brightness to f32.
            deviation / max_gradients[kind].max([0.1, 1e-3][kind])
        };
        (param, share(0), share(1))
    };
    layout
        .params
        .iter()
        .enumerate()
        .map(|(ix, param)| max_errors(ix, *param))
        .collect()
}

#[test]
fn jacobians_match_central_differences() {
    const TOLERANCE: f64 = 0.01; // Readings are stored in f32, and the Jacobian treats the depth weight as constant.
    // The Jacobian ignores that the lens moves points to other rows, and that other extrinsics
    // change the motion during readout.
    const ROLLING_TOLERANCE: f64 = 0.05;
    for (has_rolling_shutter, tolerance) in [(false, TOLERANCE), (true, ROLLING_TOLERANCE)] {
        let max_errors = max_jacobian_errors(has_rolling_shutter);
        assert_eq!(max_errors.len(), if has_rolling_shutter { 23 } else { 22 });
        for (param, photo, depth) in &max_errors {
            assert!(
                *photo < tolerance && *depth < tolerance,
                "{param:?}: {photo:.4} {depth:.4} of {max_errors:.4?}"
            );
        }
    }
}

#[test]
fn too_few_keyframes_give_none_and_test_keyframes_are_not_used() {
    let keyframes = capture(&Miscalibration::none());
    let choice = CameraRefinement::Try(candidates());
    assert_eq!(align(&[], &choice), None);
    assert_eq!(align(&keyframes[..2], &choice), None);
    // Corrupting test keyframes changes nothing.
    let corrupted = |keyframe: &Arc<Keyframe>| match keyframe.split {
        Split::Test => Arc::new(Keyframe {
            world_from_camera: Transform::identity(),
            ..keyframe.as_ref().clone()
        }),
        Split::Train | Split::Validation => keyframe.clone(),
    };
    let align_given = CameraRefinement::Always(ParamSet::EXTRINSICS);
    assert_eq!(
        align(&keyframes, &align_given),
        align(
            &keyframes.iter().map(corrupted).collect::<Vec<_>>(),
            &align_given
        )
    );
}

#[test]
fn drifting_image_poses_are_corrected() {
    let keyframes: Vec<Arc<Keyframe>> = capture(&Miscalibration::none())
        .iter()
        .map(|keyframe| {
            // The pose errors are smooth and a few millimeters, as in a SLAM system. The motion is
            // unknown.
            let secs = keyframe.stamp.0 as f64 * 1e-9;
            let wave = |hz: f64, phase: f64| (6.3 * hz * secs + phase).sin();
            let drift = Transform::new(
                Vector3::new(wave(0.07, 0.0), wave(0.05, 1.0), wave(0.06, 2.0)) * 0.006,
                Vector3::new(wave(0.05, 0.5), wave(0.06, 1.5), wave(0.07, 2.5)) * 0.008,
            );
            let mut moved = keyframe.as_ref().clone();
            moved.world_from_camera *= drift;
            if let Some(depth) = &mut moved.depth {
                depth.world_from_camera = moved.world_from_camera
                    * keyframe.world_from_camera.inverse()
                    * depth.world_from_camera;
            }
            (moved.twist, moved.joint_twists) = (None, [].into());
            Arc::new(moved)
        })
        .collect();
    let alignment = align(&keyframes, &CameraRefinement::Try(candidates())).unwrap();
    let trial = alignment.trials.last().unwrap();
    let has_poses = matches!(trial.candidate, Candidate::Cameras(params) if params.contains(ParamSet::IMAGE_POSES));
    assert!(
        has_poses && trial.kept && trial.gain_db > 3.0,
        "{:?}",
        alignment.lines()
    );
}

/// Seed of the pose errors of the first image. Errors of 10 mm are at the limit of convergence.
/// With two of six seeds, single images converge to wrong poses.
const NOISE_SEED: u64 = 1000;

/// The capture with random errors in every pose except the poses of test images. The errors are
/// `mm` millimeters along each axis, and a tenth of a degree per millimeter about each axis.
fn noisy(mm: f64, from_joints: bool) -> Vec<Arc<Keyframe>> {
    let moved = |(ix, keyframe): (usize, &Arc<Keyframe>)| {
        if keyframe.split == Split::Test {
            return keyframe.clone();
        }
        let mut random = Random::new(NOISE_SEED + ix as u64);
        let mut axes = || Vector3::from_fn(|_, _| random.normal());
        let deviation = Transform::new(axes() * 1e-3 * mm, axes() * (0.1 * mm).to_radians());
        let mut moved = keyframe.as_ref().clone();
        moved.world_from_camera *= deviation;
        if let Some(depth) = &mut moved.depth {
            depth.world_from_camera = moved.world_from_camera
                * keyframe.world_from_camera.inverse()
                * depth.world_from_camera;
        }
        if !from_joints {
            (moved.twist, moved.joint_twists) = (None, [].into());
        }
        Arc::new(moved)
    };
    capture(&Miscalibration::none())
        .iter()
        .enumerate()
        .map(moved)
        .collect()
}

/// Mean relative errors of the poses, millimeters and degrees. The common motion that minimizes the
/// errors is removed first.
fn relative_pose_errors(estimates: &[Transform], expected: &[Transform]) -> (f64, f64) {
    let mut common = Transform::identity();
    for _ in 0..10 {
        let remaining: Vec<Twist> = estimates
            .iter()
            .zip(expected)
            .map(|(estimates, expected)| {
                transform::log(&(common * estimates * expected.inverse()), 1.0)
            })
            .collect();
        let n = remaining.len() as f64;
        let mean = Twist {
            linear_m_s: remaining
                .iter()
                .map(|remaining| remaining.linear_m_s)
                .sum::<Vector3<f64>>()
                / n,
            angular_rad_s: remaining
                .iter()
                .map(|remaining| remaining.angular_rad_s)
                .sum::<Vector3<f64>>()
                / n,
        };
        common = transform::exp(&mean, -1.0) * common;
    }
    let remaining = |(estimates, expected): (&Transform, &Transform)| {
        let remaining = expected.inverse() * common * estimates;
        (
            1e3 * remaining.translation.vector.norm(),
            remaining.rotation.angle().to_degrees(),
        )
    };
    let remaining: Vec<(f64, f64)> = estimates.iter().zip(expected).map(remaining).collect();
    let mean =
        |of: fn(&(f64, f64)) -> f64| remaining.iter().map(of).sum::<f64>() / remaining.len() as f64;
    (mean(|remaining| remaining.0), mean(|remaining| remaining.1))
}

#[test]
fn noisy_image_poses_are_corrected_except_test_images() {
    let expected = capture(&Miscalibration::none());
    for (mm, from_joints) in [(2.0, false), (5.0, true), (10.0, true)] {
        let keyframes = noisy(mm, from_joints);
        let alignment = align(&keyframes, &CameraRefinement::Try(candidates())).unwrap();
        assert!(
            alignment.has_image_poses(),
            "{mm} mm: {:?}",
            alignment.lines()
        );
        let correction = &alignment.corrections["wrist"];
        let remaining = |split: Split| {
            let both = keyframes
                .iter()
                .zip(&expected)
                .filter(|(keyframe, _)| keyframe.split == split);
            let (estimates, expected): (Vec<Transform>, Vec<Transform>) = both
                .map(|(keyframe, expected)| {
                    (
                        correction.apply(keyframe).world_from_camera,
                        expected.world_from_camera,
                    )
                })
                .unzip();
            relative_pose_errors(&estimates, &expected)
        };
        for split in [Split::Train, Split::Validation] {
            let (remaining_mm, remaining_degrees) = remaining(split);
            assert!(
                remaining_mm < 0.3 && remaining_degrees < 0.02,
                "{mm} mm: {remaining_mm} mm, {remaining_degrees} degrees"
            );
        }
        let (test_mm, test_degrees) = remaining(Split::Test);
        assert!(
            test_mm < 1e-6 && test_degrees < 1e-6,
            "{mm} mm of noise: test poses changed by {test_mm} mm"
        );
        assert!(
            correction.drift_weight == 0.0,
            "{}",
            correction.drift_weight
        );
    }
}
