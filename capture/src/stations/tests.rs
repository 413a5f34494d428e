use super::*;
use keyframe::DepthMap;
use nalgebra::Vector3;

/// A room corner with textured walls, rendered from a camera pose: brightness and depth.
fn render_room(pose: &Transform) -> (Vec<u8>, Vec<f32>) {
    let (mut rgba, mut depth_m) = (Vec::new(), Vec::new());
    let origin = pose.translation.vector;
    for pixel in 0..SIZE_PX[0] * SIZE_PX[1] {
        let [x, y] = [pixel % SIZE_PX[0], pixel / SIZE_PX[0]].map(|px| f64::from(px) + 0.5);
        let direction =
            pose.rotation * Vector3::new((x - 80.0) / FOCAL_PX, (y - 60.0) / FOCAL_PX, 1.0);
        let walls = [
            (Vector3::x(), 2.0),
            (Vector3::y(), 1.1),
            (-Vector3::y(), 1.2),
            (Vector3::new(0.3, 0.2, -1.0), 0.9),
        ];
        let depth_along = |(normal, offset): &(Vector3<f64>, f64)| {
            let z = (offset - normal.dot(&origin)) / normal.dot(&direction);
            if z > 0.0 { z } else { f64::INFINITY }
        };
        let z = walls.iter().map(depth_along).fold(f64::INFINITY, f64::min);
        let at = origin + direction * z;
        let wave =
            |size: f64, x: f64, y: f64, z: f64| size * (x * at.x + y * at.y + z * at.z).sin();
        let level = 128.0
            + wave(30.0, 9.0, 13.0, -8.0)
            + wave(30.0, -6.0, 7.0, 15.0)
            + wave(25.0, 4.0, -5.0, 3.0);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a gray level in a test"
        )]
        let level = level.round() as u8;
        rgba.extend([level, level, level, 255]);
        #[expect(clippy::cast_possible_truncation, reason = "meters in a test")]
        depth_m.push(if z.is_finite() { z as f32 } else { 0.0 });
    }
    (rgba, depth_m)
}

const SIZE_PX: [u32; 2] = [160, 120];
const FOCAL_PX: f64 = 120.0;

/// True base pose: at one station, on the way, at another station.
fn true_base(fraction: f64) -> Transform {
    Transform::new(
        Vector3::new(0.5 * fraction, 0.1 * fraction, 0.0),
        Vector3::new(0.0, 0.0, 0.15 * fraction),
    )
}

/// Error of the reported base pose, which grows on the way.
fn reported_base(fraction: f64) -> Transform {
    let truth = true_base(fraction);
    let rotation =
        nalgebra::UnitQuaternion::from_scaled_axis(Vector3::new(0.003, -0.004, 0.014) * fraction);
    Transform::from_parts(
        (truth.translation.vector + Vector3::new(0.012, -0.015, 0.005) * fraction).into(),
        rotation * truth.rotation,
    )
}

/// The `ix`-th keyframe at 2 Hz: ten seconds at a station, three on the way, ten at the next
/// station.
fn keyframe(ix: usize) -> Arc<Keyframe> {
    let (station, fraction) = match ix {
        0..24 => (Some(0), 0.0),
        24..30 => (None, (ix as f64 - 23.0) / 7.0),
        _ => (Some(1), 1.0),
    };
    let wave = |hz: f64, phase: f64| (hz * ix as f64 + phase).sin();
    let base_from_camera = Transform::from_parts(
        Vector3::new(
            0.15 * wave(0.9, 0.0),
            0.2 * wave(0.7, 1.0),
            0.3 + 0.1 * wave(0.5, 2.0),
        )
        .into(),
        nalgebra::UnitQuaternion::from_scaled_axis(Vector3::z() * (0.4 * wave(0.8, 0.5)))
            * nalgebra::UnitQuaternion::from_matrix(&nalgebra::Matrix3::from_columns(&[
                -Vector3::y(),
                -Vector3::z(),
                Vector3::x(),
            ])),
    );
    let (rgba, depth_m) = render_room(&(true_base(fraction) * base_from_camera));
    let world_from_camera = reported_base(fraction) * base_from_camera;
    let lens = ([FOCAL_PX; 2], [80.0, 60.0]);
    Arc::new(Keyframe {
        camera: "wrist".into(),
        stamp: Stamp::from_secs(0.5 * ix as f64),
        size_px: SIZE_PX,
        focal_px: lens.0,
        principal_px: lens.1,
        rgba_srgb: rgba.into(),
        depth: Some(DepthMap {
            size_px: SIZE_PX,
            focal_px: lens.0,
            principal_px: lens.1,
            depth_m: depth_m.into(),
            world_from_camera,
        }),
        world_from_camera,
        twist: None,
        readout_secs: 0.0,
        joint_twists: [].into(),
        base: Some(BaseState {
            station,
            world_from_base: reported_base(fraction),
            map_from_odom: Transform::identity(),
            truth: Some(true_base(fraction)),
        }),
        split: Split::of(ix),
        truth: None,
        robot: None,
    })
}

fn all() -> Vec<Arc<Keyframe>> {
    (0..54).map(keyframe).collect()
}

fn stations() -> Stations {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/mobile-arm.toml");
    Stations::new(&Rig::load(&path, &[]).unwrap()).expect("its base moves")
}

/// Error of a keyframe's base pose, millimeters and degrees.
fn base_error(keyframe: &Keyframe) -> (f64, f64) {
    let base_state = keyframe.base.as_ref().unwrap();
    let base = base_state.map_from_odom * base_state.world_from_base;
    let left = base_state.truth.unwrap().inverse() * base;
    (
        1e3 * left.translation.vector.norm(),
        left.rotation.angle().to_degrees(),
    )
}

fn bits(keyframes: &[Arc<Keyframe>]) -> Vec<String> {
    let shown = |keyframe: &Arc<Keyframe>| {
        format!(
            "{:?} {:?} {:?}",
            keyframe.stamp, keyframe.world_from_camera, keyframe.base
        )
    };
    keyframes.iter().map(shown).collect()
}

/// The largest errors of keyframes that passed, millimeters and degrees.
fn worst_error<'a>(keyframes: impl Iterator<Item = &'a Arc<Keyframe>>) -> (f64, f64) {
    keyframes.fold((0.0, 0.0), |(mm, degrees), keyframe| {
        let error = base_error(keyframe);
        (error.0.max(mm), error.1.max(degrees))
    })
}

#[test]
fn keyframes_pass_at_once_and_are_revised_when_their_station_is_registered() {
    let mut stations = stations();
    let (mut accepted, mut revised) = (Vec::new(), Vec::new());
    let mut sort = |released: Vec<Change>| {
        let n = released.len();
        for change in released {
            match change {
                Change::Accepted(keyframe) => accepted.push(keyframe),
                Change::Revised(keyframe) => revised.push(keyframe),
                Change::Evicted { .. } => {}
            }
        }
        n
    };
    let mut n_waiting = 0;
    for keyframe in all() {
        let n = sort(stations.push(Change::Accepted(keyframe)));
        n_waiting += usize::from(n == 0);
    }
    sort(stations.finish());
    let stamps = |keyframes: &[Arc<Keyframe>]| {
        let stamps = keyframes.iter().map(|keyframe| keyframe.stamp);
        stamps.collect::<Vec<_>>()
    };
    assert_eq!(
        stamps(&accepted),
        stamps(&all()),
        "each passes once, in order"
    );
    let provisional = accepted.iter().filter(|keyframe| {
        let is_same = |revised: &&Arc<Keyframe>| revised.stamp == keyframe.stamp;
        revised.iter().any(|revised| is_same(&revised))
    });
    let (mm, degrees) = worst_error(provisional);
    // One image on the way shows two walls only.
    assert!(mm < 4.0 && degrees < 0.1, "provisional: {mm} mm, {degrees}");
    assert_eq!(n_waiting, 0, "no keyframe waits");
    assert!(revised.len() >= MIN_KEYFRAMES, "{}", revised.len());
    let (mm, degrees) = worst_error(revised.iter());
    assert!(mm < 0.5 && degrees < 0.05, "revised: {mm} mm, {degrees}");
}

/// The keyframes that passed, each with its last pose, in the order in which they were accepted.
fn last_poses(released: Vec<Change>) -> Vec<Arc<Keyframe>> {
    let mut last: Vec<Arc<Keyframe>> = Vec::new();
    for change in released {
        match change {
            Change::Accepted(keyframe) => last.push(keyframe),
            Change::Revised(revised) => {
                let same = last.iter_mut().find(|of| of.stamp == revised.stamp);
                *same.expect("it has passed before") = revised;
            }
            Change::Evicted { .. } => {}
        }
    }
    last
}

#[test]
fn evicted_keyframe_is_not_revised() {
    let mut stations = stations();
    let evicted = keyframe(25).stamp;
    let mut released = Vec::new();
    for keyframe in all() {
        let is_next = keyframe.stamp > evicted;
        if is_next && keyframe.stamp.secs_since(evicted) < 0.6 {
            let camera = Arc::clone(&keyframe.camera);
            let stamp = evicted;
            released.extend(stations.push(Change::Evicted { camera, stamp }));
        }
        released.extend(stations.push(Change::Accepted(keyframe)));
    }
    released.extend(stations.finish());
    let of_evicted = released.iter().filter_map(|change| match change {
        Change::Accepted(keyframe) if keyframe.stamp == evicted => Some("accepted"),
        Change::Revised(keyframe) if keyframe.stamp == evicted => Some("revised"),
        Change::Evicted { .. } => Some("evicted"),
        _ => None,
    });
    assert_eq!(of_evicted.collect::<Vec<_>>(), ["accepted", "evicted"]);
}

#[test]
fn reason_of_a_rejection_is_stated() {
    let report = |n_validation_images: usize, kept: bool| {
        let correction = StationCorrection {
            translation_m: [0.01, 0.0, 0.0],
            translation_sigma_m: [0.001; 3],
            rotation_rad: [0.0; 3],
            rotation_sigma_rad: [0.001; 3],
            unobservable: Vec::new(),
            gain_db: 1.0,
            standard_error_db: 0.1,
            n_validation_images,
            n_pairs: 20,
            kept,
        };
        StationReport {
            station: 2,
            n_keyframes: 30,
            correction: Some(correction),
            tracked: None,
            base_error: None,
        }
        .to_string()
    };
    let too_few = report(MIN_VALIDATION_IMAGES - 1, false);
    assert!(
        too_few.contains("can be checked on 3 validation images only, and 4 are needed")
            && !too_few.contains("not significant"),
        "{too_few}"
    );
    let one = report(1, false);
    assert!(one.contains("on 1 validation image only"), "{one}");
    let uncertain = report(MIN_VALIDATION_IMAGES, false);
    assert!(
        uncertain.contains("uncertain or not significant"),
        "{uncertain}"
    );
    let kept = report(MIN_VALIDATION_IMAGES, true);
    assert!(kept.starts_with("base at station 2: moved by"), "{kept}");
}

#[test]
fn keyframes_of_a_drifted_station_are_corrected_in_order() {
    let given = all();
    let mut stations = stations();
    let released = stations.corrected(given.clone());
    let stamps = |keyframes: &[Arc<Keyframe>]| {
        keyframes
            .iter()
            .map(|keyframe| keyframe.stamp)
            .collect::<Vec<_>>()
    };
    assert_eq!(stamps(&given), stamps(&released));
    assert!(
        given[..24]
            .iter()
            .zip(&released)
            .all(|(given, released)| Arc::ptr_eq(given, released)),
        "keyframes of the first station are unchanged"
    );
    for (given, released) in given.iter().zip(&released).skip(24) {
        let ((before_mm, _), (mm, degrees)) = (base_error(given), base_error(released));
        assert!(
            mm < 0.5 && degrees < 0.05,
            "{:?}: {before_mm} mm, now {mm} mm, {degrees}",
            released.stamp
        );
        // Depth is corrected too.
        let [was, is] = [given, released].map(|of| {
            of.world_from_camera.inverse() * of.depth.as_ref().unwrap().world_from_camera
        });
        assert!((was.to_homogeneous() - is.to_homogeneous()).abs().max() < 1e-9);
    }
    let [report] = stations.reports() else {
        panic!("{:?}", stations.reports())
    };
    let [before, after] = report.base_error.unwrap();
    assert!(
        report.station == 1 && before.m > 0.019 && after.m < 5e-4 && after.rad < 1e-3,
        "{report}"
    );
    assert!(
        report
            .to_string()
            .starts_with("base at station 1: moved by"),
        "{report}"
    );
    let camera = Transform::translation(0.1, 0.2, 0.3);
    assert_ne!(stations.corrected_pose("wrist", &camera), camera);
    assert_eq!(stations.corrected_pose("of the room", &camera), camera);
}

#[test]
fn station_is_held_until_its_correction_can_be_checked() {
    // The first station has one validation image. The 14 usable keyframes with which the next
    // station could be registered have two. The fourth one is the 20th usable keyframe.
    let faster = |ix: usize| {
        Arc::new(Keyframe {
            stamp: Stamp::from_secs(0.25 * ix as f64),
            ..(*keyframe(ix)).clone()
        })
    };
    let mut stations = stations();
    let released = stations.corrected((18..54).map(faster).collect());
    assert_eq!(released.len(), 36);
    let [report] = stations.reports() else {
        panic!("{:?}", stations.reports())
    };
    assert_eq!(report.n_keyframes, 20);
    let n_validation = report.correction.as_ref().map(|of| of.n_validation_images);
    assert!(n_validation >= Some(MIN_VALIDATION_IMAGES), "{report}");
}

#[test]
fn restarted_source_begins_without_a_correction() {
    let mut stations = stations();
    let first_round = stations.corrected(all());
    assert!(base_error(&all()[53]).0 > 15.0 && base_error(&first_round[53]).0 < 0.5);
    assert!(stations.restart().is_empty(), "nothing is queued");
    let second_round = stations.corrected(all());
    assert_eq!(
        bits(&second_round[..24]),
        bits(&all()[..24]),
        "the first station is uncorrected"
    );
    assert!(
        base_error(&second_round[53]).0 < 0.5,
        "{:?}",
        base_error(&second_round[53])
    );
}

#[test]
fn incremental_and_batch_correction_agree() {
    let at_once = stations().corrected(all());
    for patience in [0.0, 0.05] {
        let mut stations = stations();
        let mut released = Vec::new();
        for keyframe in all() {
            let stamp = keyframe.stamp;
            released.extend(stations.push(Change::Accepted(keyframe)));
            std::thread::sleep(Duration::from_secs_f64(patience));
            released.extend(stations.advance_to(stamp));
        }
        released.extend(stations.finish());
        let mut last = last_poses(released);
        // Keyframes whose depth determines no correction pass later.
        last.sort_by_key(|keyframe| keyframe.stamp);
        assert_eq!(bits(&at_once), bits(&last));
    }
}

#[test]
fn held_keyframes_are_released_in_order_after_a_limit() {
    let mut stations = stations();
    // As if depth did not determine the drift.
    stations.map_from_tracked = None;
    let count = |released: &[Change]| released.len();
    for keyframe in all().into_iter().take(24) {
        assert_eq!(
            count(&stations.push(Change::Accepted(keyframe))),
            1,
            "the first station is not queued"
        );
    }
    let evicted = |stamp: Stamp| Change::Evicted {
        camera: "wrist".into(),
        stamp,
    };
    assert_eq!(count(&stations.push(evicted(Stamp(0)))), 1);
    assert!(
        stations.push(Change::Accepted(keyframe(25))).is_empty(),
        "on the way"
    );
    assert!(stations.push(evicted(keyframe(25).stamp)).is_empty());
    assert!(stations.advance_to(Stamp::from_secs(30.0)).is_empty());
    let released = stations.advance_to(Stamp::from_secs(12.5 + MAX_TRAVEL_SECS + 1.0));
    assert!(
        matches!(&released[..], [Change::Accepted(_), Change::Evicted { .. }]),
        "{}",
        released.len()
    );
    // A scan with too few keyframes is registered once it has lasted long enough.
    for ix in 40..44 {
        assert!(stations.push(Change::Accepted(keyframe(ix))).is_empty());
    }
    let late = Stamp::from_secs(20.0 + MAX_SCAN_SECS + 1.0);
    let mut released = stations.advance_to(late);
    while released.is_empty() {
        std::thread::sleep(Duration::from_millis(10));
        released = stations.advance_to(late);
    }
    assert_eq!((released.len(), stations.reports().len()), (4, 1));
    let Change::Accepted(keyframe) = &released[0] else {
        panic!("a keyframe")
    };
    assert!(
        stations.reports()[0]
            .correction
            .as_ref()
            .is_none_or(|correction| !correction.kept || base_error(keyframe).0 < 2.0)
    );
}

#[test]
fn keyframes_without_depth_follow_those_with_depth() {
    let mut stations = stations();
    for keyframe in all().into_iter().take(28) {
        stations.push(Change::Accepted(keyframe));
    }
    let without_depth = Keyframe {
        camera: "color".into(),
        depth: None,
        ..(*keyframe(28)).clone()
    };
    let released = stations.push(Change::Accepted(Arc::new(without_depth)));
    let [Change::Accepted(keyframe)] = &released[..] else {
        panic!("{} changes", released.len())
    };
    let (mm, degrees) = base_error(keyframe);
    assert!(mm < 8.0 && degrees < 0.2, "{mm} mm, {degrees}");
}

#[test]
fn the_live_pose_does_not_jump_when_a_drive_takes_long() {
    let mut stations = stations();
    for keyframe in all().into_iter().take(29) {
        stations.push(Change::Accepted(keyframe));
    }
    let before = stations.map_from_odom();
    assert_ne!(before, Transform::identity());
    assert!(!stations.held.is_empty());
    stations.advance_to(Stamp::from_secs(14.0 + MAX_TRAVEL_SECS));
    assert!(stations.held.is_empty());
    // Other changes say nothing about the base.
    stations.push(Change::Evicted {
        camera: "wrist".into(),
        stamp: Stamp(0),
    });
    stations.push(Change::Accepted(Arc::new(Keyframe {
        camera: "fixed".into(),
        base: None,
        ..(*keyframe(29)).clone()
    })));
    assert_eq!(stations.map_from_odom(), before);
}

#[test]
fn station_without_overlap_is_kept_and_reported() {
    let away = |keyframe: Arc<Keyframe>| match keyframe.base.as_ref().and_then(|base| base.station)
    {
        Some(0) => keyframe,
        _ => Arc::new(keyframe.with_base_correction(&Transform::translation(90.0, 0.0, 0.0))),
    };
    let given: Vec<_> = all().into_iter().map(away).collect();
    let mut stations = stations();
    let released = stations.corrected(given.clone());
    assert_eq!(bits(&given), bits(&released));
    assert!(
        stations.reports()[0]
            .to_string()
            .contains("do not overlap with earlier ones"),
        "{}",
        stations.reports()[0]
    );
}

#[test]
fn only_moving_bases_are_realigned_on_request() {
    let rig = |name: &str, realign: bool| {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../rigs")
            .join(name);
        Rig::load(
            &path,
            &[crate::config::Override::new("base.realign", realign)],
        )
        .unwrap()
    };
    assert!(Stations::new(&rig("mobile-arm.toml", false)).is_none());
    assert!(Stations::new(&rig("static-arm.toml", true)).is_none());
}
