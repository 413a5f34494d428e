//! Guards of a moving arm, inside the virtual kernel: an obstacle, a second program, a panic of the
//! arm's thread, a second Ctrl-C, and a closed terminal. The tests of the obstacle, the panic,
//! Ctrl-C and the closed output repeat the fault `FIELDRIG_TRIALS` times, 3 by default, at
//! different times of the motion.

use crate::can::{Wire, all_families, damiao};
use crate::can_motion::{
    MotorObservation, Motors, motors_with_watchdog, movable, wait_until_stopped,
};
use capture::config::Rig;
use drivers::can::emulated::{EmulatedProtocol, State};
use drivers::can::{
    MotionProtocol, MotorConfig, MotorFamily, MotorProtocol, MotorQuery, MotorReading,
    MotorSettings, MovableCanArm, Reports, Traffic, Watchdog,
};
use drivers::motion::{JointTarget, MovableArm, OnLoss};
use drivers::wire::can::Frame;
use drivers::wire::can::mit::Limits;
use drivers::{Error, clock};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Largest time from a fault to the fail-safe command: a few cycles of 5 ms.
const MAX_REACTION: Duration = Duration::from_millis(40);

fn n_trials() -> u64 {
    std::env::var("FIELDRIG_TRIALS")
        .ok()
        .and_then(|n| n.parse().ok())
        .unwrap_or(3)
}

fn is_moving(observed: &[MotorObservation]) -> bool {
    observed
        .iter()
        .all(|observed| observed.state == State::Enabled && observed.velocity_rad_s.abs() > 0.1)
}

/// Waits for a time that differs between trials.
fn wait_for_trial(trial: u64) {
    std::thread::sleep(Duration::from_millis(37 * trial % 400));
}

#[test]
#[ignore = "needs the virtual kernel"]
fn obstacle_stops_the_arm() {
    let wire = Wire::new("vcan14", false);
    let mut configs = motors_with_watchdog();
    configs
        .iter_mut()
        .for_each(|config| config.following.max_error_rad = 0.1);
    let motors = Motors::new(wire.config(false), configs.clone(), false);
    let config = movable(wire.config(false), &configs, OnLoss::Release);
    let mut arm = MovableCanArm::open(&config).expect("the motors are enabled");
    for trial in 0..n_trials() {
        let side = if motors.positions()[0] > 0.0 {
            -1.5
        } else {
            1.5
        };
        arm.command(&JointTarget {
            position: vec![side; configs.len()],
        })
        .expect("within the limits");
        motors.wait_until("the arm moves", is_moving);
        wait_for_trial(trial);
        motors.is_blocked.store(true, Ordering::Relaxed);
        let reason = wait_until_stopped(&arm);
        assert!(
            reason.contains("from its commanded position")
                && reason.contains("max_following_error_rad is 0.1"),
            "{reason}"
        );
        motors.wait_until("no motor pushes", |observed| {
            observed
                .iter()
                .all(|observed| observed.state != State::Enabled)
        });
        motors.is_blocked.store(false, Ordering::Relaxed);
        // Released motors coast to rest.
        motors.wait_until("the motors are at rest", |observed| {
            observed
                .iter()
                .all(|observed| observed.velocity_rad_s.abs() < 0.01)
        });
        arm.recover().expect("the motors answer");
    }
    drop(arm);

    // At 30 N m / rad, the effort reaches 1.5 N m at an error of 0.05 rad.
    let limited = |config: &MotorConfig| {
        let mut config = config.clone();
        config.following.max_effort_nm = Some(1.5);
        config.following.max_error_rad = 9.0;
        config
    };
    let configs = [limited(&damiao(1))];
    let mut arm = MovableCanArm::open(&movable(wire.config(false), &configs, OnLoss::Release))
        .expect("the motor is enabled");
    arm.command(&JointTarget {
        position: vec![1.0],
    })
    .expect("within the limits");
    std::thread::sleep(Duration::from_millis(600));
    motors.is_blocked.store(true, Ordering::Relaxed);
    let reason = wait_until_stopped(&arm);
    assert!(
        reason.contains("its effort is") && reason.contains("max_effort_nm is 1.5"),
        "{reason}"
    );
    println!("guards: {reason}");
}

#[test]
#[ignore = "needs the virtual kernel"]
fn second_program_cannot_move_the_arm() {
    let wire = Wire::new("vcan14", false);
    let rig = rig_without_watchdogs();
    let (motors, mut moving) = moving_arm(&wire, &rig);
    let second = Command::new("/bin/fieldrig")
        .arg("move")
        .arg(&rig)
        .args(["--recover", "--enable-motion"])
        .output();
    let second = second.expect("fieldrig is installed");
    let printed = String::from_utf8_lossy(&second.stderr);
    let expected = format!(
        "another program (process {}) moves the arm on vcan14",
        moving.id()
    );
    assert!(
        second.status.code() == Some(1) && printed.contains(&expected),
        "{printed}"
    );
    assert_eq!(
        motors.states(),
        [State::Enabled; 2],
        "the arm is not disturbed"
    );
    moving.kill().expect("our own child");
    moving.wait().expect("our own child");
    // The kernel has released the lock. An arm that is only read needs no lock.
    let config = movable(
        wire.config(false),
        &Rig::load(&rig, &[]).expect("a rig file").arm.motors,
        OnLoss::Damp,
    );
    drop(MovableCanArm::open(&config).expect("the bus is free"));
}

#[test]
#[ignore = "needs the virtual kernel"]
fn panic_of_the_arm_thread_applies_the_fail_safe() {
    let wire = Wire::new("vcan14", false);
    // Motors without a watchdog would execute their last command forever.
    let ak = all_families().pop().expect("the last one is an AK motor");
    for trial in 0..n_trials() {
        let motors = Motors::new(wire.config(false), vec![ak.clone()], false);
        let fails = Arc::new(AtomicBool::new(false));
        let protocol = Arc::new(Failing {
            protocol: Arc::clone(&ak.protocol),
            fails: Arc::clone(&fails),
        });
        let config = movable(
            wire.config(false),
            &[MotorConfig {
                protocol,
                ..ak.clone()
            }],
            OnLoss::Damp,
        );
        let mut arm = MovableCanArm::open(&config).expect("the motor answers");
        arm.command(&JointTarget {
            position: vec![1.5],
        })
        .expect("within the limits");
        motors.wait_until("the arm moves", is_moving);
        wait_for_trial(trial);
        fails.store(true, Ordering::Relaxed);
        let failed_at = clock::now();
        motors.wait_until("the motor gets its fail-safe command", is_damped);
        assert!(clock::now().duration_since(failed_at) < MAX_REACTION);
        assert!(wait_until_stopped(&arm).contains("the thread of the arm failed"));
        assert!(
            arm.command(&JointTarget {
                position: vec![0.0]
            })
            .is_err()
        );
    }
}

#[test]
#[ignore = "needs the virtual kernel"]
fn second_ctrl_c_applies_the_fail_safe() {
    let wire = Wire::new("vcan14", false);
    let rig = rig_without_watchdogs();
    for trial in 0..n_trials() {
        let (motors, mut moving) = moving_arm(&wire, &rig);
        wait_for_trial(trial);
        // The first Ctrl-C brings the arm to rest, which takes seconds at the acceleration of this
        // rig.
        interrupt(&moving);
        std::thread::sleep(Duration::from_millis(100));
        interrupt(&moving); // This signal belongs to the same key press, which was sent twice.
        std::thread::sleep(Duration::from_millis(500));
        assert!(
            motors.observed()[0].velocity_rad_s.abs() > 0.02 && !is_damped(&motors.observed()),
            "it still brakes"
        );
        interrupt(&moving);
        let interrupted_at = clock::now();
        motors.wait_until("the motors get their fail-safe command", is_damped);
        assert!(clock::now().duration_since(interrupted_at) < MAX_REACTION);
        assert_eq!(moving.wait().expect("our own child").code(), Some(130));
    }
}

#[test]
#[ignore = "needs the virtual kernel"]
fn closed_output_stops_the_motion() {
    let wire = Wire::new("vcan14", false);
    let rig = rig_without_watchdogs();
    for trial in 0..n_trials() {
        let (motors, mut moving) = moving_arm(&wire, &rig);
        wait_for_trial(trial);
        if trial % 2 == 0 {
            drop(moving.stdout.take());
        } else {
            drop(moving.stderr.take());
        }
        assert_eq!(moving.wait().expect("our own child").code(), Some(1));
        let end = motors.observed()[0].clone();
        assert!(
            end.position_rad < 2.0 && end.velocity_rad_s.abs() < 0.05,
            "expected a stop before the target: {end:?}"
        );
        assert!(
            is_damped(&motors.observed()),
            "the arm came to rest, then on_loss was applied"
        );
    }
}

/// Whether all motors execute a command without stiffness, as after the fail-safe command `damp`.
fn is_damped(observed: &[MotorObservation]) -> bool {
    observed.iter().all(|observed| {
        observed.state == State::Enabled && observed.gains[0] == 0.0 && observed.gains[1] > 0.0
    })
}

/// A rig file with two motors without a watchdog. The arm takes seconds to come to rest.
fn rig_without_watchdogs() -> PathBuf {
    let cameras = fs::read_to_string("/rigs/vivid-can.toml").expect("the rig file of the tests");
    let (_, cameras) = cameras.split_once("[camera.wrist]").expect("its camera");
    let motor = |joint: &str, id: u32| {
        format!(
            "[arm.motor.{joint}]\nfamily = \"tmotor\"\nbus = \"vcan14\"\nid = {id}\nmodel = \"ak80-9\"\nstiffness_nm_rad = 30.0\ndamping_nm_s_rad = 1.5\n"
        )
    };
    let text = format!(
        "[arm]\ndriver = \"can\"\nurdf = \"/rigs/two.urdf\"\nflange_link = \"tool\"\nrate_hz = 200\nmax_speed_rad_s = 0.5\n\
         [arm.bus.vcan14]\nbitrate_hz = 1000000\n{}{}\
         [arm.motion]\non_loss = \"damp\"\naccept_no_watchdog = true\ntimeout_millis = 250\nacceleration_secs = 4.0\n\
         [camera.wrist]{cameras}",
        motor("joint1", 6),
        motor("joint2", 7)
    );
    let path = Path::new("/tmp/no-watchdog.toml");
    fs::write(path, text).expect("/tmp is writable");
    path.to_owned()
}

/// Starts the motors of a rig and a motion of the first joint that takes several seconds, and waits
/// until it moves.
fn moving_arm(wire: &Wire, rig: &Path) -> (Motors, Child) {
    let motors = Motors::new(
        wire.config(false),
        Rig::load(rig, &[]).expect("a rig file").arm.motors,
        false,
    );
    let moving = Command::new("/bin/fieldrig")
        .arg("move")
        .arg(rig)
        .args(["--by", "joint1=2.5", "--enable-motion"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("fieldrig is installed");
    motors.wait_until("the arm moves", |observed| {
        observed[0].velocity_rad_s.abs() > 0.1
    });
    (motors, moving)
}

fn interrupt(child: &Child) {
    crate::can_motion::signal(child, "-INT");
}

/// A motor whose driver panics on request.
#[derive(Debug)]
struct Failing {
    protocol: Arc<dyn MotorProtocol>,
    fails: Arc<AtomicBool>,
}

impl MotorProtocol for Failing {
    fn read(&self, frame: &Frame, limits: &Limits) -> Option<MotorReading> {
        assert!(
            !self.fails.swap(false, Ordering::Relaxed),
            "requested by the test"
        );
        self.protocol.read(frame, limits)
    }

    fn family(&self) -> &'static dyn MotorFamily {
        self.protocol.family()
    }

    fn settings(&self) -> MotorSettings {
        self.protocol.settings()
    }

    fn addresses(&self) -> Vec<u32> {
        self.protocol.addresses()
    }

    fn ranges(&self) -> Option<Limits> {
        self.protocol.ranges()
    }

    fn set_up(&self, query: &MotorQuery<'_>) -> Result<Limits, Error> {
        self.protocol.set_up(query)
    }

    fn reports(&self) -> Reports {
        self.protocol.reports()
    }

    fn typical_answer(&self) -> (Frame, Option<f64>) {
        self.protocol.typical_answer()
    }

    fn traffic(&self) -> Traffic {
        self.protocol.traffic()
    }

    fn watchdog(&self) -> Watchdog {
        self.protocol.watchdog()
    }

    fn motion(&self, limits: &Limits) -> Box<dyn MotionProtocol> {
        self.protocol.motion(limits)
    }

    fn emulated(&self) -> Box<dyn EmulatedProtocol> {
        self.protocol.emulated()
    }
}
