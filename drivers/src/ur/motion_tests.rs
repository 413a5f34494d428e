//! Tests of motions against emulated controllers, which run the program of the driver.

use super::connection::Connection;
use super::emulated::{CommandedJoints, ControllerConfig, EmulatedController, Joints, Modes};
use super::tests::{REST_RAD, TEST_TIMEOUT, config, flange_chain, free_address};
use super::{MovableUrArm, N_JOINTS};
use crate::motion::steering_check::{TriedMotion, check_steering};
use crate::motion::{
    JointTarget, Motion, MotionConfig, MotionLimits, MovableArm, OnLoss, Output, Target,
};
use crate::{Arm, clock};
use parking_lot::Mutex;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Motions end at the target up to rounding.
const MAX_ERROR_RAD: f64 = 1e-9;
/// How long a robot waits for a setpoint of our driver, which a busy machine may stall.
const ANSWER_WAIT: Duration = Duration::from_secs(2);
/// Maximum velocity of the joints.
const MAX_RAD_S: f64 = 0.5;

fn motion_config() -> MotionConfig {
    let limits = MotionLimits {
        position: [-6.0, 6.0],
        velocity: MAX_RAD_S,
        acceleration: 2.0,
        jerk: 20.0,
    };
    MotionConfig {
        limits: vec![limits; N_JOINTS],
        on_loss: OnLoss::Hold,
        // A busy machine may stall this process. The program then brakes the arm.
        timeout: Duration::from_secs(1),
        accept_no_watchdog: false,
    }
}

/// A robot whose joints follow their commands perfectly.
fn ideal_robot(controller: ControllerConfig) -> EmulatedController {
    recorded_robot(controller, |_| ())
}

/// Like [`ideal_robot`]; also passes the commands of every cycle to `record`.
fn recorded_robot(
    controller: ControllerConfig,
    mut record: impl FnMut(&CommandedJoints) + Send + 'static,
) -> EmulatedController {
    let mut is_first = true;
    let joint_simulator = move |_, commanded: &CommandedJoints| {
        record(commanded);
        Joints {
            position_rad: if std::mem::take(&mut is_first) {
                REST_RAD
            } else {
                commanded.position_rad
            },
            velocity_rad_s: commanded.velocity_rad_s,
            ..Joints::default()
        }
    };
    let joint_simulator = Box::new(joint_simulator);
    EmulatedController::start_waiting(controller, ANSWER_WAIT, joint_simulator).unwrap()
}

fn e_series() -> EmulatedController {
    ideal_robot(ControllerConfig::e_series(free_address(), flange_chain()))
}

fn open(emulated: &EmulatedController) -> MovableUrArm {
    MovableUrArm::open(&config(emulated.address()), &motion_config()).unwrap()
}

/// The rest position with another angle of the elbow.
fn target(by_rad: f64) -> JointTarget {
    let mut position = REST_RAD.to_vec();
    position[2] += by_rad;
    JointTarget { position }
}

/// Waits for a condition of the arm or of the robot.
fn wait_until(what: &str, mut condition: impl FnMut() -> bool) {
    let deadline = Instant::now() + TEST_TIMEOUT;
    while !condition() {
        assert!(Instant::now() < deadline, "{what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn wait_for_rest(arm: &MovableUrArm) {
    wait_until("the motion ends", || arm.motion() != Motion::Moving);
    assert_eq!(arm.motion(), Motion::Holding);
}

/// Waits until the motion ends, and the robot has received its last setpoint.
fn wait_for_arrival(arm: &MovableUrArm, emulated: &EmulatedController, target: &JointTarget) {
    wait_for_rest(arm);
    wait_until("the robot arrives", || is_near(emulated, target));
}

/// The reason why an arm has stopped.
fn stop_reason(arm: &MovableUrArm) -> String {
    let mut reason = None;
    wait_until("the arm stops", || {
        if let Motion::Stopped { reason: found } = arm.motion() {
            reason = Some(found);
        }
        reason.is_some()
    });
    reason.unwrap_or_default()
}

fn is_near(emulated: &EmulatedController, target: &JointTarget) -> bool {
    std::iter::zip(emulated.commanded().position_rad, &target.position)
        .all(|(is, expected)| (is - expected).abs() < MAX_ERROR_RAD)
}

#[test]
fn targets_are_reached_within_the_limits_on_both_controllers() {
    for controller in [ControllerConfig::e_series, ControllerConfig::cb3] {
        let fastest_rad_s = Arc::new(Mutex::new(0.0_f64));
        let recorder = Arc::clone(&fastest_rad_s);
        let controller = controller(free_address(), flange_chain());
        let emulated = recorded_robot(controller, move |commanded| {
            let mut fastest = recorder.lock();
            *fastest = fastest.max(commanded.velocity_rad_s[2].abs());
        });
        let mut arm = open(&emulated);
        assert_eq!(arm.motion(), Motion::Holding);
        assert!(!emulated.commanded().is_moving, "opening moves nothing");
        let goal = target(0.3);
        assert_eq!(arm.command(&goal).unwrap(), goal);
        wait_for_arrival(&arm, &emulated, &goal);
        // A setpoint covers at most four cycles, for example if states arrive in pairs. The robot
        // waits for setpoints, and follows one per cycle.
        let max_rad_s = *fastest_rad_s.lock();
        assert!(
            max_rad_s > 0.1 && max_rad_s < 4.0 * MAX_RAD_S * (1.0 + 1e-6),
            "{max_rad_s}"
        );
        // A second target in the same motion, and one after its end.
        arm.command(&target(0.0)).unwrap();
        wait_for_arrival(&arm, &emulated, &target(0.0));
        wait_until("the program ends", || !emulated.commanded().is_moving);
        assert_eq!(arm.motion_statistics().n_motions, 1);
        arm.command(&target(-0.1)).unwrap();
        wait_for_arrival(&arm, &emulated, &target(-0.1));
        assert_eq!(arm.motion_statistics().n_motions, 2);
        drop(arm);
        wait_until("the program ends", || !emulated.commanded().is_moving);
    }
}

#[test]
fn stop_brings_the_arm_to_rest_before_its_target() {
    let emulated = e_series();
    let mut arm = open(&emulated);
    arm.command(&target(2.0)).unwrap();
    wait_until("the arm moves", || {
        emulated.commanded().velocity_rad_s[2] > 0.05
    });
    arm.stop().unwrap();
    wait_for_rest(&arm);
    // The robot receives the last setpoint one cycle later.
    wait_until("the joints rest", || {
        emulated.commanded().velocity_rad_s == [0.0; N_JOINTS]
    });
    assert!(!is_near(&emulated, &target(2.0)));
}

#[test]
fn the_program_brakes_the_arm_when_setpoints_stop() {
    let emulated = e_series();
    let mut arm = open(&emulated);
    arm.command(&target(2.0)).unwrap();
    wait_until("the arm moves", || {
        emulated.commanded().velocity_rad_s[2] > 0.05
    });
    // Without states, the driver sends no setpoints, as a computer that has stalled.
    emulated.set_silent(true);
    wait_until("the program ends", || !emulated.commanded().is_moving);
    let stopped_at = emulated.commanded();
    assert_eq!(stopped_at.velocity_rad_s, [0.0; N_JOINTS]);
    assert!(!is_near(&emulated, &target(2.0)));
    emulated.set_silent(false);
    let reason = stop_reason(&arm);
    assert!(
        reason.contains("too late") || reason.contains("no valid states"),
        "{reason}"
    );
    let refused = arm.command(&target(0.0)).unwrap_err().to_string();
    assert!(refused.contains("recovered"), "{refused}");
    assert_eq!(emulated.commanded().position_rad, stopped_at.position_rad);
}

#[test]
fn the_arm_stops_when_the_connection_is_lost() {
    let emulated = e_series();
    let mut arm = open(&emulated);
    arm.command(&target(2.0)).unwrap();
    wait_until("the arm moves", || {
        emulated.commanded().velocity_rad_s[2] > 0.05
    });
    emulated.disconnect();
    let reason = stop_reason(&arm);
    assert!(reason.contains("connection lost"), "{reason}");
    wait_until("the program ends", || !emulated.commanded().is_moving);
    assert!(!is_near(&emulated, &target(2.0)));
    let error = arm.recover().unwrap_err().to_string();
    assert!(error.contains("connection lost"), "{error}");
    drop(arm);
    // A new connection may move the arm again.
    let mut arm = open(&emulated);
    let here = JointTarget {
        position: emulated.commanded().position_rad.to_vec(),
    };
    arm.command(&here).unwrap();
    wait_for_rest(&arm);
}

#[test]
fn protective_stop_lasts_until_the_recovery() {
    let emulated = e_series();
    let mut arm = open(&emulated);
    arm.command(&target(2.0)).unwrap();
    wait_until("the arm moves", || {
        emulated.commanded().velocity_rad_s[2] > 0.05
    });
    let protective_stop = Modes {
        safety_mode: 3,
        is_unlock_refused: true,
        ..Modes::default()
    };
    emulated.set_modes(protective_stop);
    let reason = stop_reason(&arm);
    assert!(reason.contains("protective stop"), "{reason}");
    let refused = arm.command(&target(0.0)).unwrap_err().to_string();
    assert!(refused.contains("recovered"), "{refused}");
    let too_early = arm.recover().unwrap_err().to_string();
    assert!(too_early.contains("until 5s"), "{too_early}");
    emulated.set_modes(Modes {
        is_unlock_refused: false,
        ..protective_stop
    });
    wait_until("the stop can be ended", || arm.recover().is_ok());
    assert_eq!(arm.motion(), Motion::Holding);
    assert!(
        !emulated.commanded().is_moving,
        "the old program does not continue"
    );
    arm.command(&target(0.0)).unwrap();
    wait_for_arrival(&arm, &emulated, &target(0.0));
}

#[test]
fn a_robot_that_is_not_ready_is_reported_before_anything_moves() {
    let emulated = e_series();
    let mut arm = open(&emulated);
    let ready = Modes::default();
    for (modes, expected) in [
        (
            Modes {
                is_remote: false,
                ..ready
            },
            "local control",
        ),
        (
            Modes {
                is_teach_button_pressed: true,
                ..ready
            },
            "freedrive button",
        ),
        (
            Modes {
                robot_mode: 6,
                ..ready
            },
            "guided by hand",
        ),
        (
            Modes {
                robot_mode: 5,
                ..ready
            },
            "brakes",
        ),
    ] {
        emulated.set_modes(modes);
        let mut message = String::new();
        // The state with the new mode arrives some milliseconds later. Until then, the arm may
        // accept the target, which is its position.
        wait_until("the arm refuses", || {
            if let Err(error) = arm.command(&target(0.0)) {
                message = error.to_string();
            }
            message.contains(expected)
        });
        assert!(is_near(&emulated, &target(0.0)), "{message}");
        emulated.set_modes(ready);
        wait_until("the arm moves again", || {
            arm.recover().is_ok() && arm.command(&target(0.0)).is_ok()
        });
        wait_for_rest(&arm);
        wait_until("the program ends", || !emulated.commanded().is_moving);
    }
    // A safety stop stays until a person recovers the arm.
    emulated.set_modes(Modes {
        safety_mode: 5,
        ..ready
    });
    let reason = stop_reason(&arm);
    assert!(reason.contains("safeguard"), "{reason}");
    let blocked = arm.recover().unwrap_err().to_string();
    assert!(blocked.contains("safeguard"), "{blocked}");
    emulated.set_modes(ready);
    wait_until("the arm is ready", || arm.recover().is_ok());
    assert_eq!(arm.motion(), Motion::Holding);
}

#[test]
fn a_program_that_is_stopped_at_the_pendant_stops_the_arm() {
    let emulated = e_series();
    let mut arm = open(&emulated);
    arm.command(&target(2.0)).unwrap();
    wait_until("the arm moves", || {
        emulated.commanded().velocity_rad_s[2] > 0.05
    });
    // The stop button of the pendant has the same effect as this command.
    let mut address = emulated.address();
    address.set_port(29999);
    let mut dashboard = TcpStream::connect(address).unwrap();
    dashboard.write_all(b"stop\n").unwrap();
    let mut answers = Vec::new();
    while !answers.ends_with(b"Stopped\n") {
        let mut byte = [0];
        dashboard.read_exact(&mut byte).unwrap();
        answers.push(byte[0]);
    }
    let reason = stop_reason(&arm);
    assert!(reason.contains("program was stopped"), "{reason}");
    arm.recover().unwrap();
}

#[test]
fn a_program_of_another_client_is_not_replaced() {
    let emulated = e_series();
    let mut arm = open(&emulated);
    let mut address = emulated.address();
    address.set_port(30002);
    let mut other = TcpStream::connect(address).unwrap();
    other
        .write_all(b"def other():\n  while True:\n    sync()\n  end\nend\n")
        .unwrap();
    // Until the state with the program arrives, the arm would replace it.
    wait_until("the arm sees the program", || {
        arm.blocking_reason().is_some()
    });
    let error = arm.command(&target(0.0)).unwrap_err().to_string();
    assert!(error.contains("another program runs"), "{error}");
    wait_until("the other program still runs", || {
        emulated.commanded().is_moving
    });
}

#[test]
fn second_client_cannot_take_the_registers() {
    let emulated = e_series();
    let _arm = open(&emulated);
    let address = emulated.address().to_string();
    let error = Connection::open(&address, true).unwrap_err();
    assert!(
        error.contains("another program") && error.contains("input_double_register_24"),
        "{error}"
    );
    Connection::open(&address, false).expect("reading needs no registers");
    let second = MovableUrArm::open(&config(emulated.address()), &motion_config());
    let error = second.unwrap_err().to_string();
    assert!(error.contains("end it first"), "{error}");
}

#[test]
fn unsupported_settings_and_targets_are_rejected() {
    let with = |change: fn(&mut MotionConfig)| {
        let mut motion = motion_config();
        change(&mut motion);
        MovableUrArm::check(&motion)
    };
    assert_eq!(with(|_| {}), Ok(()));
    let release = with(|motion| motion.on_loss = OnLoss::Release).unwrap_err();
    assert!(release.contains("hold"), "{release}");
    let short = with(|motion| motion.timeout = Duration::from_millis(20)).unwrap_err();
    assert!(short.contains("timeout_millis"), "{short}");
    let emulated = e_series();
    let mut arm = open(&emulated);
    assert_eq!(arm.joint_names().len(), N_JOINTS);
    for position in [vec![0.0; 5], vec![f64::NAN; 6]] {
        assert!(arm.command(&JointTarget { position }).is_err());
    }
    assert!(!emulated.commanded().is_moving);
}

const TRIED: TriedMotion = TriedMotion {
    joint_ix: 2,
    distance: 1.0,
    until: 0.05,
    // A busy computer stops this arm with any of several reasons.
    busy: Some(""),
};

#[test]
fn steered_arm_brakes_when_its_targets_expire() {
    for controller in [ControllerConfig::e_series, ControllerConfig::cb3] {
        let emulated = ideal_robot(controller(free_address(), flange_chain()));
        let mut arm = open(&emulated);
        check_steering(&mut arm, TRIED);
        wait_until("the program ends", || !emulated.commanded().is_moving);
        let n_motions = arm.motion_statistics().n_motions;
        // A new target starts the program.
        check_steering(&mut arm, TRIED);
        assert!(arm.motion_statistics().n_motions > n_motions);
        drop(arm);
        wait_until("the program ends", || !emulated.commanded().is_moving);
    }
}

#[test]
fn steered_arm_that_cannot_start_reports_why_and_is_recovered() {
    let emulated = e_series();
    emulated.set_modes(Modes {
        is_remote: false,
        ..Modes::default()
    });
    let mut arm = open(&emulated);
    let port = arm.steering_port(2.0).unwrap();
    wait_until("a report", || port.state().is_some());
    let mut serial = 0;
    let mut reason = None;
    wait_until("the arm reports why", || {
        serial += 1;
        port.send(&Output::Follow(Target {
            motion: 1,
            serial,
            position: target(0.5).position,
            expires_at: clock::now() + TEST_TIMEOUT,
        }));
        reason = port.state().and_then(|state| state.stopped);
        reason.is_some()
    });
    let reason = reason.unwrap_or_default();
    assert!(reason.contains("local control"), "{reason}");
    assert!(!emulated.commanded().is_moving);
    emulated.set_modes(Modes::default());
    port.recover().unwrap();
    // The targets from before the recovery do not start a motion.
    let recovered_at = clock::now();
    wait_until("a report", || {
        port.state()
            .is_some_and(|state| state.reported_at > recovered_at && state.stopped.is_none())
    });
    assert!(is_near(&emulated, &target(0.0)));
    check_steering(&mut arm, TRIED);
}
