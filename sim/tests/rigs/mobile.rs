//! Checks the rigs with a moving base against known values: base poses, scans of the walls, depth
//! of a separate sensor.

#![expect(
    clippy::cast_possible_truncation,
    reason = "pixel positions inside an image become indices"
)]

use crate::common::run_rig;
use drivers::Image;
use kinematics::{Intrinsics, Transform};
use nalgebra::{Isometry3, Point3, Vector3};
use sim::layout::{ROOM_HALF_M, ROOM_HEIGHT_M};
use sim::{CameraConfig, Config, Parent, ScannerConfig, Scene};

/// A small forward camera and a scanner.
fn mobile_base(rate_hz: f64) -> Config {
    let mut camera = CameraConfig::wrist("front");
    camera.intrinsics = camera.intrinsics.resized([320, 180]);
    camera.intrinsics.focal_px = [160.3, 160.1];
    camera.parent = Parent::Base;
    let eye = Point3::new(0.46, 0.0, 0.06);
    camera.parent_from_camera =
        Isometry3::face_towards(&eye, &(eye + Vector3::x()), &-Vector3::z());
    camera.depth = None;
    camera.rate_hz = rate_hz;
    Config {
        scene: Scene::MobileBase,
        joint_names: vec![],
        reading_order: vec![],
        cameras: vec![camera],
        scanners: vec![ScannerConfig {
            n_columns: 180,
            dropped_frac: 0.1,
            ..ScannerConfig::sixteen_rings("lidar")
        }],
        ..Config::default()
    }
}

/// A small wrist camera whose depth has its own lens and pose.
fn mobile_arm(rate_hz: f64) -> Config {
    let mut config = Config {
        scene: Scene::MobileArm,
        truth_depth: true,
        light_inside_frac: 0.6,
        ..Config::default()
    };
    config.cameras = vec![CameraConfig::mobile_wrist("wrist")];
    let camera = &mut config.cameras[0];
    camera.intrinsics = camera.intrinsics.resized([320, 180]);
    camera.rate_hz = rate_hz;
    let sensor = camera
        .depth
        .as_mut()
        .and_then(|depth| depth.sensor.as_mut())
        .expect("a separate depth sensor");
    sensor.intrinsics = sensor.intrinsics.resized([160, 120]);
    config
}

fn lens_of(config: &Config) -> Intrinsics {
    config.cameras[0].intrinsics.clone()
}

#[test]
fn scans_hit_the_walls_within_their_noise() {
    let config = Config {
        duration_secs: Some(2.0),
        ..mobile_base(1.0)
    };
    let noise_m = config.scanners[0].noise_sigma_m;
    let run = run_rig(&config);
    assert!(run.scans.len() >= 18, "{} scans", run.scans.len());
    let world_from_base = |nanos: i64| {
        let after = run
            .true_base
            .partition_point(|pose| pose.stamp.0 < nanos)
            .clamp(1, run.true_base.len() - 1);
        let (a, b) = (&run.true_base[after - 1], &run.true_base[after]);
        let share = (nanos - a.stamp.0) as f64 / (b.stamp.0 - a.stamp.0) as f64;
        kinematics::transform::interpolate(&a.world_from_base, &b.world_from_base, share)
    };
    let (mut squares, mut n_wall, mut n_points) = (0.0, 0.0, 0.0);
    for scan in &run.scans {
        for point in scan.points.iter() {
            let pose = world_from_base(scan.stamp.0 + i64::from(point.offset_micros) * 1000);
            let world_from_scanner: Transform = pose * config.scanners[0].base_from_scanner;
            let at = world_from_scanner * Point3::from(point.position_m).cast::<f64>();
            n_points += 1.0;
            let past_wall_m = [at.x.abs() - ROOM_HALF_M[0], at.y.abs() - ROOM_HALF_M[1]];
            assert!(
                past_wall_m[0] < 0.15
                    && past_wall_m[1] < 0.15
                    && at.z > -0.15
                    && at.z < ROOM_HEIGHT_M + 0.15,
                "{at}"
            );
            // At this height, above the furniture and below the lamps, there are only walls.
            if at.z > 2.15 && at.z < 2.6 {
                let ray = (at.coords - world_from_scanner.translation.vector).normalize();
                // The difference is the range error. The ray hits the wall at an angle.
                let (axis, off) = if past_wall_m[0] > past_wall_m[1] {
                    (0, past_wall_m[0])
                } else {
                    (1, past_wall_m[1])
                };
                squares += (off / ray[axis].abs()).powi(2);
                n_wall += 1.0;
            }
        }
    }
    let expected = run.scans.len() as f64 * 16.0 * 180.0 * (1.0 - config.scanners[0].dropped_frac);
    assert!(
        (n_points / expected - 1.0).abs() < 0.02,
        "{n_points} echoes of {expected}"
    );
    let sigma = f64::sqrt(squares / n_wall);
    assert!(
        n_wall > 300.0 && (sigma / noise_m - 1.0).abs() < 0.1,
        "{sigma} m on {n_wall} points"
    );
}

#[test]
fn reported_poses_drift_and_ground_truth_is_exact() {
    let config = Config {
        duration_secs: Some(12.0),
        ..mobile_base(0.5)
    };
    let run = run_rig(&config);
    assert_eq!(run.reported_base.len(), run.true_base.len());
    let distance_m = |ix: usize| {
        let (reported_base, truth) = (&run.reported_base[ix], &run.true_base[ix]);
        assert_eq!(reported_base.stamp, truth.stamp);
        (reported_base.world_from_base.translation.vector
            - truth.world_from_base.translation.vector)
            .norm()
    };
    assert!(
        distance_m(0) == 0.0
            && distance_m(run.reported_base.len() - 1) > 1e-4
            && distance_m(run.reported_base.len() - 1) < 0.1
    );
    for truth in &run.truth {
        // Base poses are 10 ms apart; the tolerance covers linear interpolation at the stamps of
        // the images.
        let ix = run
            .true_base
            .partition_point(|pose| pose.stamp < truth.image.stamp)
            .clamp(1, run.true_base.len() - 1);
        let (a, b) = (&run.true_base[ix - 1], &run.true_base[ix]);
        let share = truth.image.stamp.secs_since(a.stamp) / b.stamp.secs_since(a.stamp);
        let base =
            kinematics::transform::interpolate(&a.world_from_base, &b.world_from_base, share);
        let difference =
            (base * config.cameras[0].parent_from_camera).inverse() * truth.world_from_camera;
        assert!(
            difference.translation.vector.norm() < 5e-5 && difference.rotation.angle() < 5e-5,
            "{difference}"
        );
    }
    let ideal = run_rig(&Config {
        ideal: true,
        ..config
    });
    assert!(
        ideal
            .reported_base
            .iter()
            .zip(&ideal.true_base)
            .all(|(reported_base, truth)| reported_base == truth)
    );
}

#[test]
fn runs_are_deterministic_per_seed() {
    for config in [mobile_base(2.0), mobile_arm(2.0)] {
        let config = Config {
            n_images: Some(3),
            ..config
        };
        let first = run_rig(&config);
        assert!(first == run_rig(&config));
        let other = run_rig(&Config {
            seed: 2,
            ..config.clone()
        });
        assert!(first.color != other.color && first.true_base == other.true_base);
        assert!(config.scanners.is_empty() || first.scans != other.scans);
    }
}

#[test]
fn separate_depth_sensor_matches_color_camera() {
    const TOLERANCE_FRAC: f64 = 0.01; // A pixel on a slanted surface; a wrong frame or lens causes ten times this.
    let config = Config {
        ideal: true,
        n_images: Some(4),
        ..mobile_arm(1.0)
    };
    let run = run_rig(&config);
    let color = lens_of(&config);
    let sensor = config.cameras[0]
        .depth
        .clone()
        .and_then(|depth| depth.sensor)
        .expect("a separate sensor");
    let (mut n_matching, mut n_valid) = (0, 0);
    for (image, truth) in run.depth.iter().zip(&run.truth) {
        assert_eq!(image.size_px, [160, 120]);
        for (ix, count) in image.data.chunks_exact(2).enumerate() {
            let z = f64::from(u16::from_le_bytes([count[0], count[1]])) * 0.00025;
            let pixel = [(ix % 160) as f64 + 0.5, (ix / 160) as f64 + 0.5];
            let in_depth = sensor.intrinsics.unproject(pixel).expect("a pinhole") * z;
            let in_color = sensor.camera_from_depth * Point3::from(in_depth);
            let Some([u, v]) = color
                .project(&in_color.coords)
                .filter(|at| z > 0.0 && color.contains(*at))
            else {
                continue;
            };
            let depth_m = f64::from(truth.depth_m[v as usize * 320 + u as usize]);
            n_valid += 1;
            n_matching += usize::from((depth_m / in_color.z - 1.0).abs() < TOLERANCE_FRAC);
        }
    }
    // The other pixels are at depth edges, which look different from the two sensors.
    assert!(
        n_valid > 20_000 && n_matching as f64 > 0.93 * f64::from(n_valid),
        "{n_matching} of {n_valid}"
    );
}

#[test]
fn mean_image_scores_low_and_noise_ceiling_is_high() {
    let mut reported_base = Vec::new();
    for config in [mobile_base(0.5), mobile_arm(0.5)] {
        let name = config.scene.name();
        let run = run_rig(&Config {
            n_images: Some(32),
            scanners: vec![],
            ..config
        });
        for truth in &run.truth {
            let ceiling = truth.psnr_ceiling.expect("there is noise");
            assert!(ceiling > 40.0 && ceiling < 45.5, "{name}: {ceiling} dB");
        }
        let is_test = |ix: usize| ix.is_multiple_of(8);
        let train: Vec<&Image> = run
            .color
            .iter()
            .enumerate()
            .filter(|(ix, _)| !is_test(*ix))
            .map(|(_, at)| at)
            .collect();
        let mean: Vec<f64> = (0..train[0].data.len())
            .map(|at| {
                train
                    .iter()
                    .map(|image| f64::from(image.data[at]))
                    .sum::<f64>()
                    / train.len() as f64
            })
            .collect();
        let psnr = |image: &Image| {
            let squares: f64 = mean
                .iter()
                .zip(image.data.iter())
                .map(|(a, b)| (a - f64::from(*b)).powi(2))
                .sum();
            10.0 * (255.0 * 255.0 * mean.len() as f64 / squares).log10()
        };
        let tests: Vec<f64> = run.color.iter().step_by(8).map(psnr).collect();
        let mean_psnr = tests.iter().sum::<f64>() / tests.len() as f64;
        reported_base.push((name, mean_psnr));
    }
    assert!(
        reported_base.iter().all(|(_, mean_psnr)| *mean_psnr < 15.0),
        "the mean images score {reported_base:?} dB"
    );
}

#[test]
fn light_changes_when_camera_enters_cabinet() {
    let run_with_light = |light_inside_frac: f64| {
        let config = mobile_arm(0.25);
        // The run ends with the camera in the cabinet. It takes 19 s to reach the second station, 9
        // s outside, and 11 s on the way in.
        let config = Config {
            light_inside_frac,
            duration_secs: Some(40.0),
            truth_depth: false,
            ..config
        };
        run_rig(&config)
    };
    let (constant_light, dimmed) = (run_with_light(1.0), run_with_light(0.5));
    let brightness = |image: &Image| {
        image.data.iter().map(|byte| f64::from(*byte)).sum::<f64>() / image.data.len() as f64
    };
    let (mut n_same, mut n_darker) = (0, 0);
    for (constant_light, dimmed) in constant_light.truth.iter().zip(&dimmed.truth) {
        let depth_m = constant_light.world_from_camera.translation.vector.x - 2.05;
        let share = brightness(&dimmed.image) / brightness(&constant_light.image);
        if depth_m < -0.2 {
            assert!((share - 1.0).abs() < 1e-9, "{share} at {depth_m} m");
            n_same += 1;
        } else if share < 0.75 {
            n_darker += 1;
        }
    }
    assert!(
        n_same >= 4 && n_darker >= 1,
        "{n_same} outside, {n_darker} inside"
    );
}
