//! An arm with emulated CAN motors is moved to poses, and a camera takes images of it at rest,
//! inside the virtual kernel. This tests all of `fieldrig calibrate hand-eye --move` except for the
//! detection of the target and the estimation. The drivers, the bus and the camera device are the
//! same as in a real rig. The motors are emulated, and the images are the test pattern of vivid.

use crate::can::Wire;
use crate::can_motion::Motors;
use capture::config::{Override, Rig};
use capture::open::{self, Devices};
use capture::{ArmCapture, Stop};
use drivers::can::emulated::State;
use std::path::Path;
use std::time::Duration;

/// Positions are 16-bit numbers over 25 rad, and the stiff motors follow within a few milliradians.
const CLOSE_RAD: f64 = 5e-3;

#[test]
#[ignore = "needs the virtual kernel"]
fn can_arm_visits_poses_holds_and_stops() {
    let wire = Wire::new("vcan5", false);
    let overrides = [
        Override::new("arm.motion.on_loss", "release"),
        Override::new("arm.motion.timeout_millis", 250.0),
        Override::new("arm.motor.joint1.stiffness_nm_rad", 30.0),
        Override::new("arm.motor.joint1.damping_nm_s_rad", 1.5),
        Override::new("arm.motor.joint2.stiffness_nm_rad", 30.0),
        Override::new("arm.motor.joint2.damping_nm_s_rad", 1.5),
    ];
    let rig = Rig::load(Path::new("/rigs/vivid-can.toml"), &overrides)
        .expect("the rig file of the tests");
    let motors = Motors::new(wire.config(false), rig.arm.motors.clone(), false);
    let opened = open::movable(&rig, Devices::Real, "wrist").expect("camera and motors answer");
    let mut capture = ArmCapture::new(opened).expect("the robot description matches");
    capture
        .limit_distance(0.3)
        .expect("the arm reports its joints");
    for goal in [[0.0, 0.0], [0.4, -0.2], [-0.3, 0.3]] {
        assert!(
            capture
                .move_to(&goal, &Stop::default())
                .expect("the arm arrives")
        );
        let image = capture
            .image(&Stop::default())
            .expect("vivid streams")
            .expect("no stop was requested");
        let joints = image.arm.expect("the arm is known").joints;
        assert!(
            max_difference(&joints, &goal) < CLOSE_RAD,
            "{joints:?}, commanded {goal:?}"
        );
        assert!(
            max_difference(&motors.positions(), &goal) < CLOSE_RAD,
            "the shafts are elsewhere"
        );
        assert_eq!(image.gray.len(), 640 * 360);
    }
    // The stop comes before the arm has been at rest for long enough, so that no image ends the
    // wait.
    assert!(
        capture
            .move_to(&[-0.2, 0.2], &Stop::default())
            .expect("the arm arrives")
    );
    assert!(
        capture
            .image(&requested_after(Duration::from_millis(100)))
            .expect("the arm is well")
            .is_none()
    );
    let held = motors.positions();
    for _ in 0..100 {
        capture.joints().expect("the arm holds");
    }
    assert!(
        max_difference(&motors.positions(), &held) < 1e-3
            && max_difference(&held, &[-0.2, 0.2]) < CLOSE_RAD
    );
    // Now the stop comes during a motion.
    let is_complete = capture.move_to(&[0.6, 0.2], &requested_after(Duration::from_millis(400)));
    assert!(!is_complete.expect("the arm stops"));
    let rest = motors.positions();
    for _ in 0..100 {
        capture.joints().expect("the arm holds");
    }
    assert!(
        max_difference(&motors.positions(), &rest) < 2e-3 && rest[0] < 0.5,
        "{rest:?}"
    );
    assert_eq!(motors.states(), [State::Enabled; 2]);
    println!(
        "can: visited three poses, stopped while waiting at {held:.4?} and while moving at {rest:.4?}"
    );
    drop(capture);
    motors.wait_until("the motors are released", |observed| {
        observed
            .iter()
            .all(|observed| observed.state != State::Enabled)
    });
}

fn max_difference(a: &[f64], b: &[f64]) -> f64 {
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f64::max)
}

fn requested_after(delay: Duration) -> Stop {
    let stop = Stop::default();
    let later = stop.clone();
    std::thread::spawn(move || {
        std::thread::sleep(delay);
        later.request();
    });
    stop
}
