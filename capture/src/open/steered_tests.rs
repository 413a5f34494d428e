//! A simulated arm that is taken over from its tour, while nobody reads the samples of its rig.

use super::steered::steered;
use super::{Devices, Opened, SteeredArm};
use crate::config::{Override, Rig};
use drivers::motion::{ArmState, Output, Target};
use drivers::{Sample, clock};
use kinematics::Stamp;
use std::path::Path;
use std::time::{Duration, Instant};
use toml::Value;

/// Maximum time until a state, on a machine that is busy with other tests.
const TIMEOUT: Duration = Duration::from_secs(600);
/// How far the first joint is moved, radians.
const TURN_RAD: f64 = 0.15;
/// Largest difference between a setpoint and the arm at rest, radians. The scene's own arm has the
/// dynamics of MuJoCo.
const ARRIVED_RAD: f64 = 2e-3;
/// A motion that takes longer than a target lasts: four seconds at 0.5 rad/s. On a busy machine, a
/// simulated arm may catch up with the motion of more than a second before its target expires.
const FAR_RAD: f64 = 2.0;
const EXPIRY_SECS: f64 = 0.8;

fn small_rig(more: &[Override]) -> Rig {
    let list = |key, numbers: [f64; 2]| Override::new(key, Value::from(numbers.to_vec()));
    let overrides = [
        list("camera.wrist.size_px", [160.0, 120.0]),
        list("camera.wrist.intrinsics.focal_px", [153.65, 153.55]),
        list("camera.wrist.intrinsics.principal_px", [80.925, 59.1]),
    ];
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/static-arm.toml");
    let overrides = [&overrides[..], more].concat();
    Rig::load(&path, &overrides).expect("a bundled rig file")
}

/// The same arm with a longer link, which is simulated as the robot of a rig file.
fn small_twin() -> Rig {
    let mut rig = small_rig(&[]);
    rig.sim.scene = None;
    rig.arm.urdf_text = rig.arm.urdf_text.replace("0.316", "0.336");
    rig
}

fn wait_for(arm: &SteeredArm, what: &str, accepts: impl Fn(&ArmState) -> bool) -> ArmState {
    let began = Instant::now();
    loop {
        let state = arm.port().state();
        if let Some(state) = state.clone().filter(&accepts) {
            return state;
        }
        assert!(began.elapsed() < TIMEOUT, "not {what}: {state:?}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Sends targets to the arm until its state is accepted. On a busy machine, the newest target may
/// expire on the way; the next one then continues from where the arm has braked.
fn steer(
    arm: &SteeredArm,
    goal: &[f64],
    what: &str,
    accepts: impl Fn(&ArmState) -> bool,
) -> ArmState {
    wait_for(arm, what, |state| {
        let now = clock::now();
        arm.port().send(&Output::Follow(Target {
            motion: state.braked_motion + 1,
            serial: now.0.unsigned_abs(),
            position: goal.to_vec(),
            expires_at: now.plus_secs(EXPIRY_SECS),
        }));
        accepts(state)
    })
}

fn move_to(arm: &SteeredArm, goal: &[f64]) -> ArmState {
    steer(arm, goal, "at its goal", |state| {
        state.is_at_rest && (state.position[0] - goal[0]).abs() < 1e-9
    })
}

/// Reads samples until the joints are at a goal, and an image is newer than a time.
fn wait_for_samples(opened: &mut Opened, goal: &[f64], after: Stamp) {
    let mut has_arrived = false;
    let mut has_shown = false;
    let began = Instant::now();
    while !(has_arrived && has_shown) {
        assert!(
            began.elapsed() < TIMEOUT,
            "the samples do not show the motion"
        );
        let sample = opened.source.next_sample().expect("the rig works");
        match sample.expect("it has no end") {
            Sample::Joints(state) => {
                let off = state.position.iter().zip(goal);
                has_arrived =
                    off.fold(0.0, |most, (a, b)| f64::max(most, (a - b).abs())) < ARRIVED_RAD;
            }
            Sample::Image(image) => has_shown = image.stamp > after,
            _ => {}
        }
    }
}

fn check(rig: Rig) {
    let (mut opened, arm) = steered(rig, Devices::Sim).expect("the rig opens");
    let first = wait_for(&arm, "on its tour", |state| !state.is_at_rest);
    wait_for(&arm, "moving", |state| state.position != first.position);
    arm.begin();
    let rest = wait_for(&arm, "at rest", |state| state.is_at_rest);

    // Nobody takes a sample, as if the trainer was blocked. The arm does not need that.
    let mut goal = rest.position.clone();
    // Away from the end of the joint's range, at which a tour may be.
    let direction = -goal[0].signum();
    goal[0] += direction * TURN_RAD;
    let arrived = move_to(&arm, &goal);
    wait_for_samples(&mut opened, &goal, arrived.reported_at);
    assert_eq!(arm.n_contacts(), Some(0), "it moves in free space");

    // Without newer targets, the arm brakes on its way.
    goal[0] += direction * FAR_RAD;
    let moving = steer(&arm, &goal, "on its way", |state| !state.is_at_rest);
    let braked = wait_for(&arm, "braked", |state| {
        state.braked_motion > moving.braked_motion && state.is_at_rest
    });
    let left_rad = direction * (goal[0] - braked.position[0]);
    assert!(left_rad > 0.1, "{braked:?}");
    drop(opened);
}

#[test]
fn the_arm_of_a_scene_leaves_its_tour_and_follows_while_nobody_reads_its_samples() {
    check(small_rig(&[]));
}

#[test]
fn the_arm_of_a_rig_file_leaves_its_tour_and_follows_while_nobody_reads_its_samples() {
    check(small_twin());
}

/// The driver of a real arm, which moves an emulated controller with its checks.
#[cfg(target_os = "linux")]
#[test]
fn an_emulated_franka_arm_follows_and_its_cameras_show_it() {
    let rig = small_rig(&[
        Override::new("arm.driver", "franka"),
        Override::new("arm.address", "127.0.0.1"),
        Override::new("arm.motion.on_loss", "hold"),
        Override::new("sim.emulate_arm", true),
    ]);
    let (mut opened, arm) = steered(rig, Devices::Sim).expect("the rig opens");
    let rest = wait_for(&arm, "at rest", |state| state.is_at_rest);
    arm.begin();
    let mut goal = rest.position.clone();
    goal[0] += TURN_RAD;
    let arrived = move_to(&arm, &goal);
    wait_for_samples(&mut opened, &goal, arrived.reported_at);
    assert_eq!(arm.n_contacts(), None);
    arm.port().send(&Output::Brake);
}
