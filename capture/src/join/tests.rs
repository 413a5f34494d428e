//! Generated samples in, keyframes out: poses at the shutter time, every rejection, the bounds, and
//! bit-exact replay.

use super::{Counts, Join, JoinEvent, Rejection, SampleUse};
use crate::config::{Override, Rig};
use crate::open;
use drivers::{BasePose, Image, PixelFormat, Sample, TruthImage};
use keyframe::{Keyframe, KeyframeList, Split, list_text};
use kinematics::{Chain, JointState, Stamp, Transform, transform};
use std::f64::consts::TAU;
use std::path::Path;
use std::sync::Arc;
use toml::Value;

const SIZE_PX: [u32; 2] = [64, 48];
const CENTER_RAD: [f64; 7] = [0.1, -0.3, 0.2, -2.0, 0.1, 1.8, 0.6];

/// The rig of a static arm with a small 10 Hz camera.
fn rig(overrides: &[Override]) -> Rig {
    let size = |key| Override::new(key, Value::from(SIZE_PX.map(i64::from).to_vec()));
    let pair = |key, x, y| Override::new(key, Value::from(vec![x, y]));
    let mut all = vec![
        size("camera.wrist.size_px"),
        pair("camera.wrist.intrinsics.focal_px", 61.0, 61.5),
        pair("camera.wrist.intrinsics.principal_px", 32.0, 24.0),
        Override::new("camera.wrist.rate_hz", 10),
        Override::new("sim.truth", false),
    ];
    all.extend(overrides.iter().cloned());
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/static-arm.toml");
    Rig::load(&path, &all).expect("a bundled rig file")
}

fn joints_rad(secs: f64) -> Vec<f64> {
    CENTER_RAD
        .iter()
        .zip(1..)
        .map(|(center, joint)| center + 0.15 * (TAU * secs / 8.0 + f64::from(joint)).sin())
        .collect()
}

fn reading(nanos: i64) -> Sample {
    let secs = Stamp(nanos).secs();
    let speed = |joint: i32| 0.15 * TAU / 8.0 * (TAU * secs / 8.0 + f64::from(joint)).cos();
    Sample::Joints(JointState {
        stamp: Stamp(nanos),
        position: joints_rad(secs),
        velocity: (1..8).map(speed).collect(),
        effort: vec![],
    })
}

/// A checkerboard image, different for every stamp.
fn color(camera: &str, nanos: i64) -> Image {
    let offset = nanos / 7_000_003;
    let level = |x: i64, y: i64| {
        if ((x + offset) / 3 + (y + offset) / 4) % 2 == 0 {
            60
        } else {
            190
        }
    };
    let [width, height] = SIZE_PX.map(i64::from);
    let data: Vec<u8> = (0..height)
        .flat_map(|y| (0..width).flat_map(move |x| [level(x, y), 90, level(x, y)]))
        .collect();
    Image {
        camera: camera.into(),
        stamp: Stamp(nanos),
        size_px: SIZE_PX,
        format: PixelFormat::Rgb8,
        data: data.into(),
        exposure_secs: Some(1e-4),
        n_skipped: 0,
    }
}

/// Depth of 1 m, with one reading beyond the sensor's range and one hole.
fn depth(nanos: i64) -> Image {
    let mut data = 10_000_u16
        .to_le_bytes()
        .repeat((SIZE_PX[0] * SIZE_PX[1]) as usize);
    data[0..2].copy_from_slice(&65_000_u16.to_le_bytes());
    data[2..4].fill(0);
    Image {
        format: PixelFormat::DepthU16 {
            meters_per_count: 1e-4,
        },
        data: data.into(),
        ..color("wrist", nanos)
    }
}

fn truth(nanos: i64) -> Sample {
    let image = Image {
        data: vec![99; (SIZE_PX[0] * SIZE_PX[1] * 3) as usize].into(),
        ..color("wrist", nanos)
    };
    let world_from_camera = Transform::translation(0.0, 0.0, Stamp(nanos).secs());
    Sample::Truth(TruthImage {
        image,
        depth_m: Arc::from([]),
        world_from_camera,
        psnr_ceiling: Some(42.0),
    })
}

/// Joints at 200 Hz, color at 10 Hz with a different phase, and depth 5 ms after color. Each image
/// comes after the readings around it.
fn samples(secs: i64) -> Vec<Sample> {
    let mut samples = Vec::new();
    for tick in 0..secs * 200 {
        samples.push(reading(tick * 5_000_000));
        if tick % 20 == 10 {
            let nanos = tick * 5_000_000 - 23_456_789;
            samples.extend([
                Sample::Image(color("wrist", nanos)),
                truth(nanos),
                Sample::Image(depth(nanos + 5_000_000)),
            ]);
        }
    }
    samples
}

#[derive(Default)]
struct JoinOutcome {
    keyframes: Vec<Arc<Keyframe>>,
    rejected: Vec<Rejection>,
    evicted: Vec<i64>,
    n_posed: usize,
}

fn run_join(join: &mut Join, samples: impl IntoIterator<Item = Sample>) -> JoinOutcome {
    let mut outcome = JoinOutcome::default();
    let mut take = |events: Vec<JoinEvent>| {
        for event in events {
            match event {
                JoinEvent::Accepted(keyframe) => outcome.keyframes.push(keyframe),
                JoinEvent::Rejected { why } => outcome.rejected.push(why),
                JoinEvent::Evicted { stamp, .. } => outcome.evicted.push(stamp.0),
                JoinEvent::PosedImage(_) => outcome.n_posed += 1,
                JoinEvent::RangeScan(_) => {}
            }
        }
    };
    for sample in samples {
        take(join.push(sample));
    }
    take(join.finish());
    outcome
}

fn join(rig: &Rig) -> Join {
    Join::new(rig).expect("a good rig")
}

/// Differences between two lists of keyframes, exact to the last bit.
fn differences(a: &[Arc<Keyframe>], b: &[Arc<Keyframe>]) -> Vec<String> {
    let bits = |keyframe: &Keyframe| {
        let pose = |pose: &Transform| transform::to_xyz_xyzw(pose).map(f64::to_bits);
        let twist = keyframe.twist.map(|twist| {
            let numbers = twist.linear_m_s.iter().chain(twist.angular_rad_s.iter());
            numbers.map(|number| number.to_bits()).collect::<Vec<_>>()
        });
        let depth = keyframe.depth.as_ref().map(|depth| {
            let meters: Vec<u32> = depth
                .depth_m
                .iter()
                .map(|meters| meters.to_bits())
                .collect();
            (meters, pose(&depth.world_from_camera), depth.size_px)
        });
        let truth = keyframe
            .truth
            .as_ref()
            .map(|truth| (truth.rgba_srgb.to_vec(), pose(&truth.world_from_camera)));
        let image = (
            keyframe.camera.to_string(),
            keyframe.stamp,
            keyframe.size_px,
            keyframe.rgba_srgb.to_vec(),
        );
        (
            image,
            pose(&keyframe.world_from_camera),
            twist,
            depth,
            truth,
            keyframe.split,
        )
    };
    let mut differences: Vec<String> = a
        .iter()
        .zip(b)
        .enumerate()
        .filter(|(_, (a, b))| bits(a) != bits(b))
        .map(|(ix, (a, _))| format!("keyframe {ix} at {} ns", a.stamp.0))
        .collect();
    if a.len() != b.len() {
        differences.push(format!("{} and {} keyframes", a.len(), b.len()));
    }
    differences
}

#[test]
fn color_and_depth_poses_match_their_exposure_times() {
    const TOLERANCE: f64 = 1e-7; // Cubic interpolation of sines of 8 s between readings 5 ms apart.
    let rig = rig(&[]);
    let outcome = run_join(&mut join(&rig), samples(8));
    let chain = Chain::from_urdf(&rig.arm.urdf_text, &rig.arm.base_link, &rig.arm.flange_link)
        .expect("a Panda");
    let pose_at = |stamp: Stamp| {
        chain
            .forward(&joints_rad(stamp.secs()))
            .expect("seven joints")
            * rig.cameras[0].parent_from_camera
    };
    let distance =
        |a: &Transform, b: &Transform| (a.to_homogeneous() - b.to_homogeneous()).abs().max();
    assert!(
        outcome.keyframes.len() > 20,
        "{} keyframes",
        outcome.keyframes.len()
    );
    for keyframe in &outcome.keyframes {
        assert!(distance(&keyframe.world_from_camera, &pose_at(keyframe.stamp)) < TOLERANCE);
        let depth = keyframe
            .depth
            .as_ref()
            .expect("depth came with every image");
        assert!(
            distance(
                &depth.world_from_camera,
                &pose_at(keyframe.stamp.plus_secs(0.005))
            ) < TOLERANCE
        );
        assert!(
            distance(&depth.world_from_camera, &keyframe.world_from_camera) > 100.0 * TOLERANCE,
            "depth has its own pose"
        );
        assert_eq!(
            (depth.depth_m[0], depth.depth_m[1], depth.depth_m[2]),
            (0.0, 0.0, 1.0)
        );
        let (before, after) = (
            pose_at(keyframe.stamp.plus_secs(-1e-4)),
            pose_at(keyframe.stamp.plus_secs(1e-4)),
        );
        let twist = kinematics::transform::log(&(before.inverse() * after), 2e-4);
        let reported = keyframe.twist.expect("velocities are reported");
        assert!(
            (reported.linear_m_s - twist.linear_m_s).norm() < 1e-4
                && (reported.angular_rad_s - twist.angular_rad_s).norm() < 1e-4
        );
        assert_eq!(keyframe.readout_secs, 0.015);
    }
    let splits: Vec<Split> = outcome
        .keyframes
        .iter()
        .map(|keyframe| keyframe.split)
        .collect();
    assert_eq!(splits, (0..splits.len()).map(Split::of).collect::<Vec<_>>());
}

#[test]
fn configured_time_offset_changes_stamp_and_pose() {
    let offset = Value::Table(
        [("value".to_owned(), Value::from(-12.5))]
            .into_iter()
            .collect(),
    );
    let moved = rig(&[Override::new(
        "camera.wrist.stamp_to_mid_exposure_millis",
        offset,
    )]);
    let outcome = run_join(&mut join(&moved), samples(4));
    let first = &outcome.keyframes[0];
    assert_eq!(first.stamp.0, 50_000_000 - 23_456_789 - 12_500_000);
    let plain = run_join(&mut join(&rig(&[])), samples(4));
    assert_ne!(
        first.world_from_camera,
        plain.keyframes[0].world_from_camera
    );
}

#[test]
fn ground_truth_and_depth_are_matched_in_any_order() {
    let rig = rig(&[Override::new("sim.truth", true)]);
    let in_order = samples(6);
    let plain = run_join(&mut join(&rig), in_order.clone());
    assert!(plain.keyframes.iter().all(|keyframe| {
        let truth = keyframe
            .truth
            .as_ref()
            .expect("truth came with every image");
        truth.rgba_srgb[0] == 99
            && truth.world_from_camera.translation.z == keyframe.stamp.secs()
            && truth.psnr_ceiling == Some(42.0)
    }));
    // In one order, depth comes before color, with ground truth between or before them. In the
    // other, all images come 0.3 s before their readings.
    let is_color = |sample: &Sample| matches!(sample, Sample::Image(image) if !image.is_depth());
    let mut shuffled = in_order.clone();
    let colors: Vec<usize> = (0..shuffled.len())
        .filter(|ix| is_color(&shuffled[*ix]))
        .collect();
    colors.iter().for_each(|ix| shuffled.swap(*ix, ix + 2));
    let mut early = in_order;
    early.sort_by_key(|sample| {
        sample.stamp().0
            - if matches!(sample, Sample::Joints(_)) {
                0
            } else {
                300_000_000
            }
    });
    for other in [shuffled, early] {
        assert_eq!(
            differences(
                &plain.keyframes,
                &run_join(&mut join(&rig), other).keyframes
            ),
            Vec::<String>::new()
        );
    }
}

#[test]
fn replay_reproduces_keyframes_bit_for_bit() {
    let rig = rig(&[
        Override::new("camera.wrist.intrinsics.lens", "brown_conrady"),
        Override::new(
            "camera.wrist.intrinsics.distortion",
            Value::from(vec![0.1, -0.05, 0.001, 0.002, 0.0]),
        ),
    ]);
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let mut recorder =
        open::recorder(&path, &rig, &open::meshes_to_record(&rig)).expect("a new file");
    let live = run_join(
        &mut join(&rig),
        samples(6)
            .into_iter()
            .inspect(|sample| recorder.write(sample).expect("disk space")),
    );
    recorder.finish().expect("disk space");
    for _ in 0..2 {
        let opened = open::recording(&path, None, &[]).expect("a recording");
        let mut source = opened.source;
        let replayed = std::iter::from_fn(|| source.next_sample().expect("readable"));
        let replay = run_join(&mut join(&opened.rig), replayed);
        assert_eq!(
            differences(&live.keyframes, &replay.keyframes),
            Vec::<String>::new()
        );
        assert_eq!(live.rejected, replay.rejected);
    }
    assert!(
        live.keyframes
            .iter()
            .any(|keyframe| keyframe.rgba_srgb.chunks(4).any(|pixel| pixel[3] == 0)),
        "undistorted"
    );
    // The comparison detects a single changed bit.
    let mut changed = (*live.keyframes[3]).clone();
    changed.world_from_camera.translation.x =
        f64::from_bits(changed.world_from_camera.translation.x.to_bits() ^ 1);
    let mut other = live.keyframes.clone();
    other[3] = Arc::new(changed);
    assert_eq!(differences(&live.keyframes, &other).len(), 1);
}

#[test]
fn images_that_devices_dropped_are_counted_by_kind() {
    let mut join = join(&rig(&[]));
    for (image, n_skipped) in [(color("wrist", 0), 3), (depth(5_000_000), 4)] {
        join.push(Sample::Image(Image { n_skipped, ..image }));
    }
    let Counts {
        images,
        device_skipped,
        color_skipped,
        ..
    } = *join.counts();
    assert_eq!((images, color_skipped, device_skipped), (1, 3, 7));
}

#[test]
fn images_without_joint_readings_are_dropped_and_counted() {
    let rig = rig(&[]);
    // There are no joint readings from 2 s to 4 s and after 6 s.
    let in_gap =
        |nanos: i64| (2_000_000_000..4_000_000_000).contains(&nanos) || nanos > 6_000_000_000;
    let kept = samples(8)
        .into_iter()
        .filter(|sample| !(matches!(sample, Sample::Joints(_)) && in_gap(sample.stamp().0)));
    let mut join = join(&rig);
    let outcome = run_join(&mut join, kept);
    assert_eq!(
        outcome
            .rejected
            .iter()
            .filter(|why| **why == Rejection::NoPose)
            .count(),
        40,
        "all images without readings"
    );
    assert!(
        outcome
            .keyframes
            .iter()
            .all(|keyframe| !in_gap(keyframe.stamp.0))
    );
    assert_eq!(join.counts().rejected[&Rejection::NoPose], 40);
    assert_eq!(join.counts().images, 80);
    assert_eq!(
        join.counts().accepted + join.counts().rejected.values().sum::<u64>(),
        80,
        "every image is accounted for"
    );
    assert_eq!(outcome.n_posed, 40);
}

#[test]
fn restarted_source_gives_no_pose_across_the_jump() {
    let rig = rig(&[]);
    let mut repeated = join(&rig);
    let first = run_join(&mut repeated, samples(2));
    assert_eq!(first.n_posed, 20);
    repeated.restart();
    // The second round continues 5 ms after the first, and an image between them arrives late.
    let late = Sample::Image(color("wrist", 1_997_500_000));
    let round = samples(2).into_iter().map(|mut sample| {
        match &mut sample {
            Sample::Image(Image { stamp, .. })
            | Sample::Joints(JointState { stamp, .. })
            | Sample::Truth(TruthImage {
                image: Image { stamp, .. },
                ..
            }) => stamp.0 += 2_000_000_000,
            other => panic!("{other:?}"),
        }
        sample
    });
    let second = run_join(&mut repeated, [late].into_iter().chain(round));
    assert_eq!(second.n_posed, 20);
    assert_eq!(
        second
            .rejected
            .iter()
            .filter(|why| **why == Rejection::NoPose)
            .count(),
        1,
        "the late image"
    );
    assert_eq!(
        second
            .rejected
            .iter()
            .filter(|why| **why == Rejection::NotMoved)
            .count(),
        20,
        "the same poses again"
    );
}

#[test]
fn non_finite_readings_reject_nearby_images() {
    let rig = rig(&[]);
    let broken = samples(4).into_iter().map(|sample| match sample {
        Sample::Joints(mut state) if (1_000_000_000..2_000_000_000).contains(&state.stamp.0) => {
            state.position[3] = f64::NAN;
            Sample::Joints(state)
        }
        other => other,
    });
    let mut join = join(&rig);
    let outcome = run_join(&mut join, broken);
    assert_eq!(join.counts().joints_rejected, 200);
    assert!(
        join.counts().rejected[&Rejection::NoPose] >= 9,
        "{}",
        join.counts()
    );
    assert!(
        outcome
            .keyframes
            .iter()
            .all(|keyframe| kinematics::transform::is_finite(&keyframe.world_from_camera))
    );
    let mut short = Join::new(&rig).expect("a good rig");
    short.push(Sample::Joints(JointState {
        stamp: Stamp(1),
        position: vec![0.0; 3],
        velocity: vec![],
        effort: vec![],
    }));
    assert_eq!(short.counts().joints_rejected, 1);
}

/// Another program sends joint states of another arm to the same address, in between.
#[test]
fn joint_states_that_jump_are_ignored_and_counted_as_loss() {
    let rig = rig(&[]);
    let disturbed = samples(4).into_iter().flat_map(|sample| {
        let foreign = match &sample {
            Sample::Joints(state) if state.stamp.0 > 1_000_000_000 => {
                let position = state
                    .position
                    .iter()
                    .map(|position| position + 1.0)
                    .collect();
                Some(Sample::Joints(JointState {
                    stamp: Stamp(state.stamp.0 + 1_000_000),
                    position,
                    ..state.clone()
                }))
            }
            _ => None,
        };
        std::iter::once(sample).chain(foreign)
    });
    let (mut undisturbed_join, mut join) = (join(&rig), join(&rig));
    let undisturbed = run_join(&mut undisturbed_join, samples(4));
    let outcome = run_join(&mut join, disturbed);
    assert_eq!(
        differences(&undisturbed.keyframes, &outcome.keyframes),
        Vec::<String>::new()
    );
    assert_eq!(
        (join.counts().joints_too_fast, join.counts().joints_rejected),
        (599, 0)
    );
    let losses = join.counts().data_losses(SampleUse::ProcessedOnly);
    assert!(losses[0].contains("599 joint states ignored"), "{losses:?}");
    assert_eq!(undisturbed_join.counts().joints_too_fast, 0);
}

#[test]
fn a_wrong_first_joint_state_is_given_up_after_five_others() {
    let rig = rig(&[]);
    let mut wrong_first = samples(1);
    if let Some(Sample::Joints(state)) = wrong_first.first_mut() {
        state.position[0] += 2.0;
    }
    let mut join = join(&rig);
    run_join(&mut join, wrong_first);
    assert_eq!(
        (join.counts().joints_too_fast, join.counts().joints_rejected),
        (4, 0)
    );
}

#[test]
fn moving_base_carries_cameras_and_bad_pose_is_rejected() {
    let rig = rig(&[
        Override::new("base.driver", "udp"),
        Override::new("join.max_gap_millis", 150),
    ]);
    let base = |nanos: i64, x_m: f64| {
        let world_from_base = Transform::translation(x_m, 0.0, 0.0);
        Sample::Base(BasePose {
            stamp: Stamp(nanos),
            world_from_base,
        })
    };
    // One meter per second, reported at 10 Hz; one pose is NaN.
    let reported = (0..41_i64).map(|tick| {
        let secs = Stamp(tick * 100_000_000).secs();
        base(tick * 100_000_000, if tick == 20 { f64::NAN } else { secs })
    });
    let mut mixed: Vec<Sample> = samples(4).into_iter().chain(reported).collect();
    mixed.sort_by_key(Sample::stamp);
    let mut moving = join(&rig);
    let outcome = run_join(&mut moving, mixed);
    assert_eq!(moving.counts().base_poses_rejected, 1);
    assert!(outcome.keyframes.len() > 20, "{}", moving.counts());
    let chain = Chain::from_urdf(&rig.arm.urdf_text, &rig.arm.base_link, &rig.arm.flange_link)
        .expect("a Panda");
    for keyframe in &outcome.keyframes {
        let secs = keyframe.stamp.secs();
        assert!((secs - 2.0).abs() > 0.1, "no keyframe around the NaN pose");
        let base_from_flange = chain.forward(&joints_rad(secs)).expect("seven joints");
        let expected = Transform::translation(secs, 0.0, 0.0)
            * base_from_flange
            * rig.cameras[0].parent_from_camera;
        assert!(
            (keyframe.world_from_camera.translation.vector - expected.translation.vector).norm()
                < 1e-6
        );
    }
}

#[test]
fn every_rejection_reason_is_reachable() {
    let counts_with = |how: fn(Image) -> Image, overrides: &[Override]| {
        let corrupted = samples(4).into_iter().map(|sample| match sample {
            Sample::Image(image) if !image.is_depth() && image.stamp.0 > 2_000_000_000 => {
                Sample::Image(how(image))
            }
            other => other,
        });
        let mut join = join(&rig(overrides));
        run_join(&mut join, corrupted);
        join.counts().clone()
    };
    type Case = (Rejection, fn(Image) -> Image, Vec<Override>);
    let cases: [Case; 8] = [
        (
            Rejection::UnknownCamera,
            |image| Image {
                camera: "elbow".into(),
                ..image
            },
            vec![],
        ),
        (
            Rejection::NotMoved,
            |image| image,
            vec![
                Override::new("join.min_translation_m", 0.2),
                Override::new("join.min_rotation_rad", 1.0),
            ],
        ),
        (
            Rejection::Blur,
            |image| Image {
                exposure_secs: Some(0.1),
                ..image
            },
            vec![],
        ),
        (
            Rejection::Shear,
            |image| image,
            vec![Override::new("join.max_shear_px", 0.05)],
        ),
        (
            Rejection::Undecodable,
            |image| Image {
                format: PixelFormat::Jpeg,
                ..image
            },
            vec![],
        ),
        (
            Rejection::Undecodable,
            |image| Image {
                size_px: [48, 64],
                ..image
            },
            vec![],
        ),
        (
            Rejection::Exposure,
            |image| Image {
                data: vec![3; image.data.len()].into(),
                ..image
            },
            vec![],
        ),
        (
            Rejection::NotSharp,
            |image| Image {
                data: vec![128; image.data.len()].into(),
                ..image
            },
            vec![],
        ),
    ];
    for (why, how, overrides) in cases {
        let counts = counts_with(how, &overrides);
        assert!(
            counts.rejected.get(&why).is_some_and(|n| *n >= 3),
            "{why}: {counts}"
        );
        assert!(counts.to_string().contains(&why.to_string()));
    }
    let smoothed: fn(Image) -> Image = |image| {
        let averages = image.data.windows(10).map(|pixels| {
            let sum: u32 = pixels
                .iter()
                .step_by(3)
                .map(|level| u32::from(*level))
                .sum();
            u8::try_from(sum / 4).expect("the average of four levels")
        });
        let data: Vec<u8> = averages.chain([90; 9]).collect();
        Image {
            data: data.into(),
            ..image
        }
    };
    let n_not_sharp = |min_frac: f64| {
        let counts = counts_with(
            smoothed,
            &[Override::new("join.min_sharpness_frac", min_frac)],
        );
        counts
            .rejected
            .get(&Rejection::NotSharp)
            .copied()
            .unwrap_or_default()
    };
    assert_eq!(n_not_sharp(0.0), 0);
    assert!(
        n_not_sharp(0.9) >= 3,
        "a higher threshold rejects more images"
    );
    assert_eq!(
        counts_with(|image| image, &[])
            .rejected
            .keys()
            .collect::<Vec<_>>(),
        [&Rejection::NotMoved],
        "sharp and well-exposed images are not rejected for other reasons"
    );
}

#[test]
fn keyframe_is_kept_without_missing_depth() {
    let without = samples(4)
        .into_iter()
        .filter(|sample| !matches!(sample, Sample::Image(image) if image.is_depth() && image.stamp.0 > 2_000_000_000));
    let mut join = join(&rig(&[]));
    let outcome = run_join(&mut join, without);
    let missing = outcome
        .keyframes
        .iter()
        .filter(|keyframe| keyframe.depth.is_none())
        .count();
    assert!(missing > 3 && missing < outcome.keyframes.len());
    assert_eq!(join.counts().without_depth, missing as u64);
}

#[test]
fn list_selects_exactly_its_keyframes() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("keyframes.txt");
    let mut first = join(&rig(&[]));
    let chosen = run_join(&mut first, samples(6));
    std::fs::write(&path, list_text(first.keyframes())).expect("disk space");
    // A rig whose checks would reject all of them.
    let strict = rig(&[
        Override::new("join.max_shear_px", 0),
        Override::new("join.min_translation_m", 10),
        Override::new("join.max_keyframes", 8),
    ]);
    let mut second = join(&strict).taking_only(KeyframeList::load(&path).expect("a list"));
    let listed = run_join(&mut second, samples(6));
    assert_eq!(
        differences(&chosen.keyframes, &listed.keyframes),
        Vec::<String>::new()
    );
    assert_eq!((listed.rejected, listed.evicted), (vec![], vec![]));
    let again = folder.path().join("again.txt");
    std::fs::write(&again, list_text(second.keyframes())).expect("disk space");
    assert_eq!(
        std::fs::read_to_string(&path).expect("a list"),
        std::fs::read_to_string(&again).expect("a list")
    );
}

#[test]
fn stationary_camera_gives_few_keyframes_over_time() {
    let fixed = rig(&[
        Override::new("camera.wrist.parent", "world"),
        Override::new("join.fixed_keyframes", 3),
    ]);
    let outcome = run_join(&mut join(&fixed), samples(8));
    let stamps: Vec<i64> = outcome
        .keyframes
        .iter()
        .map(|keyframe| keyframe.stamp.0 / 1_000_000_000)
        .collect();
    assert_eq!(stamps, [0, 1, 2]);
    assert!(
        outcome
            .keyframes
            .iter()
            .all(|keyframe| keyframe.world_from_camera == fixed.cameras[0].parent_from_camera)
    );
}

#[test]
fn one_hour_run_keeps_only_the_store_in_memory() {
    let rig = rig(&[
        Override::new("join.max_keyframes", 24),
        Override::new("join.min_translation_m", 0.0005),
    ]);
    let mut join = join(&rig);
    let (color, depth) = (color("wrist", 0), depth(0));
    let (mut n_images, mut n_evicted) = (0_u64, 0_u64);
    for tick in 0..3600 * 20_i64 {
        let mut samples = vec![reading(tick * 50_000_000)];
        if tick % 4 == 2 {
            // The images are not in phase with the motion, so that every image has a slightly
            // different pose.
            let stamp = Stamp(tick * 50_000_000 - 21_000_000 - tick % 977 * 10_000);
            n_images += 1;
            samples.extend([&color, &depth].map(|image| {
                Sample::Image(Image {
                    stamp,
                    ..image.clone()
                })
            }));
        }
        for event in samples.into_iter().flat_map(|sample| join.push(sample)) {
            n_evicted += u64::from(matches!(event, JoinEvent::Evicted { .. }));
        }
    }
    join.finish();
    assert_eq!(join.counts().images, n_images);
    assert_eq!(join.keyframes().count(), 24);
    assert!(
        n_evicted > 20 && n_evicted == join.counts().evicted,
        "{n_evicted}: {}",
        join.counts()
    );
    assert_eq!(join.counts().accepted, 24 + join.counts().evicted);
    assert!(join.cameras[0].waiting.oldest().is_none());
}

#[test]
fn downscaled_keyframes_are_area_means_with_scaled_intrinsics() {
    let whole = run_join(&mut join(&rig(&[])), samples(4));
    let half = run_join(
        &mut join(&rig(&[Override::new("train.scale", 0.5)])),
        samples(4),
    );
    let stamps = |outcome: &JoinOutcome| {
        outcome
            .keyframes
            .iter()
            .map(|keyframe| keyframe.stamp)
            .collect::<Vec<_>>()
    };
    assert_eq!(
        stamps(&whole),
        stamps(&half),
        "scale must not affect acceptance"
    );
    let (full, small) = (&whole.keyframes[1], &half.keyframes[1]);
    assert_eq!(
        (small.size_px, small.focal_px, small.principal_px),
        ([32, 24], [30.5, 30.75], [16.0, 12.0])
    );
    let red = |keyframe: &Keyframe, x: usize, y: usize| {
        u32::from(keyframe.rgba_srgb[4 * (y * keyframe.size_px[0] as usize + x)])
    };
    for (x, y) in [(0, 0), (17, 9), (31, 23)] {
        let sum: u32 = [(0, 0), (1, 0), (0, 1), (1, 1)]
            .iter()
            .map(|(i, j)| red(full, 2 * x + i, 2 * y + j))
            .sum();
        assert!((4 * red(small, x, y)).abs_diff(sum) <= 2, "pixel {x} {y}");
    }
    let depth_px = |keyframe: &Keyframe| keyframe.depth.as_ref().expect("depth").size_px;
    assert_eq!(depth_px(small), depth_px(full), "depth keeps its size");
    let truth = small.truth.as_ref().expect("a simulation");
    assert_eq!(
        (truth.rgba_srgb.len(), truth.psnr_ceiling),
        (4 * 32 * 24, None)
    );
    assert!(
        Join::new(&rig(&[Override::new("train.scale", 0.2)]))
            .is_err_and(|error| format!("{error:#}").contains("13x10"))
    );
}
