//! The simulated rig through join: poses against its own ground truth, and live, recorded and replayed keyframes alike.

use super::{Devices, Opened};
use crate::config::{Override, Rig};
use crate::join::{Join, JoinEvent};
use drivers::Sample;
use std::path::Path;
use std::sync::Arc;
use toml::Value;
use trainer::Keyframe;

/// A quarter of the resolution, in lockstep.
fn small(name: &str, overrides: &[Override]) -> Rig {
    let list = |key, numbers: [f64; 2]| Override::new(key, Value::from(numbers.to_vec()));
    let mut all = vec![
        list("camera.wrist.size_px", [160.0, 120.0]),
        list("camera.wrist.intrinsics.focal_px", [153.65, 153.55]),
        list("camera.wrist.intrinsics.principal_px", [80.925, 59.1]),
        Override::new("sim.lockstep", true),
    ];
    all.extend(overrides.iter().cloned());
    Rig::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs").join(name), &all)
        .expect("a rig file that comes along")
}

/// Plays a source to its end; `tap` sees every sample.
fn keyframes(opened: Opened, mut tap: impl FnMut(&Sample)) -> (Vec<Arc<Keyframe>>, Join) {
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
        tap(&sample);
        take(join.push(sample));
    }
    take(join.finish());
    (keyframes, join)
}

/// Everything of a keyframe that a trainer sees, as text with every bit in it.
fn bits(keyframes: &[Arc<Keyframe>]) -> Vec<String> {
    // Debug prints the shortest digits that give the same float back, so equal texts mean equal bits.
    keyframes.iter().map(|keyframe| format!("{keyframe:?}")).collect()
}

#[test]
fn live_recorded_and_replayed_keyframes_are_the_same_bits() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let rig = small("static-arm.toml", &[Override::new("sim.n_images", 24)]);
    let live = super::rig(rig.clone(), Devices::Sim).expect("the simulator");
    let mut recorder = super::recorder(&path, &live.rig).expect("a new file");
    let (first, join) = keyframes(live, |sample| recorder.write(sample).expect("room on the disk"));
    recorder.finish().expect("room on the disk");
    assert!(first.len() >= 8, "{}", join.counts());
    assert!(first.iter().all(|keyframe| keyframe.depth.is_some() && keyframe.truth.is_some()), "{}", join.counts());
    let (again, _) = keyframes(super::rig(rig, Devices::Sim).expect("the simulator"), |_| {});
    assert!(bits(&first) == bits(&again), "two lockstep runs differ");
    let (replayed, _) = keyframes(super::recording(&path, None, &[]).expect("a recording"), |_| {});
    assert!(bits(&first) == bits(&replayed), "the replay differs");
}

#[test]
fn forward_kinematics_agrees_with_the_simulator() {
    const CLOSE_M: f64 = 1e-4; // What the whole road from joint readings to keyframes may cost.
    const CLOSE_RAD: f64 = 1e-4;
    let rig = small("static-arm.toml", &[Override::new("sim.n_images", 40), Override::new("sim.ideal", true)]);
    let (keyframes, join) = keyframes(super::rig(rig, Devices::Sim).expect("the simulator"), |_| {});
    let mut worst = [0.0_f64; 2];
    for keyframe in &keyframes {
        let truth = keyframe.truth.as_ref().expect("ground truth comes beside the images");
        let apart = truth.world_from_camera.inverse() * keyframe.world_from_camera;
        worst[0] = worst[0].max(apart.translation.vector.norm());
        worst[1] = worst[1].max(apart.rotation.angle());
        assert!(truth.psnr_ceiling.is_none(), "an ideal camera has no noise");
    }
    assert!(keyframes.len() > 10 && worst[0] < CLOSE_M && worst[1] < CLOSE_RAD, "{worst:?}; {}", join.counts());
}

#[test]
fn readings_come_in_the_order_of_the_rig_file() {
    const CLOSE_M: f64 = 1e-4; // As with joints in their own order.
    let rig = small("static-arm.toml", &[Override::new("sim.n_images", 12), Override::new("sim.ideal", true)]);
    let reversed: Vec<String> = rig.arm.joints.iter().rev().cloned().collect();
    let rig = Rig { arm: crate::config::Arm { joints: reversed, ..rig.arm.clone() }, ..rig };
    let (keyframes, join) = keyframes(super::rig(rig, Devices::Sim).expect("the simulator"), |_| {});
    let apart_m = |keyframe: &Arc<Keyframe>| {
        let truth = keyframe.truth.as_ref().expect("ground truth comes beside the images");
        (truth.world_from_camera.translation.vector - keyframe.world_from_camera.translation.vector).norm()
    };
    assert!(keyframes.len() > 3 && keyframes.iter().all(|keyframe| apart_m(keyframe) < CLOSE_M), "{}", join.counts());
}

#[test]
fn two_cameras_keep_their_own_size_rate_and_kind() {
    let rig = small("two-cameras.toml", &[Override::new("sim.duration_secs", 4)]);
    let (keyframes, join) = keyframes(super::rig(rig, Devices::Sim).expect("the simulator"), |_| {});
    let of = |name: &str| keyframes.iter().filter(|keyframe| &*keyframe.camera == name).cloned().collect::<Vec<_>>();
    let (wrist, overview) = (of("wrist"), of("overview"));
    assert!(
        wrist.len() > 8 && (3..=5).contains(&overview.len()),
        "{} and {}; {}",
        wrist.len(),
        overview.len(),
        join.counts()
    );
    assert!(wrist.iter().all(|keyframe| keyframe.size_px == [160, 120] && keyframe.depth.is_some()));
    assert!(overview.iter().all(|keyframe| keyframe.size_px == [1280, 720] && keyframe.depth.is_none()));
}

#[test]
fn a_rig_in_real_time_ends_when_its_time_is_over() {
    let rig =
        small("static-arm.toml", &[Override::new("sim.lockstep", false), Override::new("sim.duration_secs", 1.5)]);
    let mut n_images = 0;
    let (_, join) = keyframes(super::rig(rig, Devices::Sim).expect("the simulator"), |sample| {
        n_images += u64::from(matches!(sample, Sample::Image(image) if !image.is_depth()));
    });
    assert!((2..=24).contains(&n_images), "{n_images} images");
    assert_eq!(join.counts().images, n_images);
}
