//! An arm that is blocked, sags or loses its connection while it moves, and a driver on an emulated
//! controller.
#![cfg(feature = "sim")]

use capture::config::{Override, Rig};
use capture::open::{self, Devices};
use capture::{ArmCapture, Stop};
use drivers::motion::{JointTarget, Motion, MovableArm, SteeringPort};
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
            Fault::StuckAt(distance)
                if *position > log.start + distance || log.targets.len() > 1 =>
            {
                *position = log.start + distance;
            }
            Fault::Sags(load) => *position -= load,
            Fault::Silent if !log.targets.is_empty() => {
                return Err(Error::NoJoints { waited: timeout });
            }
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

    fn steering_port(&mut self, brake_factor: f64) -> Result<SteeringPort, Error> {
        self.arm.steering_port(brake_factor)
    }
}

/// The simulated rig with a fault, and the joints at its start.
fn faulty(fault: Fault) -> (ArmCapture, Vec<f64>, Arc<Mutex<Log>>) {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/calibration-board.toml");
    let rig = Rig::load(&file, &[]).expect("a bundled rig file");
    let mut movable = open::movable(&rig, Devices::Sim, "wrist").expect("a simulated rig");
    let position = movable
        .arm
        .read(Duration::from_secs(1))
        .expect("a state")
        .position;
    let log = Arc::new(Mutex::new(Log {
        start: position[JOINT],
        ..Log::default()
    }));
    movable.arm = Box::new(FaultyArm {
        arm: movable.arm,
        fault,
        log: log.clone(),
    });
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
    let error = capture
        .move_to(&rotated(&start, 0.6), &Stop::default())
        .expect_err("the joint is blocked")
        .to_string();
    assert!(
        error.contains("check for an obstacle")
            && error.contains("has returned to the previous step"),
        "{error}"
    );
    let log = log.lock();
    // Two steps were commanded; the second was blocked.
    let [first, second, back] = log.targets[..] else {
        panic!("{:?}", log.targets)
    };
    assert!(
        (first - start[JOINT] - 0.2).abs() < 0.01 && (second - first - 0.2).abs() < 0.01,
        "{:?}",
        log.targets
    );
    assert!((back - first).abs() < 0.01, "{:?}", log.targets);
}

#[test]
fn stuck_arm_is_commanded_to_where_it_is() {
    let (mut capture, start, log) = faulty(Fault::StuckAt(0.11));
    let error = capture
        .move_to(&rotated(&start, 0.24), &Stop::default())
        .expect_err("the joint is stuck")
        .to_string();
    assert!(
        error.contains("check for an obstacle") && error.contains("holds where it is"),
        "{error}"
    );
    let last = *log.lock().targets.last().expect("a target");
    assert!(
        (last - start[JOINT] - 0.11).abs() < 0.01,
        "{last} from {}",
        start[JOINT]
    );
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
        assert!(
            capture
                .move_to(&goal, &Stop::default())
                .expect("nothing blocks it")
        );
        let reached = capture.joints().expect("a state")[JOINT];
        let error = (reached - goal[JOINT]).abs();
        // The load is known after the first motion.
        let is_first = log.lock().targets.len() == 1;
        assert!(
            if is_first { error > 0.02 } else { error < 2e-3 },
            "off by {error}"
        );
    }
}

#[test]
fn arm_that_leaves_its_limit_is_returned() {
    let (mut capture, start, log) = faulty(Fault::Sags(0.0));
    capture.limit_distance(0.02).expect("a state");
    let error = capture
        .move_to(&rotated(&start, 0.6), &Stop::default())
        .expect_err("it is too far")
        .to_string();
    assert!(
        error.contains("mm from its start (at most 20 mm)"),
        "{error}"
    );
    assert!(
        error.contains("has returned to the previous step"),
        "{error}"
    );
    assert_eq!(log.lock().targets.len(), 2, "one step and back");
}

#[test]
fn arm_that_reports_nothing_is_stopped() {
    let (mut capture, start, log) = faulty(Fault::Silent);
    let error = capture
        .move_to(&rotated(&start, 0.2), &Stop::default())
        .expect_err("it is silent");
    assert!(format!("{error:#}").contains("no joint"), "{error:#}");
    assert_eq!(log.lock().n_stops, 1);
}

/// The production driver of a Franka arm, connected to an emulated controller whose motors move the
/// simulated arm and its camera in real time.
#[cfg(target_os = "linux")]
mod emulated_controller {
    use super::{
        Arm, ArmCapture, Devices, Error, JOINT, JointState, JointTarget, Motion, MovableArm,
        Override, Path, Rig, SteeringPort, Stop, open, rotated,
    };
    use std::time::{Duration, Instant};

    /// The emulated controller stops the arm if the computer is too busy to answer in time, as a
    /// real one does.
    const BUSY: &str = "communication_constraints_violation";
    const MAX_ATTEMPTS: usize = 3;

    /// An arm that requests a stop once its joint has moved by this much. The stop depends on the
    /// position, because a time would depend on the load of the computer.
    struct StoppedOnTheWay {
        arm: Box<dyn MovableArm>,
        after_rad: f64,
        start_rad: Option<f64>,
        stop: Stop,
    }

    impl Arm for StoppedOnTheWay {
        fn joint_names(&self) -> &[String] {
            self.arm.joint_names()
        }

        fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
            let state = self.arm.read(timeout)?;
            let position = state.position[JOINT];
            if (position - *self.start_rad.get_or_insert(position)).abs() > self.after_rad {
                self.stop.request();
            }
            Ok(state)
        }
    }

    impl MovableArm for StoppedOnTheWay {
        fn command(&mut self, target: &JointTarget) -> Result<JointTarget, Error> {
            self.arm.command(target)
        }

        fn motion(&self) -> Motion {
            self.arm.motion()
        }

        fn stop(&mut self) -> Result<(), Error> {
            self.arm.stop()
        }

        fn recover(&mut self) -> Result<(), Error> {
            self.arm.recover()
        }

        fn steering_port(&mut self, brake_factor: f64) -> Result<SteeringPort, Error> {
            self.arm.steering_port(brake_factor)
        }
    }

    fn connected(rate_hz: f64) -> anyhow::Result<(ArmCapture, Vec<f64>)> {
        connected_as(rate_hz, |arm| arm)
    }

    fn connected_as(
        rate_hz: f64,
        wrap: impl FnOnce(Box<dyn MovableArm>) -> Box<dyn MovableArm>,
    ) -> anyhow::Result<(ArmCapture, Vec<f64>)> {
        let overrides = [
            Override::new("arm.driver", "franka"),
            Override::new("arm.motion.on_loss", "hold"),
            Override::new("camera.wrist.rate_hz", rate_hz),
            Override::new("sim.emulate_arm", true),
        ];
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/calibration-board.toml");
        let rig = Rig::load(&file, &overrides).expect("a bundled rig file");
        let mut movable = open::movable(&rig, Devices::Sim, "wrist")?;
        movable.arm = wrap(movable.arm);
        let mut capture = ArmCapture::new(movable)?;
        let start = capture.joints()?;
        Ok((capture, start))
    }

    /// Repeats a test that fails because the computer is busy.
    fn unless_busy(test: impl Fn() -> anyhow::Result<()>) {
        for attempt in 1..=MAX_ATTEMPTS {
            match test() {
                Ok(()) => return,
                Err(error) => {
                    let is_busy = format!("{error:#}").contains(BUSY);
                    assert!(
                        is_busy && attempt < MAX_ATTEMPTS,
                        "attempt {attempt}: {error:#}"
                    );
                }
            }
        }
    }

    /// The largest difference between two positions.
    fn distance(a: &[f64], b: &[f64]) -> f64 {
        a.iter()
            .zip(b)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f64::max)
    }

    /// The joints after the states that have arrived, and how far they move within half a second.
    fn joints_and_drift(capture: &mut ArmCapture) -> anyhow::Result<(Vec<f64>, f64)> {
        let settled = Instant::now() + Duration::from_millis(200);
        let mut joints = capture.joints()?;
        while Instant::now() < settled {
            joints = capture.joints()?;
        }
        let (end, mut drift) = (Instant::now() + Duration::from_millis(500), 0.0f64);
        while Instant::now() < end {
            drift = drift.max(distance(&capture.joints()?, &joints));
        }
        Ok((joints, drift))
    }

    fn requested_after(secs: f64) -> Stop {
        let stop = Stop::default();
        let later = stop.clone();
        std::thread::spawn(move || {
            std::thread::sleep(Duration::from_secs_f64(secs));
            later.request();
        });
        stop
    }

    #[test]
    fn poses_are_visited_and_photographed_at_rest() {
        unless_busy(|| {
            let (mut capture, start) = connected(2.0)?;
            let mut last = None;
            for angle in [0.0, 0.15, -0.2] {
                let goal = rotated(&start, angle);
                assert!(capture.move_to(&goal, &Stop::default())?);
                let image = capture
                    .image(&Stop::default())?
                    .expect("no stop was requested");
                let arm = image.arm.as_ref().expect("the arm is known");
                assert!(
                    distance(&arm.joints, &goal) < 1e-3,
                    "{:?}, commanded {goal:?}",
                    arm.joints
                );
                let shows_motion = last
                    .replace(image.gray.clone())
                    .is_none_or(|last| last != image.gray);
                assert!(shows_motion, "the camera moves with the motors");
            }
            Ok(())
        });
    }

    #[test]
    fn stop_while_waiting_for_an_image_leaves_the_arm_holding() {
        unless_busy(|| {
            // The next image is a minute away.
            let (mut capture, start) = connected(0.01)?;
            let goal = rotated(&start, 0.15);
            assert!(capture.move_to(&goal, &Stop::default())?);
            assert!(
                capture.image(&requested_after(1.0))?.is_none(),
                "it waits until the stop"
            );
            let (held, drift) = joints_and_drift(&mut capture)?;
            assert!(
                distance(&held, &goal) < 1e-3 && drift < 1e-4,
                "{held:?} drifts by {drift}, commanded {goal:?}"
            );
            // It has not stopped because of a fault.
            assert!(capture.move_to(&start, &Stop::default())?);
            Ok(())
        });
    }

    #[test]
    fn stop_during_a_motion_brings_the_arm_to_rest() {
        unless_busy(|| {
            let stop = Stop::default();
            let on_the_way = stop.clone();
            let (mut capture, start) = connected_as(2.0, |arm| {
                Box::new(StoppedOnTheWay {
                    arm,
                    after_rad: 0.1,
                    start_rad: None,
                    stop: on_the_way,
                })
            })?;
            // Three steps. If this thread is not scheduled for long, the arm completes the first
            // one.
            let goal = rotated(&start, 0.6);
            assert!(
                !capture.move_to(&goal, &stop)?,
                "the stop was requested on the way"
            );
            let (rest, drift) = joints_and_drift(&mut capture)?;
            assert!(drift < 1e-4, "{drift}");
            assert!(
                distance(&rest, &start) > 0.05 && distance(&rest, &goal) > 0.3,
                "{rest:?}, started at {start:?}"
            );
            Ok(())
        });
    }
}
