//! An arm that is blocked, sags or loses its connection while it moves.
#![cfg(feature = "sim")]

use capture::config::Rig;
use capture::open::{self, Devices};
use capture::{ArmCapture, Stop};
use drivers::motion::{JointTarget, Motion, MovableArm};
use drivers::{Arm, Error};
use kinematics::JointState;
use parking_lot::Mutex;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

const JOINT: usize = 3;

/// What happens to a joint of a simulated arm.
#[derive(Clone, Copy)]
enum Fault {
    /// An obstacle at this distance from the start.
    BlockedAt(f64),
    /// The obstacle pushes the joint back while the arm returns.
    StuckAt(f64),
    /// A load, which lowers it by this much.
    Sags(f64),
    /// The arm reports nothing after it was commanded.
    Silent,
}

#[derive(Default)]
struct Log {
    targets: Vec<f64>,
    n_stops: usize,
    start: f64,
}

/// The simulated arm with a fault.
struct FaultyArm {
    arm: Box<dyn MovableArm>,
    fault: Fault,
    log: Arc<Mutex<Log>>,
}

impl Arm for FaultyArm {
    fn joint_names(&self) -> &[String] {
        self.arm.joint_names()
    }

    fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
        let mut state = self.arm.read(timeout)?;
        let log = self.log.lock();
        let position = &mut state.position[JOINT];
        match self.fault {
            Fault::BlockedAt(distance) => *position = position.min(log.start + distance),
            Fault::StuckAt(distance) if *position > log.start + distance || log.targets.len() > 1 => {
                *position = log.start + distance;
            }
            Fault::Sags(load) => *position -= load,
            Fault::Silent if !log.targets.is_empty() => return Err(Error::NoJoints { waited: timeout }),
            Fault::StuckAt(_) | Fault::Silent => {}
        }
        Ok(state)
    }
}

impl MovableArm for FaultyArm {
    fn command(&mut self, target: &JointTarget) -> Result<JointTarget, Error> {
        self.log.lock().targets.push(target.position[JOINT]);
        self.arm.command(target)
    }

    fn motion(&self) -> Motion {
        self.arm.motion()
    }

    fn stop(&mut self) -> Result<(), Error> {
        self.log.lock().n_stops += 1;
        self.arm.stop()
    }

    fn recover(&mut self) -> Result<(), Error> {
        self.arm.recover()
    }
}

/// The simulated rig with a fault, and the joints at its start.
fn faulty(fault: Fault) -> (ArmCapture, Vec<f64>, Arc<Mutex<Log>>) {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/calibration-board.toml");
    let rig = Rig::load(&file, &[]).expect("a bundled rig file");
    let mut movable = open::movable(&rig, Devices::Sim, "wrist").expect("a simulated rig");
    let position = movable.arm.read(Duration::from_secs(1)).expect("a state").position;
    let log = Arc::new(Mutex::new(Log { start: position[JOINT], ..Log::default() }));
    movable.arm = Box::new(FaultyArm { arm: movable.arm, fault, log: log.clone() });
    let mut capture = ArmCapture::new(movable).expect("a robot description");
    let start = capture.joints().expect("a state");
    (capture, start, log)
}

fn rotated(start: &[f64], angle: f64) -> Vec<f64> {
    let mut joints = start.to_vec();
    joints[JOINT] += angle;
    joints
}

#[test]
fn blocked_arm_returns_to_the_previous_step() {
    let (mut capture, start, log) = faulty(Fault::BlockedAt(0.25));
    let error = capture.move_to(&rotated(&start, 0.6), &Stop::default()).expect_err("the joint is blocked").to_string();
    assert!(error.contains("check for an obstacle") && error.contains("has returned to the previous step"), "{error}");
    let log = log.lock();
    // Two steps were commanded; the second was blocked.
    let [first, second, back] = log.targets[..] else { panic!("{:?}", log.targets) };
    assert!((first - start[JOINT] - 0.2).abs() < 0.01 && (second - first - 0.2).abs() < 0.01, "{:?}", log.targets);
    assert!((back - first).abs() < 0.01, "{:?}", log.targets);
}

#[test]
fn stuck_arm_is_commanded_to_where_it_is() {
    let (mut capture, start, log) = faulty(Fault::StuckAt(0.11));
    let error = capture.move_to(&rotated(&start, 0.24), &Stop::default()).expect_err("the joint is stuck").to_string();
    assert!(error.contains("check for an obstacle") && error.contains("holds where it is"), "{error}");
    let last = *log.lock().targets.last().expect("a target");
    assert!((last - start[JOINT] - 0.11).abs() < 0.01, "{last} from {}", start[JOINT]);
}

#[test]
fn sag_is_corrected_in_the_next_step() {
    const LOAD: f64 = 0.03;
    let (mut capture, _, log) = faulty(Fault::Sags(LOAD));
    let loaded = log.lock().start - LOAD;
    let mut goal = capture.joints().expect("a state");
    assert!((goal[JOINT] - loaded).abs() < 1e-3);
    for angle in [0.1, 0.1] {
        goal[JOINT] += angle;
        assert!(capture.move_to(&goal, &Stop::default()).expect("nothing blocks it"));
        let reached = capture.joints().expect("a state")[JOINT];
        let error = (reached - goal[JOINT]).abs();
        // The load is known after the first motion.
        let is_first = log.lock().targets.len() == 1;
        assert!(if is_first { error > 0.02 } else { error < 2e-3 }, "off by {error}");
    }
}

#[test]
fn arm_that_leaves_its_limit_is_returned() {
    let (mut capture, start, log) = faulty(Fault::Sags(0.0));
    capture.limit_distance(0.02).expect("a state");
    let error = capture.move_to(&rotated(&start, 0.6), &Stop::default()).expect_err("it is too far").to_string();
    assert!(error.contains("mm from its start (at most 20 mm)"), "{error}");
    assert!(error.contains("has returned to the previous step"), "{error}");
    assert_eq!(log.lock().targets.len(), 2, "one step and back");
}

#[test]
fn arm_that_reports_nothing_is_stopped() {
    let (mut capture, start, log) = faulty(Fault::Silent);
    let error = capture.move_to(&rotated(&start, 0.2), &Stop::default()).expect_err("it is silent");
    assert!(format!("{error:#}").contains("no joint"), "{error:#}");
    assert_eq!(log.lock().n_stops, 1);
}
