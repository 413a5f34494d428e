//! Clients of `/steer` drive the simulated base of `fieldrig run`, and the arm on one.

use crate::small_rig;
use crate::steering::{Run, replay};
use crate::steering_client::{Operator, TIMEOUT, numbers};
use serde_json::{Value, json};
use std::time::Instant;

/// How far the base is driven, meters.
const DISTANCE_M: f64 = 0.3;
/// Largest difference between the heading and the direction of the motion. The newest pose is a
/// moment old when a motion begins.
const MAX_OFF_RAD: f64 = 0.05;
/// Largest distance between a base that has arrived and its goal, meters.
const AT_GOAL_M: f64 = 0.1;
/// How far a joint may be from its stowed position, radians.
const STOWED_RAD: f64 = 0.05;

fn distance_m(a: &[f64], b: &[f64]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

fn forward(forward_m_s: f64) -> Value {
    json!({"kind": "base_velocity", "forward_m_s": forward_m_s, "left_m_s": 0, "yaw_rad_s": 0})
}

/// Largest distance of a joint from a position.
fn farthest_rad(state: &Value, position: &[f64]) -> f64 {
    let now = numbers(&state["position"]);
    let distances = now.iter().zip(position).map(|(a, b)| (a - b).abs());
    distances.fold(0.0, f64::max)
}

#[test]
fn an_operator_takes_the_simulated_base_over_drives_it_and_sends_it_back() {
    let folder = tempfile::tempdir().expect("a folder");
    small_rig::write_base(folder.path());
    let run = Run::start(folder.path(), &["--enable-motion"]);
    let mut driver = Operator::connect(&run);
    assert_eq!(driver.robot["joints"], json!([]), "{}", driver.robot);
    assert_eq!(driver.robot["base"]["max_left_m_s"], 0.3);
    assert_eq!(driver.robot["base"]["avoidance"], "seen_surfaces");

    // The base walks its tour.
    driver.wait_for_base_pose();
    let first = driver.base_pose();
    let began = Instant::now();
    while distance_m(&driver.base_pose(), &first) < 0.1 {
        driver.next_state();
        assert!(began.elapsed() < TIMEOUT, "it does not walk: {first:?}");
    }
    driver.take_control();
    let start = driver.base_at_rest();

    driver.hold_until(&forward(0.4), |driver| {
        distance_m(&driver.base_pose(), &start) > DISTANCE_M
    });
    let end = driver.base_at_rest();
    let direction = (end[1] - start[1]).atan2(end[0] - start[0]);
    let off_rad = (direction - start[2]).sin().abs();
    assert!(off_rad < MAX_OFF_RAD, "from {start:?} to {end:?}");

    let [x_m, y_m, heading_rad] = [start[0], start[1], start[2]];
    let back = json!({"kind": "base_goal", "x_m": x_m, "y_m": y_m, "heading_rad": heading_rad});
    driver.hold_until(&back, |driver| driver.state["base"]["has_arrived"] == true);
    let back = driver.base_at_rest();
    assert!(distance_m(&back, &start) < AT_GOAL_M, "{back:?}, {start:?}");

    run.interrupt();
    let replayed = replay(folder.path());
    assert_eq!(replayed["identical"], true, "{replayed}");
    assert!(replayed["targets"].as_u64() > Some(50), "{replayed}");
}

#[test]
fn an_operator_moves_the_arm_of_a_simulated_base_stows_it_and_drives() {
    let folder = tempfile::tempdir().expect("a folder");
    small_rig::write_mobile_arm(folder.path());
    let run = Run::start(folder.path(), &["--enable-motion"]);
    let mut operator = Operator::connect(&run);
    let stowed = numbers(&operator.robot["base"]["stowed"]);
    assert_eq!(stowed.len(), 7, "{}", operator.robot);
    operator.wait_for_base_pose();
    operator.take_control();
    let start = operator.base_at_rest();
    let scanning = numbers(&operator.state["position"]);
    assert!(farthest_rad(&operator.state, &stowed) > 0.1, "{scanning:?}");

    // The arm is not stowed, so the base does not move.
    operator.hold_until(&forward(0.2), |operator| {
        let limits = operator.state["limits"].as_array();
        limits.into_iter().flatten().any(|limit| {
            let text = limit["text"].as_str().unwrap_or_default();
            limit["part"] == "base" && text.contains("stow the arm before the base moves")
        })
    });
    let joints = json!({"kind": "joints", "position": stowed});
    operator.hold_until(&joints, |operator| {
        farthest_rad(&operator.state, &stowed) < STOWED_RAD
    });
    assert!(distance_m(&operator.base_at_rest(), &start) < 0.02);

    operator.hold_until(&forward(0.2), |operator| {
        assert_ne!(operator.state["moved_part"], "arm");
        distance_m(&operator.base_pose(), &start) > 0.5 * DISTANCE_M
    });
    // The arm stays stowed meanwhile, and moves again after the base.
    assert!(farthest_rad(&operator.state, &stowed) < 2.0 * STOWED_RAD);
    operator.wait_for_rest();
    let mut raised = stowed.clone();
    raised[3] += 0.1;
    let joints = json!({"kind": "joints", "position": raised});
    operator.hold_until(&joints, |operator| {
        farthest_rad(&operator.state, &raised) < STOWED_RAD
    });
    operator.release(&joints);

    // A stop by anybody stops both parts.
    let mut other = Operator::connect(&run);
    other.send(&json!({"type": "stop"}));
    operator.read_until(|message| message["stop"].is_string());
    run.interrupt();
    let replayed = replay(folder.path());
    assert_eq!(replayed["identical"], true, "{replayed}");
    assert!(replayed["targets"].as_u64() > Some(50), "{replayed}");
}
