//! Tests with invalid keyframes and splats. Training continues, and no non-finite value reaches a
//! parameter.

use super::SplatTrainer;
use super::training_tests::{keyframes, options, test_psnr, train};
use crate::Method;
use gpu::testing::test_gpu;
use keyframe::{DepthMap, Keyframe};
use kinematics::{Stamp, Transform, Twist};
use model_files::splat::cloud::synthetic_cloud;
use nalgebra::{Point3, Vector3};
use numbers::f32_of;
use std::sync::Arc;

/// Trains on valid and corrupted keyframes. The result must be about as good as with the valid
/// keyframes alone.
#[test]
fn invalid_keyframes_do_not_affect_training() {
    const N_STEPS: u64 = 120;
    let gpu = test_gpu();
    let valid_keyframes = keyframes(&gpu, true);
    let with_depth = |of: fn(usize, f32) -> f32| {
        let corrupted = valid_keyframes[1].as_ref().clone();
        let depth = corrupted.depth.clone().unwrap();
        let depth_m = depth
            .depth_m
            .iter()
            .enumerate()
            .map(|(ix, z)| of(ix, *z))
            .collect();
        Keyframe {
            depth: Some(DepthMap { depth_m, ..depth }),
            ..corrupted
        }
    };
    let plain = valid_keyframes[1].as_ref().clone();
    let one_pixel = |depth: Option<DepthMap>| Keyframe {
        size_px: [1, 1],
        principal_px: [0.5; 2],
        rgba_srgb: [200, 100, 50, 255].into(),
        depth,
        ..plain.clone()
    };
    let corrupted = [
        with_depth(|ix, z| if ix % 2 == 0 { f32::NAN } else { z }),
        with_depth(|_, _| f32::INFINITY),
        with_depth(|ix, z| if ix % 3 == 0 { -z } else { f32::MAX }),
        one_pixel(None),
        one_pixel(plain.depth.clone()),
        Keyframe {
            focal_px: [f64::NAN; 2],
            ..plain.clone()
        },
        Keyframe {
            world_from_camera: Transform::translation(f64::NAN, 0.0, 0.0),
            ..plain.clone()
        },
        Keyframe {
            world_from_camera: Transform::translation(f64::INFINITY, 0.0, 0.0),
            ..plain.clone()
        },
        Keyframe {
            twist: Some(Twist {
                linear_m_s: Vector3::repeat(f64::NAN),
                angular_rad_s: Vector3::zeros(),
            }),
            readout_secs: 0.015,
            ..plain.clone()
        },
    ];
    let learned = |corrupted: &[Keyframe]| {
        let mut trainer = SplatTrainer::new(gpu.clone(), options()).unwrap();
        for keyframe in &valid_keyframes {
            trainer.push(keyframe.clone()).unwrap();
        }
        for (keyframe, stamp) in corrupted.iter().zip(900..) {
            trainer
                .push(Arc::new(Keyframe {
                    stamp: Stamp(stamp),
                    ..keyframe.clone()
                }))
                .unwrap();
        }
        train(&mut trainer, N_STEPS);
        assert!(trainer.arrays().unwrap().checked().is_ok());
        test_psnr(&mut trainer, &valid_keyframes)
    };
    let (without, with) = (learned(&[]), learned(&corrupted));
    assert!(
        with > without - 1.5,
        "{with:.2} dB with corrupted keyframes, {without:.2} dB without"
    );
}

/// Extreme splats that a file may contain: on the camera plane, with a zero quaternion, huge, or
/// almost transparent.
#[test]
fn invalid_splats_stay_finite_in_training() {
    let gpu = test_gpu();
    let valid_keyframes = keyframes(&gpu, true);
    let mut arrays = synthetic_cloud(200, 5);
    let center = valid_keyframes[1].world_from_camera.translation.vector;
    let at = |z_m: f64| {
        let position = valid_keyframes[1].world_from_camera * Point3::new(0.0, 0.0, z_m);
        [position.x, position.y, position.z].map(f32_of)
    };
    arrays.means[0] = center.map(f32_of).into();
    (arrays.means[1], arrays.means[2], arrays.means[3]) = (at(0.0101), at(-1e-6), [f32::MAX; 3]);
    arrays.rotations_wxyz[4] = [0.0; 4];
    arrays.rotations_wxyz[5] = [f32::MAX; 4];
    arrays.log_scales[6] = [80.0; 3];
    arrays.log_scales[7] = [-80.0; 3];
    (arrays.opacity_logits[8], arrays.opacity_logits[9]) = (1e30, -1e30);
    arrays.sh[16 * 10] = [f32::MAX; 3];
    let mut trainer = SplatTrainer::from_arrays(gpu, options(), &arrays).unwrap();
    for keyframe in &valid_keyframes {
        trainer.push(keyframe.clone()).unwrap();
    }
    train(&mut trainer, 60);
    let learned = trainer.arrays().unwrap();
    let numbers = [
        learned.means.as_flattened(),
        learned.log_scales.as_flattened(),
        learned.rotations_wxyz.as_flattened(),
        learned.sh.as_flattened(),
        &learned.opacity_logits,
    ];
    assert!(
        numbers
            .into_iter()
            .flatten()
            .all(|number| number.is_finite())
    );
    assert!(
        learned.means[20..] != arrays.means[20..],
        "the other splats are trained"
    );
}
