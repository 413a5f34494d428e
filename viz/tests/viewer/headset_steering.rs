//! Steers a scripted arm by hand from the bundled page in an emulated headset, and checks that
//! everything that makes the pose of the hand doubtful opens the dead-man switch.
//!
//! Skipped, with a message, if Chromium, the bundle (`make web`) or IWER (`scripts/check-web.sh`)
//! is missing.

use crate::headset_page::Headset;
use crate::robot;
use crate::steering_page::{
    FOLLOWS_MILLIS, N_OPEN, POSITION, PREVIEWS_MILLIS, ScriptedArm, base_from_tip, hub_with_robot,
};
use nalgebra::Vector3;
use parking_lot::Mutex;
use std::sync::Arc;
use test_support::browser::{browser_for_page, wait_for};
use trainer::RenderRequest;
use viz::{Server, ServerConfig, SteeringCommand, SteeringIntent, publish_steering};

/// Rounding of 32-bit matrices of the headset.
const TOLERANCE_M: f64 = 1e-4;

#[test]
fn hands_in_a_headset_steer_with_a_held_trigger() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let last: Arc<Mutex<Option<RenderRequest>>> = Arc::default();
    let (hub, thread) = hub_with_robot(&last);
    let config = ServerConfig {
        listen: ([127, 0, 0, 1], 0).into(),
    };
    let server = Server::start(config, hub.clone()).expect("a free port");
    let Some(mut headset) = Headset::open(&program, &server.url(), "") else {
        return;
    };
    let arm = ScriptedArm::start(FOLLOWS_MILLIS);
    publish_steering(&hub, Some(Arc::clone(&arm.server)));
    headset.enter("enter-vr");
    headset.press("Robot");
    headset.press("Take control");
    headset.wait_until("control", "aimAt('Give back')");
    headset.press("Steer by hand");
    headset.wait_until("steering by hand", "isOn('Steer by hand')");
    check_motion(&mut headset, &arm);
    check_interruptions(&mut headset, &arm);

    // The stop needs no release of the trigger, and no control.
    headset.press("STOP THE ROBOT");
    wait_for(&mut headset.browser, "the stop", |_| {
        arm.script.lock().stops.len() == 1
    });

    // Leaving while the trigger is held opens the switch.
    let far = ScriptedArm::start(PREVIEWS_MILLIS);
    publish_steering(&hub, Some(Arc::clone(&far.server)));
    drop(arm);
    headset.wait_until("no control", "aimAt('Take control')");
    headset.press("Take control");
    headset.wait_until("control", "aimAt('Give back')");
    check_goal(&mut headset, &far);
    headset.browser.evaluate("device.activeSession.end()");
    headset.wait_until_left();
    wait_for_release(&mut headset, &far, "the headset was left");
    publish_steering(&hub, None);
    drop((far, thread, server));
}

fn put_hand(headset: &mut Headset, x: f64) {
    headset.browser.evaluate(&format!(
        "hidePalm(); put('right', [{x}, 1.2, -0.4], [0, 0, -1], [{x}, 1.2, -3])"
    ));
    headset.next_frames();
}

fn hand_of(command: Option<SteeringCommand>) -> Option<Vector3<f64>> {
    let SteeringCommand {
        intent: Some(SteeringIntent::Hand { base_from_hand }),
        grip: Some(_),
        ..
    } = command?
    else {
        return None;
    };
    Some(Vector3::from_column_slice(&base_from_hand[..3]))
}

fn wait_for_grip(headset: &mut Headset, arm: &ScriptedArm) -> u64 {
    let mut grip = 0;
    wait_for(&mut headset.browser, "a grip", |_| {
        grip = arm
            .last_command()
            .and_then(|command| command.grip)
            .unwrap_or(0);
        grip > 0
    });
    grip
}

/// Waits for open samples, and checks that they stay open.
fn wait_for_release(headset: &mut Headset, arm: &ScriptedArm, why: &str) {
    wait_for(&mut headset.browser, why, |_| {
        arm.last_command()
            .is_some_and(|command| command.grip.is_none())
    });
    let n_before = arm.n_commands();
    wait_for(&mut headset.browser, "further samples", |_| {
        arm.n_commands() > n_before + N_OPEN
    });
    let script = arm.script.lock();
    let is_open = |command: &SteeringCommand| command.grip.is_none();
    assert!(script.commands[n_before..].iter().all(is_open), "{why}");
}

/// The tip makes the motion of the hand, from where the tip is.
fn check_motion(headset: &mut Headset, arm: &ScriptedArm) {
    const BY_M: f64 = 0.1;
    put_hand(headset, 0.2);
    headset.hold("right", "trigger", true);
    wait_for_grip(headset, arm);
    let start = base_from_tip().translation.vector;
    put_hand(headset, 0.2 + BY_M);
    let matrix: Vec<f64> =
        serde_json::from_value(headset.report()["worldFromHeadset"].clone()).expect("a matrix");
    let right_in_world = Vector3::new(matrix[0], matrix[1], matrix[2]);
    let world_from_base = robot::state(POSITION[1]).world_from_base;
    let expected = start + world_from_base.inverse_transform_vector(&right_in_world) * BY_M;
    wait_for(&mut headset.browser, "the moved tip", |_| {
        hand_of(arm.last_command()).is_some_and(|hand| (hand - expected).norm() < TOLERANCE_M)
    });
    headset.hold("right", "trigger", false);
    wait_for_release(headset, arm, "the release of the trigger");
}

/// Whatever makes the pose of the hand doubtful opens the switch although the trigger stays held,
/// and only a new pull closes it.
fn check_interruptions(headset: &mut Headset, arm: &ScriptedArm) {
    let mut last_grip = 0;
    for (why, begin, end) in [
        (
            "the headset was taken off",
            "device.updateVisibilityState('hidden')",
            "device.updateVisibilityState('visible')",
        ),
        ("the headset was recentered", "device.recenter()", "0"),
        (
            "tracking of the hand was lost",
            "device.controllers.right.connected = false",
            "device.controllers.right.connected = true",
        ),
        (
            "the scene was moved",
            "hold('left', 'squeeze', 1)",
            "hold('left', 'squeeze', 0)",
        ),
    ] {
        put_hand(headset, 0.2);
        headset.hold("right", "trigger", true);
        let grip = wait_for_grip(headset, arm);
        assert!(grip > last_grip, "{why}: each pull is a new grip");
        last_grip = grip;
        headset.browser.evaluate(begin);
        if why == "the scene was moved" {
            headset.next_frames();
            headset
                .browser
                .evaluate("put('left', [-0.1, 1.1, -0.5], [0, 0, -1], [-0.1, 1.1, -3])");
        }
        wait_for_release(headset, arm, why);
        headset.browser.evaluate(end);
        headset.next_frames();
        wait_for_release(headset, arm, why);
        headset.hold("right", "trigger", false);
    }
}

/// Over a long link, the hand moves the goal, and the arm moves only while "go" is held.
fn check_goal(headset: &mut Headset, arm: &ScriptedArm) {
    put_hand(headset, 0.2);
    headset.hold("right", "trigger", true);
    put_hand(headset, 0.3);
    wait_for(&mut headset.browser, "a preview", |_| {
        !arm.script.lock().previews.is_empty()
    });
    headset.hold("right", "trigger", false);
    {
        let script = arm.script.lock();
        let is_open = |command: &SteeringCommand| command.grip.is_none();
        assert!(
            script.commands.iter().all(is_open),
            "a preview moves nothing"
        );
    }
    headset.wait_until(
        "a way to go",
        "document.getElementById('steer-go').disabled === false",
    );
    headset.point_at("Hold to go");
    headset.hold("right", "trigger", true);
    wait_for(&mut headset.browser, "the way to the goal", |_| {
        let command = arm.last_command();
        command.is_some_and(|command| {
            command.grip.is_some() && matches!(command.intent, Some(SteeringIntent::Joints { .. }))
        })
    });
    headset.hold("right", "trigger", false);
    wait_for_release(headset, arm, "the release of go");
}
