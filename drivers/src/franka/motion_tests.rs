//! Tests of the movable arm over loopback sockets, against emulated robots that enforce their
//! limits.

use super::emulated::{
    CommandedJoints, EmulatedRobot, JointSimulator, Joints, Limits, RobotConfig,
};
use super::test_pace::Pace;
use super::tests::{
    FREE_PORT, REST_RAD, TEST_TIMEOUT, VERSIONS, chain, config, ideal_joints, robot, waiting_robot,
};
use super::{ContactConfig, FciVersion, MovableFrankaArm, N_JOINTS};
use crate::motion::steering_check::{TriedMotion, check_steering};
use crate::motion::{JointTarget, Motion, MotionConfig, MotionLimits, MovableArm, OnLoss};
use kinematics::Transform;
use numbers::random::Random;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// How long a robot waits for our driver. The driver does not answer a state if the previous state
/// arrived more than 20 ms earlier.
const ANSWER_WAIT: Duration = Duration::from_millis(15);
/// Number of states without an answer after which a robot stops; two commands may still be on their
/// way.
const MAX_WITHOUT_ANSWER: u64 = 22;
/// Set in the child process that [`suspended_program_triggers_reflex_and_sends_nothing_stale`]
/// suspends and resumes.
const CHILD: &str = "FIELDRIG_TEST_FCI";

fn motion() -> MotionConfig {
    MotionConfig {
        limits: chain("link8")
            .limits()
            .iter()
            .map(|joint| MotionLimits::new(joint, 1.0, 0.5, 0.1))
            .collect(),
        on_loss: OnLoss::Hold,
        timeout: Duration::from_millis(100),
        accept_no_watchdog: false,
    }
}

fn open(address: SocketAddr) -> MovableFrankaArm {
    MovableFrankaArm::open(&config(address), &motion(), &ContactConfig::default()).unwrap()
}

/// Joints that follow their commands perfectly, and the last command.
fn recording_joints() -> (JointSimulator, Arc<Mutex<CommandedJoints>>) {
    let mut follow_command = ideal_joints();
    let last_command = Arc::new(Mutex::new(CommandedJoints::default()));
    let recorder = Arc::clone(&last_command);
    let joint_simulator: JointSimulator = Box::new(move |stamp, commanded| {
        *recorder.lock().unwrap() = *commanded;
        follow_command(stamp, commanded)
    });
    (joint_simulator, last_command)
}

/// Also counts the states that the robot sends during motions.
fn with_counter(mut joint_simulator: JointSimulator) -> (JointSimulator, Arc<AtomicU64>) {
    let n_moving = Arc::new(AtomicU64::new(0));
    let counter = Arc::clone(&n_moving);
    let counting: JointSimulator = Box::new(move |stamp, commanded| {
        counter.fetch_add(u64::from(commanded.is_moving), Ordering::Relaxed);
        joint_simulator(stamp, commanded)
    });
    (counting, n_moving)
}

/// Lets a robot move only as far as a test permits.
fn paced_motion(mut joint_simulator: JointSimulator, pace: &Pace) -> JointSimulator {
    let pace = pace.clone();
    Box::new(move |stamp, commanded| {
        if commanded.is_moving {
            pace.wait();
        }
        joint_simulator(stamp, commanded)
    })
}

/// Waits until the robot has moved for this many milliseconds of its clock, and stands still.
/// Returns the reason if the arm has stopped.
fn move_for(arm: &MovableFrankaArm, pace: &Pace, n_states: u64) -> Result<(), String> {
    pace.limit(n_states);
    let deadline = Instant::now() + TEST_TIMEOUT;
    while !pace.is_standing_still() {
        if let Motion::Stopped { reason } = arm.motion() {
            return Err(reason);
        }
        assert!(Instant::now() < deadline, "the robot does not move");
        std::thread::sleep(Duration::from_millis(2));
    }
    Ok(())
}

/// Commands a target, and waits until the robot has moved for this many milliseconds, and stands
/// still. If the machine is so busy that the robot triggers a reflex, repeats it.
fn move_until(arm: &mut MovableFrankaArm, pace: &Pace, target: &JointTarget, n_states: u64) {
    loop {
        pace.free();
        let moved = command_target(arm, target).and_then(|()| move_for(arm, pace, n_states));
        match moved {
            Ok(()) => return,
            Err(why) if why.contains("communication_constraints_violation") => {
                arm.recover().unwrap()
            }
            Err(why) => panic!("{why}"),
        }
    }
}

fn offset_from_rest(by_rad: [f64; N_JOINTS]) -> JointTarget {
    JointTarget {
        position: REST_RAD
            .iter()
            .zip(by_rad)
            .map(|(rest, by)| rest + by)
            .collect(),
    }
}

/// Waits until the arm is at rest. Returns the reason if it stopped.
fn settle(arm: &MovableFrankaArm) -> Result<(), String> {
    let deadline = Instant::now() + TEST_TIMEOUT;
    loop {
        match arm.motion() {
            Motion::Holding => return Ok(()),
            Motion::Stopped { reason } => return Err(reason),
            Motion::Moving => assert!(Instant::now() < deadline, "the arm never comes to rest"),
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Waits until a condition holds; panics with `expected` if it takes too long.
fn wait_until(mut condition: impl FnMut() -> bool, expected: &str) {
    let deadline = Instant::now() + TEST_TIMEOUT;
    while !condition() {
        assert!(Instant::now() < deadline, "{expected}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Performs an action and waits until the arm is at rest.
///
/// If the machine is so busy that the arm's thread answers more than 20 states in a row too late,
/// the robot correctly triggers a reflex. The action is then retried.
fn retry_until_settled(
    arm: &mut MovableFrankaArm,
    mut act: impl FnMut(&mut MovableFrankaArm) -> Result<(), String>,
) {
    const MAX_ATTEMPTS: usize = 5;
    for _ in 0..MAX_ATTEMPTS {
        match act(arm).and_then(|()| settle(arm)) {
            Ok(()) => return,
            Err(why) if why.contains("communication_constraints_violation") => {
                arm.recover().unwrap()
            }
            Err(why) => panic!("{why}"),
        }
    }
    panic!("this machine is too busy for a motion");
}

fn command_target(arm: &mut MovableFrankaArm, target: &JointTarget) -> Result<(), String> {
    arm.command(target)
        .map(drop)
        .map_err(|error| error.to_string())
}

/// Commands a target until something stops the arm on its way, and returns the reason.
fn move_until_stopped(arm: &mut MovableFrankaArm, target: &JointTarget) -> String {
    loop {
        command_target(arm, target).unwrap();
        match settle(arm).unwrap_err() {
            why if why.contains("communication_constraints_violation") => arm.recover().unwrap(),
            why => return why,
        }
    }
}

fn move_and_settle(arm: &mut MovableFrankaArm, target: &JointTarget) {
    retry_until_settled(arm, |arm| command_target(arm, target));
}

#[test]
fn motion_of_all_joints_respects_robot_limits() {
    const NEAR_RAD: f64 = 1e-4;
    for version in VERSIONS {
        let (joint_simulator, last_command) = recording_joints();
        let emulated = waiting_robot(version, ANSWER_WAIT, joint_simulator);
        let mut arm = open(emulated.address());
        assert_eq!(arm.motion(), Motion::Holding);
        for by_rad in [[0.4, -0.3, 0.2, 0.5, -0.4, 0.6, -0.7], [0.0; N_JOINTS]] {
            let target = offset_from_rest(by_rad);
            assert_eq!(arm.command(&target).unwrap(), target);
            assert_eq!(arm.motion(), Motion::Moving);
            move_and_settle(&mut arm, &target);
            let commanded = *last_command.lock().unwrap();
            let errors = commanded
                .position_rad
                .iter()
                .zip(&target.position)
                .map(|(is, target)| (is - target).abs());
            let worst = errors.fold(0.0, f64::max);
            assert!(worst < NEAR_RAD, "{version:?}: {worst} rad");
        }
        let statistics = arm.motion_statistics();
        eprintln!("{version:?}: {statistics}");
        assert!(
            statistics.n_motions >= 1 && statistics.n_cycles > 1000,
            "{statistics}"
        );
    }
}

#[test]
fn retargeting_and_stopping_respect_robot_limits() {
    for version in VERSIONS {
        let (joint_simulator, last_command) = recording_joints();
        let pace = Pace::default();
        let joint_simulator = paced_motion(joint_simulator, &pace);
        let emulated = waiting_robot(version, ANSWER_WAIT, joint_simulator);
        let mut arm = open(emulated.address());
        let far = offset_from_rest([1.2, -0.8, 1.0, 0.9, 1.0, 1.0, 1.0]);
        // The times are those of the robot, which stands still between them. If this thread is not
        // scheduled for long, the arm would otherwise arrive before it is stopped.
        retry_until_settled(&mut arm, |arm| {
            pace.free();
            command_target(arm, &far)?;
            for ix in 0..8 {
                move_for(arm, &pace, 90)?;
                let sign = if ix % 2 == 0 { -1.0 } else { 1.0 };
                command_target(
                    arm,
                    &offset_from_rest([sign, 0.3, -sign, 0.2 * sign, 0.0, sign, 0.5]),
                )?;
            }
            command_target(arm, &far)?;
            move_for(arm, &pace, 700)?;
            arm.stop().unwrap();
            pace.free();
            Ok(())
        });
        let CommandedJoints {
            position_rad,
            velocity_rad_s,
            ..
        } = *last_command.lock().unwrap();
        let remaining = far
            .position
            .iter()
            .zip(position_rad)
            .map(|(far, is)| (far - is).abs())
            .fold(0.0, f64::max);
        assert!(
            remaining > 0.1,
            "{version:?}: the arm did not stop before its target: {remaining} rad"
        );
        assert!(
            velocity_rad_s.iter().all(|velocity| velocity.abs() < 1e-3),
            "{velocity_rad_s:?}"
        );
    }
}

#[test]
fn targets_are_clamped_and_range_end_reached_slowly() {
    let (joint_simulator, last_command) = recording_joints();
    let emulated = waiting_robot(FciVersion::V10, ANSWER_WAIT, joint_simulator);
    let mut arm = open(emulated.address());
    let mut out_of_range = offset_from_rest([0.0; N_JOINTS]);
    (out_of_range.position[1], out_of_range.position[3]) = (9.0, -9.0);
    let accepted = arm.command(&out_of_range).unwrap();
    let Limits { position_rad, .. } = Limits::fr3();
    for (ix, end) in [(1, position_rad[1][1]), (3, position_rad[3][0])] {
        assert!((accepted.position[ix] - end).abs() < 0.05, "{accepted:?}");
    }
    move_and_settle(&mut arm, &out_of_range);
    assert!((last_command.lock().unwrap().position_rad[1] - accepted.position[1]).abs() < 1e-4);
    for (wrong, text) in [
        (vec![0.0; 6], "6 joints"),
        (vec![f64::NAN; N_JOINTS], "joint 1 is not a finite number"),
    ] {
        let open_error = arm
            .command(&JointTarget { position: wrong })
            .unwrap_err()
            .to_string();
        assert!(open_error.contains(text), "{open_error}");
    }
    assert_eq!(arm.motion(), Motion::Holding);
}

#[test]
fn robot_can_be_hand_guided_between_motions() {
    let (hand_position, last_command) = (
        Arc::new(Mutex::new(None)),
        Arc::new(Mutex::new(CommandedJoints::default())),
    );
    let (hand_input, recorder) = (Arc::clone(&hand_position), Arc::clone(&last_command));
    let mut follow_command = ideal_joints();
    let joint_simulator: JointSimulator = Box::new(move |stamp, commanded| {
        *recorder.lock().unwrap() = *commanded;
        let joints = follow_command(stamp, commanded);
        match *hand_input.lock().unwrap() {
            Some(position_rad) if !commanded.is_moving => Joints {
                position_rad,
                ..joints
            },
            _ => joints,
        }
    });
    let emulated = waiting_robot(FciVersion::V10, ANSWER_WAIT, joint_simulator);
    let mut arm = open(emulated.address());
    move_and_settle(&mut arm, &offset_from_rest([0.1; N_JOINTS]));
    assert!(
        last_command.lock().unwrap().is_moving,
        "the motion stays active for a while"
    );
    wait_until(
        || !last_command.lock().unwrap().is_moving,
        "the motion ends",
    );
    assert_eq!(arm.motion(), Motion::Holding);
    let by_hand = REST_RAD.map(|rest| rest - 0.2);
    *hand_position.lock().unwrap() = Some(by_hand);
    wait_until(
        || last_command.lock().unwrap().position_rad == by_hand,
        "the robot notices the hand",
    );
    *hand_position.lock().unwrap() = None;
    // The motion must start there without a jump, which would trigger a reflex.
    let target = offset_from_rest([0.0; N_JOINTS]);
    move_and_settle(&mut arm, &target);
    assert!((last_command.lock().unwrap().position_rad[0] - target.position[0]).abs() < 1e-4);
}

#[test]
fn contact_triggers_reflex_until_recovery() {
    for version in VERSIONS {
        let contact_nm = Arc::new(Mutex::new(0.0));
        let contact_torque = Arc::clone(&contact_nm);
        let mut follow_command = ideal_joints();
        let joint_simulator: JointSimulator = Box::new(move |stamp, commanded| {
            let mut joints = follow_command(stamp, commanded);
            if commanded.velocity_rad_s[3].abs() > 0.05 {
                joints.external_torque_nm[2] = *contact_torque.lock().unwrap();
            }
            joints
        });
        let emulated = waiting_robot(version, ANSWER_WAIT, joint_simulator);
        let contact = ContactConfig {
            torque_nm: [15.0; N_JOINTS],
            ..ContactConfig::default()
        };
        let mut arm =
            MovableFrankaArm::open(&config(emulated.address()), &motion(), &contact).unwrap();
        let (target, start) = (
            offset_from_rest([0.3; N_JOINTS]),
            offset_from_rest([0.0; N_JOINTS]),
        );
        *contact_nm.lock().unwrap() = 14.0;
        move_and_settle(&mut arm, &target);
        *contact_nm.lock().unwrap() = 16.0;
        let reason = move_until_stopped(&mut arm, &start);
        assert!(
            reason.contains("reflex") && reason.contains("joint_reflex"),
            "{reason}"
        );
        assert!(
            reason.contains("; in the last 60 cycles, the robot missed "),
            "{reason}"
        );
        let open_error = arm.command(&start).unwrap_err().to_string();
        assert!(
            open_error.contains("recovered") && open_error.contains("joint_reflex"),
            "{open_error}"
        );
        *contact_nm.lock().unwrap() = 0.0;
        assert!(
            matches!(arm.motion(), Motion::Stopped { .. }),
            "the arm has not been recovered"
        );
        arm.recover().unwrap();
        assert_eq!(arm.motion(), Motion::Holding);
        move_and_settle(&mut arm, &start);
    }
}

#[test]
fn stricter_robot_triggers_reflex_and_recovers() {
    let (joint_simulator, _) = recording_joints();
    let limits = Limits {
        acceleration_rad_s2: [0.5; N_JOINTS],
        ..Limits::panda()
    };
    let address = FREE_PORT.parse().unwrap();
    let config_5 = RobotConfig {
        address,
        version: FciVersion::V5,
        chain: chain("link8"),
        flange_from_tool: Transform::identity(),
        limits,
    };
    let emulated = EmulatedRobot::start_waiting(config_5, ANSWER_WAIT, joint_simulator).unwrap();
    let mut arm = open(emulated.address());
    let reason = move_until_stopped(&mut arm, &offset_from_rest([0.5; N_JOINTS]));
    assert!(
        reason.contains("joint_motion_generator_velocity_discontinuity"),
        "{reason}"
    );
    arm.recover().unwrap();
    assert_eq!(arm.motion(), Motion::Holding);
    arm.recover().unwrap();
    command_target(&mut arm, &offset_from_rest([0.0; N_JOINTS])).unwrap();
}

#[test]
fn unsupported_fail_safe_is_rejected() {
    let emulated = robot(FciVersion::V5, ideal_joints());
    let open_error = |motion: &MotionConfig| {
        MovableFrankaArm::open(
            &config(emulated.address()),
            motion,
            &ContactConfig::default(),
        )
        .unwrap_err()
        .to_string()
    };
    for on_loss in [OnLoss::Damp, OnLoss::Release] {
        let text = open_error(&MotionConfig {
            on_loss,
            ..motion()
        });
        assert!(text.contains("on_loss = \"hold\""), "{text}");
    }
    let text = open_error(&MotionConfig {
        timeout: Duration::from_millis(5),
        ..motion()
    });
    assert!(text.contains("20ms") && text.contains("5ms"), "{text}");
    let too_few_limits = MotionConfig {
        limits: motion().limits[1..].to_vec(),
        ..motion()
    };
    assert!(open_error(&too_few_limits).contains("6 joints"));
    let mut other = motion();
    other.limits[3].position = [0.5, 2.0];
    assert!(open_error(&other).contains("joint 4"));
}

/// A relay between a client and a robot that simulates a network losing some or all datagrams.
struct Relay {
    address: SocketAddr,
    faults: Arc<Faults>,
}

#[derive(Default)]
struct Faults {
    drops_some: AtomicBool,
    is_disconnected: AtomicBool,
    n_commands: AtomicU64,
}

impl Relay {
    /// Starts a relay between one client and the robot at this address.
    fn start(robot: SocketAddr) -> Self {
        const DROP_FRAC: f64 = 0.05;
        let listener = TcpListener::bind(FREE_PORT).unwrap();
        let address = listener.local_addr().unwrap();
        let faults = Arc::new(Faults::default());
        let relay_faults = Arc::clone(&faults);
        std::thread::spawn(move || {
            let (mut client, peer) = listener.accept().unwrap();
            let mut upstream = TcpStream::connect(robot).unwrap();
            let mut hello = [0; 16];
            client.read_exact(&mut hello).unwrap();
            let client_states =
                SocketAddr::new(peer.ip(), u16::from_le_bytes([hello[14], hello[15]]));
            let udp = UdpSocket::bind(FREE_PORT).unwrap();
            hello[14..].copy_from_slice(&udp.local_addr().unwrap().port().to_le_bytes());
            upstream.write_all(&hello).unwrap();
            for stream in [&client, &upstream] {
                stream.set_nodelay(true).unwrap();
            }
            let (mut from_client, mut to_robot) =
                (client.try_clone().unwrap(), upstream.try_clone().unwrap());
            std::thread::spawn(move || {
                // Either side may disconnect at any time.
                let _ = std::io::copy(&mut from_client, &mut to_robot);
                let _ = to_robot.shutdown(std::net::Shutdown::Both);
            });
            std::thread::spawn(move || drop(std::io::copy(&mut upstream, &mut client)));
            let mut random = Random::new(1);
            let (mut buffer, mut robot_states) = ([0; 4096], None);
            while let Ok((n, from)) = udp.recv_from(&mut buffer) {
                let is_command = from == client_states;
                if is_command {
                    relay_faults.n_commands.fetch_add(1, Ordering::Relaxed);
                } else {
                    robot_states = Some(from);
                }
                let is_dropped_randomly = random.unit() < DROP_FRAC;
                let is_dropped = relay_faults.is_disconnected.load(Ordering::Relaxed)
                    || (is_dropped_randomly && relay_faults.drops_some.load(Ordering::Relaxed));
                let (to, datagram) = match is_command || is_dropped {
                    // If the answer is lost, an empty datagram ends the robot's wait.
                    true => (robot_states, &buffer[..if is_dropped { 0 } else { n }]),
                    false => (Some(client_states), &buffer[..n]),
                };
                if let Some(to) = to {
                    // Ignore send errors: the client may be gone.
                    let _ = udp.send_to(datagram, to);
                }
            }
        });
        Self { address, faults }
    }
}

#[test]
fn lossy_network_is_reported_and_motions_complete() {
    let (joint_simulator, last_command) = recording_joints();
    let emulated = waiting_robot(FciVersion::V10, ANSWER_WAIT, joint_simulator);
    let relay = Relay::start(emulated.address());
    let mut arm = open(relay.address);
    relay.faults.drops_some.store(true, Ordering::Relaxed);
    for by_rad in [0.5, -0.5, 0.5, -0.5, 0.0] {
        move_and_settle(&mut arm, &offset_from_rest([by_rad; N_JOINTS]));
        let error = last_command.lock().unwrap().position_rad[5] - (REST_RAD[5] + by_rad);
        assert!(error.abs() < 1e-4, "{error}");
    }
    let statistics = arm.motion_statistics();
    eprintln!("5 % loss in each direction: {statistics}");
    // The expected rates are 0.95 for ours and 0.95 squared for the robot's.
    let [mean, least] = statistics.robot_success_frac().unwrap();
    assert!(
        (0.88..0.97).contains(&statistics.success_frac()),
        "{statistics}"
    );
    assert!(
        (0.78..0.93).contains(&mean) && least < mean && statistics.n_missed > 20,
        "{statistics}"
    );
}

#[test]
fn disconnect_triggers_reflex_and_arm_recovers() {
    let (joint_simulator, last_command) = recording_joints();
    let (joint_simulator, n_moving) = with_counter(joint_simulator);
    let pace = Pace::default();
    let joint_simulator = paced_motion(joint_simulator, &pace);
    let emulated = waiting_robot(FciVersion::V10, ANSWER_WAIT, joint_simulator);
    let relay = Relay::start(emulated.address());
    let mut arm = open(relay.address);
    let far = offset_from_rest([0.9, -0.6, 0.9, 0.9, 0.9, 0.9, 0.9]);
    // The robot stands still on its way while it is disconnected, so that it has not arrived.
    move_until(&mut arm, &pace, &far, 500);
    relay.faults.is_disconnected.store(true, Ordering::Relaxed);
    let n_before = n_moving.load(Ordering::Relaxed);
    pace.free();
    wait_until(
        || !last_command.lock().unwrap().is_moving,
        "the robot stops on its own",
    );
    let n_without_answer = n_moving.load(Ordering::Relaxed) - n_before;
    assert!(
        n_without_answer <= MAX_WITHOUT_ANSWER,
        "the robot stopped after {n_without_answer} states"
    );
    relay.faults.is_disconnected.store(false, Ordering::Relaxed);
    let reason = settle(&arm).unwrap_err();
    assert!(
        reason.contains("communication_constraints_violation"),
        "{reason}"
    );
    assert!(arm.command(&far).is_err(), "the arm has not been recovered");
    arm.recover().unwrap();
    move_and_settle(&mut arm, &far);
    // This time, the disconnection is permanent.
    relay.faults.is_disconnected.store(true, Ordering::Relaxed);
    wait_until(
        || matches!(arm.motion(), Motion::Stopped { .. }),
        "the arm notices the disconnection",
    );
    let lost = arm.recover().unwrap_err().to_string();
    assert!(lost.contains("no state"), "{lost}");
}

#[test]
#[ignore = "child process of the test below"]
fn child_program_moves_arm() {
    let Ok(address) = std::env::var(CHILD) else {
        return;
    };
    let print_line = |text: &str| {
        std::io::stdout()
            .write_all(format!("\narm: {text}\n").as_bytes())
            .unwrap()
    };
    let mut arm = open(address.parse().unwrap());
    let (target, start) = (
        offset_from_rest([1.5, -1.0, 1.5, 1.5, 1.5, 1.5, 1.5]),
        offset_from_rest([0.0; N_JOINTS]),
    );
    command_target(&mut arm, &target).unwrap();
    print_line("moving");
    print_line(&settle(&arm).unwrap_err());
    // Long enough for stale commands to be sent and counted.
    std::thread::sleep(Duration::from_millis(300));
    print_line("quiet");
    std::thread::sleep(Duration::from_millis(300));
    arm.recover().unwrap();
    move_and_settle(&mut arm, &start);
    print_line("held");
}

#[test]
fn suspended_program_triggers_reflex_and_sends_nothing_stale() {
    let (joint_simulator, last_command) = recording_joints();
    let (joint_simulator, n_moving) = with_counter(joint_simulator);
    // The robot stands still on its way while the program is suspended, so that it has not arrived.
    let pace = Pace::default();
    pace.limit(300);
    let joint_simulator = paced_motion(joint_simulator, &pace);
    let emulated = waiting_robot(FciVersion::V10, ANSWER_WAIT, joint_simulator);
    let relay = Relay::start(emulated.address());
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args([
            "--ignored",
            "--nocapture",
            "--exact",
            "franka::motion_tests::child_program_moves_arm",
        ])
        .env(CHILD, relay.address.to_string())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let signal = |name: &str| {
        // Use the shell's builtin `kill`: a minimal system has no other.
        assert!(
            Command::new("sh")
                .args(["-c", &format!("kill {name} {}", child.id())])
                .status()
                .unwrap()
                .success()
        );
    };
    let mut text = || {
        let of_arm =
            |reader: Result<String, _>| reader.unwrap().strip_prefix("arm: ").map(str::to_owned);
        lines.by_ref().find_map(of_arm).expect("the program ended")
    };
    assert_eq!(text(), "moving");
    wait_until(|| pace.is_standing_still(), "the robot moves");
    signal("-STOP");
    pace.free();
    // Commands may still be on their way through the relay.
    let (mut n_before, mut n_commands) = (0, 0);
    let has_stopped = || {
        let n_commands_before = std::mem::replace(
            &mut n_commands,
            relay.faults.n_commands.load(Ordering::Relaxed),
        );
        if n_commands > n_commands_before {
            n_before = n_moving.load(Ordering::Relaxed);
        }
        !last_command.lock().unwrap().is_moving
    };
    wait_until(has_stopped, "the robot stops on its own");
    let n_without_answer = n_moving.load(Ordering::Relaxed) - n_before;
    assert!(
        n_without_answer <= MAX_WITHOUT_ANSWER,
        "the robot stopped after {n_without_answer} states"
    );
    // After the program was stopped, the relay still forwards the last commands. They are late if
    // this process is stalled, too.
    let mut counts = vec![0];
    while counts
        .iter()
        .rev()
        .take(4)
        .any(|count| *count != counts[counts.len() - 1])
        || counts.len() < 4
    {
        std::thread::sleep(Duration::from_millis(50));
        counts.push(relay.faults.n_commands.load(Ordering::Relaxed));
    }
    let n_commands = relay.faults.n_commands.load(Ordering::Relaxed);
    assert!(n_commands > 50, "{n_commands}");
    signal("-CONT");
    let reason = text();
    assert!(
        reason.contains("reflex") && reason.contains("communication_constraints_violation"),
        "{reason}"
    );
    let n_lost = reason
        .split(" states were not received")
        .next()
        .and_then(|text| text.rsplit(' ').next());
    assert!(
        n_lost
            .and_then(|n| n.parse::<u64>().ok())
            .is_some_and(|n_lost| n_lost >= 20),
        "{reason}"
    );
    assert_eq!(text(), "quiet");
    assert_eq!(
        relay.faults.n_commands.load(Ordering::Relaxed),
        n_commands,
        "it sent a stale command"
    );
    assert_eq!(text(), "held");
    assert!(child.wait().unwrap().success());
    assert!((last_command.lock().unwrap().position_rad[0] - REST_RAD[0]).abs() < 1e-4);
}

#[test]
fn steered_arm_brakes_when_its_targets_expire() {
    for version in VERSIONS {
        let (joint_simulator, last_command) = recording_joints();
        let emulated = waiting_robot(version, ANSWER_WAIT, joint_simulator);
        let mut arm = open(emulated.address());
        let tried = TriedMotion {
            joint_ix: 0,
            distance: 1.2,
            until: 0.1,
            busy: Some("communication_constraints_violation"),
        };
        let is_moving = || last_command.lock().unwrap().is_moving;
        check_steering(&mut arm, tried);
        wait_until(|| !is_moving(), "the motion of the robot ends");
        let n_motions = arm.motion_statistics().n_motions;
        // A new target starts a motion of the robot.
        check_steering(&mut arm, tried);
        let statistics = arm.motion_statistics();
        assert!(statistics.n_motions > n_motions, "{statistics}");
        drop(arm);
        assert!(!is_moving(), "the motion ends with the arm");
    }
}

#[test]
fn brakes_beyond_the_limits_of_the_robot_are_refused() {
    let emulated = waiting_robot(FciVersion::V10, ANSWER_WAIT, ideal_joints());
    let mut arm = open(emulated.address());
    let port = arm.steering_port(2.0).unwrap();
    wait_until(|| port.state().is_some(), "a report");
    let error = arm.steering_port(1e6).map(|port| port.brake_limits()[0]);
    assert_eq!(
        error.unwrap().jerk,
        2.0 * arm.limits()[0].jerk,
        "the same port"
    );
    drop(arm);
    let mut arm = open(emulated.address());
    let error = arm.steering_port(1e6).unwrap_err().to_string();
    assert!(error.contains("cannot brake joint 1"), "{error}");
    arm.command(&offset_from_rest([0.0; N_JOINTS])).unwrap();
}
