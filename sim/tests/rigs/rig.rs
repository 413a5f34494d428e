//! Checks the simulated rig against known values: poses, pixels, depth, noise, limits,
//! repeatability.

#![expect(
    clippy::cast_possible_truncation,
    reason = "pixel positions inside an image become indices"
)]

use crate::common;
use crate::common::Run;
use drivers::{Image, Sample, Source};
use kinematics::chain::Chain;
use kinematics::{Intrinsics, JointState, Stamp, Transform};
use nalgebra::{Point3, Vector3};
use sim::{Config, DepthConfig, RigInfo};
use std::collections::BTreeMap;

fn run_rig(config: &Config) -> Run {
    let run = common::run_rig(config);
    let of_base = (
        run.reported_base.len(),
        run.true_base.len(),
        run.scans.len(),
    );
    assert_eq!(of_base, (0, 0, 0), "a static arm has neither");
    run
}

fn ideal(n_images: u64) -> Config {
    Config {
        ideal: true,
        truth_depth: true,
        n_images: Some(n_images),
        ..Config::default()
    }
}

fn chain(info: &RigInfo) -> Chain {
    Chain::from_urdf(&info.urdf, "panda_link0", "panda_link8").expect("the URDF is valid")
}

/// Joint positions at a stamp, interpolated linearly between neighboring readings.
fn joints_at(joints: &[JointState], stamp: Stamp) -> Vec<f64> {
    let after = joints.partition_point(|state| state.stamp < stamp).max(1);
    let (a, b) = (&joints[after - 1], &joints[after]);
    let share = (stamp.0 - a.stamp.0) as f64 / (b.stamp.0 - a.stamp.0) as f64;
    a.position
        .iter()
        .zip(&b.position)
        .map(|(a, b)| a + share * (b - a))
        .collect()
}

fn gray(image: &Image, column: usize, row: usize) -> f64 {
    let at = 3 * (row * image.size_px[0] as usize + column);
    image.data[at..at + 3]
        .iter()
        .map(|byte| f64::from(*byte))
        .sum::<f64>()
        / 3.0
}

/// Bilinear gray value at a position.
fn gray_at(image: &Image, [u, v]: [f64; 2]) -> f64 {
    let (x, y) = (u - 0.5, v - 0.5);
    let (column, row) = (x.floor() as usize, y.floor() as usize);
    let (fx, fy) = (x.fract(), y.fract());
    (gray(image, column, row) * (1.0 - fx) + gray(image, column + 1, row) * fx) * (1.0 - fy)
        + (gray(image, column, row + 1) * (1.0 - fx) + gray(image, column + 1, row + 1) * fx) * fy
}

/// A point on the table, relative to the center of the target area.
fn on_table(x_m: f64, y_m: f64) -> Point3<f64> {
    let [target_x, target_y] = sim::layout::TARGET_XY_M;
    Point3::new(target_x + x_m, target_y + y_m, sim::layout::TABLE_Z_M)
}

/// The center of the target area, at half the height of its objects.
fn target() -> Point3<f64> {
    on_table(0.0, 0.0) + Vector3::z() * 0.06
}

/// Position on the tag cube's upper side: `right` and `down` from the tag's top left, 0 to 1. This
/// side has the tag with id 4.
fn on_tag(right: f64, down: f64) -> Point3<f64> {
    let side = 2.0 * sim::layout::CUBE_HALF_M;
    let in_cube = Point3::new((0.5 - down) * side, (0.5 - right) * side, 0.5 * side);
    sim::layout::world_from_cube() * in_cube
}

fn pixel(intrinsics: &Intrinsics, world_from_camera: &Transform, point: &Point3<f64>) -> [f64; 2] {
    intrinsics
        .project(&(world_from_camera.inverse() * point).coords)
        .expect("in front of the camera")
}

#[test]
fn forward_kinematics_matches_true_camera_pose() {
    const TOLERANCE_M: f64 = 2e-6; // Linear interpolation of readings 1 ms apart; the motion accelerates by up to 10 rad/s^2.
    let run = run_rig(&Config {
        n_images: Some(40),
        truth: true,
        ..Config::default()
    });
    let camera = &run.info.cameras[0];
    let mut worst_m: f64 = 0.0;
    for truth in &run.truth {
        let base_from_flange = chain(&run.info)
            .forward(&joints_at(&run.joints, truth.image.stamp))
            .expect("seven joints");
        let error =
            (base_from_flange * camera.parent_from_camera).inverse() * truth.world_from_camera;
        worst_m = worst_m
            .max(error.translation.vector.norm())
            .max(error.rotation.angle() * 0.3);
    }
    assert_eq!(run.truth.len(), 40);
    assert!(worst_m < TOLERANCE_M, "{worst_m} m");
}

#[test]
fn scan_stays_within_limits_and_covers_the_target() {
    let run = run_rig(&Config {
        ideal: true,
        truth: true,
        n_images: Some(30),
        ..slow_camera()
    });
    let chain = chain(&run.info);
    for state in &run.joints {
        for (ix, limits) in chain.limits().iter().enumerate() {
            let (position, speed) = (state.position[ix], state.velocity[ix].abs());
            assert!(
                position > limits.lower && position < limits.upper,
                "joint {ix} at {position} rad"
            );
            assert!(speed < limits.velocity, "joint {ix} at {speed} rad/s");
        }
    }
    for (ix, (max_acceleration, jerk)) in MAX_ACCELERATION_RAD_S2
        .into_iter()
        .zip(MAX_JERK_RAD_S3)
        .enumerate()
    {
        let speeds: Vec<f64> = run.joints.iter().map(|state| state.velocity[ix]).collect();
        for speeds in speeds.windows(3) {
            let [first, second] =
                [speeds[1] - speeds[0], speeds[2] - speeds[1]].map(|change| change * 1e3);
            assert!(
                first.abs() < max_acceleration,
                "joint {ix}: {first} rad/s^2"
            );
            assert!(
                (second - first).abs() * 1e3 < jerk,
                "joint {ix}: {} rad/s^3",
                (second - first) * 1e3
            );
        }
    }
    let [mut azimuths, mut elevations, mut distances] = [vec![], vec![], vec![]];
    for truth in &run.truth {
        let from_target = truth.world_from_camera.translation.vector - target().coords;
        azimuths.push((-from_target.y).atan2(-from_target.x).to_degrees());
        elevations.push((from_target.z / from_target.norm()).asin().to_degrees());
        distances.push(from_target.norm());
        // The target stays in view.
        let target_px = pixel(
            &run.info.cameras[0].intrinsics,
            &truth.world_from_camera,
            &target(),
        );
        assert!(
            run.info.cameras[0].intrinsics.contains(target_px),
            "{target_px:?}"
        );
    }
    let span = |values: &[f64]| {
        values.iter().fold(f64::MIN, |a, b| a.max(*b))
            - values.iter().fold(f64::MAX, |a, b| a.min(*b))
    };
    assert!(span(&azimuths) > 75.0, "azimuth {}", span(&azimuths));
    assert!(span(&elevations) > 30.0, "elevation {}", span(&elevations));
    assert!(span(&distances) > 0.12, "distance {}", span(&distances));
}

/// Franka's acceleration and jerk limits.
const MAX_ACCELERATION_RAD_S2: [f64; 7] = [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0];
const MAX_JERK_RAD_S3: [f64; 7] = [7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10_000.0, 10_000.0];

/// One small image per second, for tests of the motion only.
fn slow_camera() -> Config {
    let mut config = Config::default();
    config.cameras[0].rate_hz = 1.0;
    config.cameras[0].intrinsics = config.cameras[0].intrinsics.resized([160, 120]);
    config.cameras[0].depth = None;
    config
}

#[test]
fn runs_are_deterministic_per_seed() {
    let config = Config {
        n_images: Some(4),
        truth_depth: true,
        ..Config::default()
    };
    let (first, again) = (run_rig(&config), run_rig(&config));
    assert_eq!(first.color, again.color);
    assert_eq!(first.depth, again.depth);
    assert_eq!(first.truth, again.truth);
    assert_eq!(first.joints, again.joints);
    let other = run_rig(&Config { seed: 2, ..config });
    assert_ne!(first.color[0].data, other.color[0].data);
    assert_eq!(first.truth[0].image.data, other.truth[0].image.data);
}

#[test]
fn tag_on_cube_is_at_its_pose_with_id_4() {
    let run = run_rig(&ideal(12));
    let intrinsics = &run.info.cameras[0].intrinsics;
    let n_cells = sim::tag::N_CELLS as f64;
    let truth = run.truth.last().expect("at least one image");
    for (row, cells) in sim::tag::cells(4).iter().enumerate() {
        for (column, white) in cells.iter().enumerate() {
            let center = on_tag(
                (column as f64 + 0.5) / n_cells,
                (row as f64 + 0.5) / n_cells,
            );
            let gray = gray_at(
                &truth.image,
                pixel(intrinsics, &truth.world_from_camera, &center),
            );
            assert_eq!(
                gray > 100.0,
                *white,
                "cell {row}, {column} has brightness {gray}"
            );
        }
    }
}

#[test]
fn tag_edges_are_accurate_to_a_fifth_of_a_pixel() {
    const TOLERANCE_PX: f64 = 0.2;
    let mut config = ideal(3);
    config.cameras[0].sensor.supersample = 4; // Without supersampling, edges are aliased.
    let run = run_rig(&config);
    let intrinsics = &run.info.cameras[0].intrinsics;
    let truth = run.truth.last().expect("at least one image");
    // Each line crosses one of the four outer edges of the black border. At the edge, the
    // brightness is half of the way from black to white.
    let edges = [
        ([0.5, 0.05], [0.5, 0.15]),
        ([0.5, 0.95], [0.5, 0.85]),
        ([0.05, 0.5], [0.15, 0.5]),
        ([0.95, 0.5], [0.85, 0.5]),
    ];
    for (white, black) in edges {
        let at = |share: f64| {
            let point = on_tag(
                white[0] + share * (black[0] - white[0]),
                white[1] + share * (black[1] - white[1]),
            );
            pixel(intrinsics, &truth.world_from_camera, &point)
        };
        let brightness: Vec<f64> = (0..=400)
            .map(|ix| gray_at(&truth.image, at(f64::from(ix) / 400.0)))
            .collect();
        let half = 0.5 * (brightness[0] + brightness[400]);
        let found = brightness
            .iter()
            .position(|value| *value < half)
            .expect("black follows white") as f64
            / 400.0;
        let (expected, got) = (at(0.5), at(found));
        let error_px = (expected[0] - got[0]).hypot(expected[1] - got[1]);
        assert!(error_px < TOLERANCE_PX, "{error_px} px at {expected:?}");
    }
}

#[test]
fn depth_matches_table_and_cube() {
    const TOLERANCE_M: f64 = 1e-4; // One count; rounding errors are at most half of this.
    let run = run_rig(&ideal(5));
    let intrinsics = &run.info.cameras[0].intrinsics;
    let truth = run.truth.last().expect("at least one image");
    let depth = run.depth.last().expect("at least one depth image");
    assert_eq!(depth.stamp, truth.image.stamp);
    let camera_from_world = truth.world_from_camera.inverse();
    let corners = [
        on_table(-0.10, -0.16),
        on_table(-0.14, 0.0),
        on_tag(0.3, 0.6),
        on_tag(0.7, 0.2),
    ];
    for point in corners {
        let in_camera = camera_from_world * point;
        let [u, v] = intrinsics.project(&in_camera.coords).expect("in front");
        let ix = v as usize * intrinsics.size_px[0] as usize + u as usize;
        // The depth of the plane z = point.z along the ray through the pixel's center.
        let ray = intrinsics
            .unproject([u.floor() + 0.5, v.floor() + 0.5])
            .expect("a pinhole");
        let up_in_camera = camera_from_world.rotation * Vector3::z();
        let expected = up_in_camera.dot(&in_camera.coords) / up_in_camera.dot(&ray);
        let (exact, counted) = (f64::from(truth.depth_m[ix]), counts(depth)[ix] * 1e-4);
        assert!(
            (exact - expected).abs() < TOLERANCE_M,
            "{exact} m instead of {expected} m"
        );
        assert!(
            (counted - expected).abs() < TOLERANCE_M,
            "{counted} m instead of {expected} m"
        );
    }
}

fn counts(depth: &Image) -> Vec<f64> {
    depth
        .data
        .chunks_exact(2)
        .map(|count| f64::from(u16::from_le_bytes([count[0], count[1]])))
        .collect()
}

#[test]
fn noise_matches_configuration() {
    let run = run_rig(&Config {
        truth_depth: true,
        n_images: Some(6),
        ..Config::default()
    });
    for truth in &run.truth {
        let ceiling = truth.psnr_ceiling.expect("there is noise");
        assert!(ceiling > 40.0 && ceiling < 44.0, "{ceiling} dB");
    }
    let DepthConfig {
        noise_sigma_m,
        hole_frac,
        ..
    } = DepthConfig::default();
    let (mut squares, mut n_valid, mut n_holes) = (0.0, 0.0, 0.0);
    for (depth, truth) in run.depth.iter().zip(&run.truth) {
        for (count, exact) in counts(depth)
            .into_iter()
            .zip(truth.depth_m.iter().map(|depth| f64::from(*depth)))
        {
            if count > 0.0 {
                squares += ((count * 1e-4 - exact) / (exact * exact)).powi(2);
                n_valid += 1.0;
            } else {
                n_holes += 1.0;
            }
        }
    }
    let (sigma, holes) = (f64::sqrt(squares / n_valid), n_holes / (n_valid + n_holes));
    assert!(
        (sigma / noise_sigma_m - 1.0).abs() < 0.05,
        "depth sigma {sigma} m at 1 m"
    );
    assert!((holes - hole_frac).abs() < 0.006, "holes {holes}");
}

#[test]
fn rolling_shutter_uses_the_pose_of_each_row() {
    const TOLERANCE_PX: f64 = 0.3;
    const READOUT_SECS: f64 = 0.04; // Slower than a real sensor, so that the effect is larger.
    let mut config = Config {
        n_images: Some(16),
        ..Config::default()
    };
    config.cameras[0].rate_hz = 1.3;
    config.cameras[0].depth = None;
    config.cameras[0].sensor = sim::SensorConfig {
        noise_sigma: 0.0,
        supersample: 2,
        readout_micros: 1e6 * READOUT_SECS,
        ..config.cameras[0].sensor
    };
    let run = run_rig(&config);
    let (intrinsics, chain) = (&run.info.cameras[0].intrinsics, chain(&run.info));
    let mut largest_px: f64 = 0.0;
    for (image, truth) in run.color.iter().zip(&run.truth).skip(1) {
        // The middle of the lower edge of the black border, located along the tag's center line.
        let line: Vec<Point3<f64>> = (0..=200)
            .map(|ix| on_tag(0.5, 0.85 + 0.1 * f64::from(ix) / 200.0))
            .collect();
        let static_pixel = |point: &Point3<f64>| pixel(intrinsics, &truth.world_from_camera, point);
        let rolling_pixel = |point: &Point3<f64>| {
            let mut at_px = static_pixel(point);
            for _ in 0..3 {
                let share = at_px[1] / f64::from(intrinsics.size_px[1]) - 0.5;
                let stamp = truth.image.stamp.plus_secs(READOUT_SECS * share);
                let flange = chain
                    .forward(&joints_at(&run.joints, stamp))
                    .expect("seven joints");
                at_px = pixel(
                    intrinsics,
                    &(flange * run.info.cameras[0].parent_from_camera),
                    point,
                );
            }
            at_px
        };
        if !line.iter().all(|point| {
            static_pixel(point)
                .iter()
                .all(|value| *value > 40.0 && *value < 440.0)
        }) {
            continue;
        }
        let edge = |image: &Image, at: &dyn Fn(&Point3<f64>) -> [f64; 2]| {
            let brightness: Vec<f64> = line.iter().map(|point| gray_at(image, at(point))).collect();
            let half = 0.5 * (brightness[0] + brightness[200]);
            at(&line[brightness
                .iter()
                .position(|value| *value > half)
                .expect("white follows black")])
        };
        let (expected, got) = (rolling_pixel(&line[100]), edge(image, &rolling_pixel));
        let error_px = (expected[0] - got[0]).hypot(expected[1] - got[1]);
        assert!(error_px < TOLERANCE_PX, "{error_px} px at {expected:?}");
        largest_px = largest_px.max(
            (static_pixel(&line[100])[0] - expected[0])
                .hypot(static_pixel(&line[100])[1] - expected[1]),
        );
    }
    assert!(
        largest_px > 3.0 * TOLERANCE_PX,
        "the shear was only {largest_px} px, too small for this test"
    );
}

#[test]
fn mean_image_scores_low() {
    let mut config = Config {
        n_images: Some(32),
        truth: false,
        ideal: true,
        ..Config::default()
    };
    config.cameras[0].rate_hz = 2.0;
    config.cameras[0].depth = None;
    let images = run_rig(&config).color;
    let is_test = |ix: usize| ix.is_multiple_of(8);
    let n_train = images
        .iter()
        .enumerate()
        .filter(|(ix, _)| !is_test(*ix))
        .count() as f64;
    let mut mean = vec![0.0; images[0].data.len()];
    for (_, image) in images.iter().enumerate().filter(|(ix, _)| !is_test(*ix)) {
        mean.iter_mut()
            .zip(image.data.iter())
            .for_each(|(mean, byte)| *mean += f64::from(*byte) / n_train);
    }
    let psnr: Vec<f64> = images
        .iter()
        .enumerate()
        .filter(|(ix, _)| is_test(*ix))
        .map(|(_, image)| {
            let squares: f64 = mean
                .iter()
                .zip(image.data.iter())
                .map(|(mean, byte)| (mean - f64::from(*byte)).powi(2))
                .sum();
            10.0 * (255.0 * 255.0 * mean.len() as f64 / squares).log10()
        })
        .collect();
    let mean_psnr = psnr.iter().sum::<f64>() / psnr.len() as f64;
    assert!(mean_psnr < 15.0, "{mean_psnr} dB");
}

#[test]
fn dropped_images_are_counted_and_samples_are_ordered() {
    let mut config = Config {
        truth: false,
        n_images: Some(20),
        ..slow_camera()
    };
    config.cameras[0].rate_hz = 30.0;
    config.cameras[0].sensor.dropped_frac = 0.3;
    let mut rig = sim::open(&config).expect("the rig opens").into_lockstep();
    let (mut newest_joints, mut n_dropped, mut images) = (Stamp(0), 0, BTreeMap::new());
    while let Some(sample) = rig.next_sample().expect("the rig runs") {
        match sample {
            Sample::Joints(state) => newest_joints = state.stamp,
            Sample::Image(image) => {
                let age = newest_joints.nanos_since(image.stamp);
                // The delay consists of half the readout and exposure, one step, 20 ms of latency,
                // and up to one more step.
                assert!((29_000_000..=30_100_000).contains(&age), "{age} ns");
                n_dropped += image.n_skipped;
                images.insert(image.stamp, image.n_skipped);
            }
            _ => {}
        }
    }
    assert_eq!(images.len(), 20);
    let span = images
        .keys()
        .last()
        .expect("images")
        .secs_since(*images.keys().next().expect("images"));
    let n_periods = (span * 30.0).round() as u64;
    let before_first = images.values().next().expect("images");
    assert_eq!(n_periods + 1, 20 + n_dropped - before_first);
    assert!(n_dropped > 2, "{n_dropped} dropped");
}
