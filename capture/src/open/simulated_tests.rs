//! The simulated rig through the join: poses against ground truth, and identical live, recorded and
//! replayed keyframes.

use super::{Devices, Opened};
use crate::config::{Override, Rig};
use crate::join::{Join, JoinEvent};
use crate::notes::Notes;
use crate::recorded_meshes::RecordedMeshes;
use crate::stations::Stations;
use drivers::tags::{Family, TagDetector};
use drivers::wire::datagram::{
    Clock, DatagramHeader, PoseDatagram, ScanPart, encode_pose, encode_scan,
};
use drivers::{RangePoint, Sample};
use keyframe::Keyframe;
use kinematics::Transform;
use numbers::quantile::median;
use std::net::{SocketAddr, UdpSocket};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use toml::Value;

/// A rig with a quarter of the resolution, in lockstep.
fn small(name: &str, overrides: &[Override]) -> Rig {
    let list = |key, numbers: [f64; 2]| Override::new(key, Value::from(numbers.to_vec()));
    let mut all = vec![
        list("camera.wrist.size_px", [160.0, 120.0]),
        list("camera.wrist.intrinsics.focal_px", [153.65, 153.55]),
        list("camera.wrist.intrinsics.principal_px", [80.925, 59.1]),
        Override::new("sim.lockstep", true),
    ];
    all.extend(overrides.iter().cloned());
    Rig::load(
        &Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../rigs")
            .join(name),
        &all,
    )
    .expect("a bundled rig file")
}

/// Reads a source to its end; `on_sample` is called for every sample.
fn keyframes(opened: Opened, mut on_sample: impl FnMut(&Sample)) -> (Vec<Arc<Keyframe>>, Join) {
    let mut source = opened.source;
    let mut join = Join::new(&opened.rig).expect("a good rig");
    let mut keyframes = Vec::new();
    let mut take = |events: Vec<JoinEvent>| {
        keyframes.extend(events.into_iter().filter_map(|event| match event {
            JoinEvent::Accepted(keyframe) => Some(keyframe),
            _ => None,
        }));
    };
    while let Some(sample) = source.next_sample().expect("the rig works") {
        on_sample(&sample);
        take(join.push(sample));
    }
    take(join.finish());
    (keyframes, join)
}

/// Everything that the trainer gets from a keyframe, as text that is exact to the last bit.
fn bits(keyframes: &[Arc<Keyframe>]) -> Vec<String> {
    // Debug prints the shortest digits that parse to the same float, so equal texts mean equal
    // bits.
    keyframes
        .iter()
        .map(|keyframe| format!("{keyframe:?}"))
        .collect()
}

/// The notes of a run of the rig with tags on a fixed base, with a camera that has moved relative
/// to its mount.
fn tag_notes(moved: &Transform) -> Vec<String> {
    let overrides = [
        Override::new("sim.lockstep", true),
        Override::new("base.driver", "fixed"),
        Override::new("sim.duration_secs", 8.0),
        Override::new("camera.wrist.rate_hz", 4.0),
    ];
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/tags.toml");
    let mut rig = Rig::load(&path, &overrides).expect("a bundled rig file");
    let camera = &mut rig.cameras[0];
    camera.depth = None;
    camera.sim.truth.parent_from_camera = Some(camera.parent_from_camera * moved);
    let notes = Notes::default();
    let opened = super::rig(rig, Devices::Sim)
        .expect("the rig opens")
        .with_tag_check(&notes)
        .expect("a thread");
    let mut source = opened.source;
    while source.next_sample().expect("the rig works").is_some() {}
    notes.list()
}

#[test]
fn tags_show_that_a_camera_has_moved() {
    assert_eq!(tag_notes(&Transform::identity()), Vec::<String>::new());
    let moved = Transform::new(
        nalgebra::Vector3::new(0.012, -0.009, 0.0),
        nalgebra::Vector3::new(0.0, 0.035, 0.0),
    );
    let notes = tag_notes(&moved);
    let [note] = &notes[..] else {
        panic!("one note: {notes:?}")
    };
    let numbers: Vec<f64> = note
        .split(' ')
        .filter_map(|word| word.parse().ok())
        .collect();
    let [degrees, degrees_sigma, mm, mm_sigma, ..] = numbers[..] else {
        panic!("{note}")
    };
    assert!(
        (degrees - 2.0).abs() < 0.3 && (mm - 15.0).abs() < 3.0,
        "{note}"
    );
    assert!(degrees_sigma < 0.4 && mm_sigma < 3.0, "{note}");
    assert!(
        note.starts_with("camera \"wrist\" is off by ") && note.contains("according to tags"),
        "{note}"
    );
    assert!(
        note.contains("it has moved relative to its mount"),
        "{note}"
    );
}

#[test]
fn live_and_replayed_keyframes_are_identical() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let rig = small("static-arm.toml", &[Override::new("sim.n_images", 24)]);
    let live = super::rig(rig.clone(), Devices::Sim).expect("the simulator");
    let mut recorder =
        super::recorder(&path, &live.rig, &RecordedMeshes::default()).expect("a new file");
    let (first, join) = keyframes(live, |sample| recorder.write(sample).expect("disk space"));
    recorder.finish().expect("disk space");
    assert!(first.len() >= 8, "{}", join.counts());
    assert!(
        first
            .iter()
            .all(|keyframe| keyframe.depth.is_some() && keyframe.truth.is_some()),
        "{}",
        join.counts()
    );
    let (again, _) = keyframes(
        super::rig(rig, Devices::Sim).expect("the simulator"),
        |_| {},
    );
    assert!(bits(&first) == bits(&again), "two lockstep runs differ");
    let (replayed, _) = keyframes(
        super::recording(&path, None, &[]).expect("a recording"),
        |_| {},
    );
    assert!(bits(&first) == bits(&replayed), "the replay differs");
}

#[test]
fn forward_kinematics_matches_the_simulator() {
    const TOLERANCE_M: f64 = 1e-4; // Total error from joint readings to keyframes.
    const TOLERANCE_RAD: f64 = 1e-4;
    let rig = small(
        "static-arm.toml",
        &[
            Override::new("sim.n_images", 40),
            Override::new("sim.ideal", true),
        ],
    );
    let (keyframes, join) = keyframes(
        super::rig(rig, Devices::Sim).expect("the simulator"),
        |_| {},
    );
    let mut max_error = [0.0_f64; 2];
    for keyframe in &keyframes {
        let truth = keyframe
            .truth
            .as_ref()
            .expect("ground truth comes with the images");
        let difference = truth.world_from_camera.inverse() * keyframe.world_from_camera;
        max_error[0] = max_error[0].max(difference.translation.vector.norm());
        max_error[1] = max_error[1].max(difference.rotation.angle());
        assert!(truth.psnr_ceiling.is_none(), "an ideal camera has no noise");
    }
    assert!(
        keyframes.len() > 10 && max_error[0] < TOLERANCE_M && max_error[1] < TOLERANCE_RAD,
        "{max_error:?}; {}",
        join.counts()
    );
}

#[test]
fn joint_readings_follow_rig_file_order() {
    const TOLERANCE_M: f64 = 1e-4; // Same as for joints in chain order.
    let rig = small(
        "static-arm.toml",
        &[
            Override::new("sim.n_images", 12),
            Override::new("sim.ideal", true),
        ],
    );
    let reversed: Vec<String> = rig.arm.joints.iter().rev().cloned().collect();
    let rig = Rig {
        arm: crate::config::Arm {
            joints: reversed,
            ..rig.arm.clone()
        },
        ..rig
    };
    let (keyframes, join) = keyframes(
        super::rig(rig, Devices::Sim).expect("the simulator"),
        |_| {},
    );
    let difference_m = |keyframe: &Arc<Keyframe>| {
        let truth = keyframe
            .truth
            .as_ref()
            .expect("ground truth comes with the images");
        (truth.world_from_camera.translation.vector - keyframe.world_from_camera.translation.vector)
            .norm()
    };
    assert!(
        keyframes.len() > 3
            && keyframes
                .iter()
                .all(|keyframe| difference_m(keyframe) < TOLERANCE_M),
        "{}",
        join.counts()
    );
}

#[test]
fn two_cameras_keep_their_own_size_rate_and_kind() {
    let rig = small("two-cameras.toml", &[Override::new("sim.duration_secs", 4)]);
    let (keyframes, join) = keyframes(
        super::rig(rig, Devices::Sim).expect("the simulator"),
        |_| {},
    );
    let of = |name: &str| {
        keyframes
            .iter()
            .filter(|keyframe| &*keyframe.camera == name)
            .cloned()
            .collect::<Vec<_>>()
    };
    let (wrist, overview) = (of("wrist"), of("overview"));
    assert!(
        wrist.len() > 8 && (3..=5).contains(&overview.len()),
        "{} and {}; {}",
        wrist.len(),
        overview.len(),
        join.counts()
    );
    assert!(
        wrist
            .iter()
            .all(|keyframe| keyframe.size_px == [160, 120] && keyframe.depth.is_some())
    );
    assert!(
        overview
            .iter()
            .all(|keyframe| keyframe.size_px == [1280, 720] && keyframe.depth.is_none())
    );
}

#[test]
fn real_time_rig_ends_after_its_duration() {
    let rig = small(
        "static-arm.toml",
        &[
            Override::new("sim.lockstep", false),
            Override::new("sim.duration_secs", 1.5),
        ],
    );
    let mut n_images = 0;
    let (_, join) = keyframes(
        super::rig(rig, Devices::Sim).expect("the simulator"),
        |sample| {
            n_images += u64::from(matches!(sample, Sample::Image(image) if !image.is_depth()));
        },
    );
    assert!((2..=24).contains(&n_images), "{n_images} images");
    assert_eq!(join.counts().images, n_images);
}

#[test]
fn a_rig_without_cameras_delivers_joints_in_lockstep() {
    let mut rig = small("static-arm.toml", &[]);
    // For an arm with a longer link, there is no bundled scene. Such an arm may have no camera.
    rig.sim.scene = None;
    rig.arm.urdf_text = rig.arm.urdf_text.replace("0.316", "0.336");
    rig.cameras.clear();
    let mut source = super::rig(rig, Devices::Sim).expect("the simulator").source;
    for _ in 0..6000 {
        let sample = source.next_sample().expect("the rig works");
        assert!(matches!(sample, Some(Sample::Joints(_))), "{sample:?}");
    }
}

/// Range scans as text that is exact to the last bit.
fn range_bits(join: &Join) -> Vec<String> {
    join.range_scans().map(|scan| format!("{scan:?}")).collect()
}

fn mobile(name: &str, overrides: &[Override]) -> Rig {
    let mut all = vec![
        Override::new("sim.lockstep", true),
        Override::new("train.scale", 0.25),
    ];
    all.extend(overrides.iter().cloned());
    Rig::load(
        &Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../rigs")
            .join(name),
        &all,
    )
    .expect("a bundled rig file")
}

#[test]
fn moving_base_keyframes_and_scans_replay_identically() {
    for (name, secs) in [("mobile-base-small.toml", 4.0), ("mobile-arm.toml", 3.0)] {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("run.mcap");
        let rig = mobile(name, &[Override::new("sim.duration_secs", secs)]);
        let live = super::rig(rig.clone(), Devices::Sim).expect("the simulator");
        let mut recorder =
            super::recorder(&path, &live.rig, &RecordedMeshes::default()).expect("a new file");
        let mut samples = Vec::new();
        let (first, join) = keyframes(live, |sample| {
            recorder.write(sample).expect("disk space");
            samples.push(format!("{sample:?}"));
        });
        recorder.finish().expect("disk space");
        assert!(first.len() >= 3, "{name}: {}", join.counts());
        let n_scans = join.range_scans().count();
        assert!(
            (n_scans >= 30) == (name == "mobile-base-small.toml"),
            "{name}: {n_scans} scans, {}",
            join.counts()
        );
        let (again, join_again) = keyframes(
            super::rig(rig, Devices::Sim).expect("the simulator"),
            |_| {},
        );
        assert!(
            bits(&first) == bits(&again) && range_bits(&join) == range_bits(&join_again),
            "{name}: two runs differ"
        );
        let mut replayed = samples.iter();
        let opened = super::recording(&path, None, &[]).expect("a recording");
        let (replay, join_replay) = keyframes(opened, |sample| {
            assert!(
                replayed.next() == Some(&format!("{sample:?}")),
                "{name}: a sample differs"
            );
        });
        assert!(
            replayed.next().is_none() && bits(&first) == bits(&replay),
            "{name}: the replay differs"
        );
        assert!(
            range_bits(&join) == range_bits(&join_replay),
            "{name}: the scans of the replay differ"
        );
    }
}

#[test]
fn moving_base_poses_and_scans_match_the_simulator() {
    const TOLERANCE: f64 = 1e-4; // Meters and radians: joints every 1 ms and base poses every 10 ms, interpolated.
    for (name, secs) in [("mobile-base-small.toml", 6.0), ("mobile-arm.toml", 6.0)] {
        let rig = mobile(
            name,
            &[
                Override::new("sim.duration_secs", secs),
                Override::new("sim.ideal", true),
                // Poses without errors need no correction, which would have errors of its own.
                Override::new("base.realign", false),
            ],
        );
        let (keyframes, join) = keyframes(
            super::rig(rig, Devices::Sim).expect("the simulator"),
            |_| {},
        );
        assert!(keyframes.len() > 4, "{name}: {}", join.counts());
        for keyframe in &keyframes {
            let truth = keyframe
                .truth
                .as_ref()
                .expect("ground truth comes with the images");
            let difference = truth.world_from_camera.inverse() * keyframe.world_from_camera;
            assert!(
                difference.translation.vector.norm() < TOLERANCE
                    && difference.rotation.angle() < TOLERANCE,
                "{name}: {difference}"
            );
            let twist = keyframe.twist.expect("poses arrive continuously");
            let is_moving = twist.linear_m_s.norm() + twist.angular_rad_s.norm() > 1e-3;
            assert!(
                is_moving || keyframe.stamp.0 < 1_000_000_000,
                "{name}: {twist:?} at {:?}",
                keyframe.stamp
            );
        }
        for scan in join.range_scans() {
            // Without noise, echoes lie within the room of 15 x 10 x 3 m up to the errors of poses
            // and f32.
            let inside =
                |[x, y, z]: [f32; 3]| x.abs() < 7.502 && y.abs() < 5.002 && z > -0.002 && z < 3.002;
            assert!(
                scan.points_in_world_m.len() > 4000
                    && scan.points_in_world_m.iter().all(|point| inside(*point))
            );
        }
    }
}

/// An unused address of the loopback interface.
fn free_address() -> SocketAddr {
    UdpSocket::bind("127.0.0.1:0")
        .and_then(|socket| socket.local_addr())
        .expect("a free port")
}

#[test]
fn network_samples_are_registered_recorded_and_replayed() {
    const POINT: RangePoint = RangePoint {
        position_m: [2.0, 0.0, 0.0],
        ring: 1,
        offset_micros: 300,
    };
    let [to_base, to_lidar] = [free_address(), free_address()];
    let text = |key, value: &str| Override::new(key, value);
    let rig = small(
        "static-arm.toml",
        &[
            Override::new("sim.lockstep", false),
            text("base.driver", "udp"),
            text("base.address", &to_base.to_string()),
            text("range.lidar.driver", "udp"),
            text("range.lidar.address", &to_lidar.to_string()),
        ],
    );
    let opened = super::rig(rig, Devices::Real).expect("a simulated arm, and two sockets");
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let mut recorder =
        super::recorder(&path, &opened.rig, &RecordedMeshes::default()).expect("a new file");
    let mut join = Join::new(&opened.rig).expect("a good rig");
    let mut source = opened.source;
    let stop = AtomicBool::new(false);
    let mut reported = Vec::new();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let socket = UdpSocket::bind("127.0.0.1:0").expect("a free port");
            for seq in 0.. {
                let header = DatagramHeader {
                    seq,
                    clock: Clock::Monotonic,
                    stamp_nanos: drivers::clock::now().0,
                };
                let world_from_base = Transform::translation(0.5, 0.0, 0.0);
                socket
                    .send_to(
                        &encode_pose(&PoseDatagram {
                            header,
                            world_from_base,
                            covariance: None,
                        }),
                        to_base,
                    )
                    .expect("loopback");
                if seq % 10 == 0 {
                    let part = ScanPart {
                        header,
                        frame: "lidar".into(),
                        part: 0,
                        n_parts: 1,
                        points: vec![POINT],
                    };
                    socket
                        .send_to(&encode_scan(&part), to_lidar)
                        .expect("loopback");
                }
                std::thread::sleep(Duration::from_millis(10));
                if stop.load(Ordering::Relaxed) {
                    break;
                }
            }
        });
        while join.range_scans().count() < 5
            || !reported
                .iter()
                .any(|sample| matches!(sample, Sample::Image(_)))
        {
            let sample = source
                .next_sample()
                .expect("the rig works")
                .expect("it has no end");
            recorder.write(&sample).expect("disk space");
            join.push(sample.clone());
            reported.push(sample);
        }
        stop.store(true, Ordering::Relaxed);
    });
    recorder.finish().expect("disk space");
    // The scanner's position on the base plus the base's position in the world.
    let scan = join.range_scans().next().expect("five of them");
    let [x, y, z] = scan.points_in_world_m[0];
    assert!(
        (x - 2.5).abs() < 1e-6 && y.abs() < 1e-6 && z.abs() < 1e-6,
        "{x} {y} {z}"
    );
    let mut replay = super::recording(&path, None, &[])
        .expect("a recording")
        .source;
    let replayed: Vec<Sample> =
        std::iter::from_fn(|| replay.next_sample().expect("readable")).collect();
    assert!(replayed == reported, "the replay differs");
}

#[test]
fn lockstep_with_network_devices_is_rejected() {
    let rig = small(
        "static-arm.toml",
        &[
            Override::new("base.driver", "udp"),
            Override::new("base.address", free_address().to_string()),
        ],
    );
    let error_message = super::rig(rig, Devices::Real)
        .err()
        .expect("lockstep with real devices")
        .to_string();
    assert!(
        error_message.contains("sim.lockstep") && error_message.contains("real devices"),
        "{error_message}"
    );
}

#[test]
fn drifting_base_is_corrected_live_and_in_replay() {
    const MAX_REMAINING_M: f64 = 1.5e-3; // 320x180 pixels: one covers 7 mm of the cabinet at the first station.
    const MAX_REMAINING_RAD: f64 = 1.5e-3;
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let list = |key, numbers: [f64; 2]| Override::new(key, Value::from(numbers.to_vec()));
    let rig = small(
        "mobile-arm.toml",
        &[
            list("camera.wrist.size_px", [320.0, 180.0]),
            list("camera.wrist.intrinsics.focal_px", [226.3, 226.2]),
            list("camera.wrist.intrinsics.principal_px", [162.0, 88.8]),
            Override::new("train.scale", 1.0),
            Override::new("sim.n_images", 96),
        ],
    );
    let live = super::rig(rig, Devices::Sim).expect("the simulator");
    let mut recorder =
        super::recorder(&path, &live.rig, &RecordedMeshes::default()).expect("a new file");
    let mut stations = Stations::new(&live.rig).expect("its base moves");
    let (reported, join) = keyframes(live, |sample| recorder.write(sample).expect("disk space"));
    recorder.finish().expect("disk space");
    let first = stations.corrected(reported.clone());
    let recorded = super::recording(&path, None, &[]).expect("a recording");
    let mut again = Stations::new(&recorded.rig).expect("its base moves");
    let replayed = again.corrected(keyframes(recorded, |_| {}).0);
    assert!(bits(&first) == bits(&replayed), "the replay differs");
    assert_eq!(stations.reports(), again.reports());

    let error_of = |keyframe: &Keyframe| {
        let truth = keyframe
            .truth
            .as_ref()
            .expect("ground truth comes with the images")
            .world_from_camera;
        let difference = truth.inverse() * keyframe.world_from_camera;
        [
            difference.translation.vector.norm(),
            difference.rotation.angle(),
        ]
    };
    let is_at_second_station = |keyframe: &&Arc<Keyframe>| {
        keyframe
            .base
            .as_ref()
            .is_some_and(|base| base.station == Some(1))
    };
    let max_error = |keyframes: &[Arc<Keyframe>]| {
        let error_of = keyframes
            .iter()
            .filter(is_at_second_station)
            .map(|keyframe| error_of(keyframe));
        error_of.fold([0.0_f64; 2], |max_error, error_of| {
            [max_error[0].max(error_of[0]), max_error[1].max(error_of[1])]
        })
    };
    assert!(
        reported.iter().filter(is_at_second_station).count() >= 14,
        "{}",
        join.counts()
    );
    let [before, after] = [max_error(&reported), max_error(&first)];
    assert!(
        before[0] > 0.015 && before[1] > 0.005,
        "{before:?} m and rad before correction"
    );
    assert!(
        after[0] < MAX_REMAINING_M && after[1] < MAX_REMAINING_RAD,
        "{after:?} m and rad left: {:?}",
        stations.reports()
    );
}

#[test]
fn tags_localize_an_unmeasured_base() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/tags.toml");
    let overrides = [
        Override::new("sim.lockstep", true),
        Override::new("sim.n_images", 40),
    ];
    let rig = Rig::load(&path, &overrides).expect("a bundled rig file");
    for (id, tag) in &rig.base.tags {
        let truth = sim::layout::world_from_tag(*id as usize);
        let error_of = tag.world_from_tag.inverse() * truth;
        assert!(
            error_of.translation.vector.norm() < 1e-6 && error_of.rotation.angle() < 1e-6,
            "tag {id}: {error_of}"
        );
    }
    let mut reported = Vec::new();
    let (keyframes, join) = keyframes(
        super::rig(rig, Devices::Sim).expect("the simulator"),
        |sample| {
            if let Sample::Base(pose) = sample {
                reported.push(pose.world_from_base);
            }
        },
    );
    assert!(reported.len() >= 20, "{}", reported.len());
    let mut error_of: Vec<[f64; 2]> = reported
        .iter()
        .map(|pose| [pose.translation.vector.norm(), pose.rotation.angle()])
        .collect();
    error_of.sort_by(|a, b| a[0].total_cmp(&b[0]));
    eprintln!(
        "{} poses; base off by {:?} in the median, {:?} at worst",
        error_of.len(),
        error_of[error_of.len() / 2],
        error_of[error_of.len() - 1]
    );
    let last = &reported[reported.len() - 1];
    assert!(
        last.translation.vector.norm() < 1e-3 && last.rotation.angle() < 1e-3,
        "{last}"
    );
    assert!(error_of[error_of.len() / 2][0] < 1e-3, "{error_of:?}");
    assert!(keyframes.len() >= 8, "{}", join.counts());
    let max_error = keyframes.iter().filter_map(|keyframe| {
        let truth = keyframe.truth.as_ref()?;
        Some(
            (keyframe.world_from_camera.inverse() * truth.world_from_camera)
                .translation
                .vector
                .norm(),
        )
    });
    let max_error = max_error.fold(0.0, f64::max);
    assert!(max_error > 0.0 && max_error < 5e-3, "{max_error} m");
}

#[test]
fn tag_corners_match_the_simulator() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/static-arm.toml");
    let at_once = Override::new("camera.wrist.readout_micros", 0);
    let overrides = [
        Override::new("sim.lockstep", true),
        Override::new("sim.n_images", 30),
        at_once,
    ];
    let rig = Rig::load(&path, &overrides).expect("a bundled rig file");
    let mut detector = TagDetector::start(Family::Tag36h11).expect("a thread");
    let mut source = super::rig(rig.clone(), Devices::Sim)
        .expect("the simulator")
        .source;
    let (mut detections, mut off_px) = (Vec::new(), Vec::new());
    while let Some(sample) = source.next_sample().expect("the rig works") {
        match sample {
            Sample::Image(image) if !image.is_depth() => {
                detections.extend(
                    detector
                        .detect_blocking(image)
                        .into_iter()
                        .map(|detection| detection.expect("an image")),
                );
            }
            Sample::Truth(truth) => {
                let Some(ix) = detections
                    .iter()
                    .position(|detection| detection.stamp == truth.image.stamp)
                else {
                    continue;
                };
                for tag in detections.swap_remove(ix).tags {
                    let camera_from_tag = truth.world_from_camera.inverse()
                        * sim::layout::world_from_tag(tag.id as usize);
                    let corners = [[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]];
                    for ([x, y], detected) in corners.into_iter().zip(tag.corners_px) {
                        let corner =
                            camera_from_tag * nalgebra::Point3::new(0.024 * x, 0.024 * y, 0.0);
                        let at = rig.cameras[0]
                            .intrinsics
                            .project(&corner.coords)
                            .expect("in front of the camera");
                        off_px.push([detected[0] - at[0], detected[1] - at[1]]);
                    }
                }
            }
            _ => {}
        }
    }
    // Medians are used, because corners of sides at grazing angles are unreliable.
    let median = |numbers: Vec<f64>| median(&numbers).expect("corners");
    let along = |axis: usize| median(off_px.iter().map(|error_of| error_of[axis]).collect());
    let spread = median(off_px.iter().map(|[x, y]| x.hypot(*y)).collect());
    // Half a pixel would mean that corners are counted from the center of the first pixel.
    let n = off_px.len();
    assert!(
        n >= 100 && along(0).abs() < 0.15 && along(1).abs() < 0.15,
        "{n}: {}, {} px",
        along(0),
        along(1)
    );
    assert!(spread < 0.5, "{spread} px");
}
