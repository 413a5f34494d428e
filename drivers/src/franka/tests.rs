//! Tests over loopback sockets: our driver, and franka-rs as a client that moves, against emulated
//! robots.

use super::emulated::fuzz::seeds::state_datagrams;
use super::emulated::{
    CommandedJoints, EmulatedRobot, JointSimulator, Joints, Limits, RobotConfig,
};
use super::test_pace::Pace;
use super::{ArmConfig, FciVersion, FrankaArm, N_JOINTS};
use crate::{Arm, Error};
use franka::wire::ROBOT_COMMAND_PORT;
use franka::{
    ControllerMode, FrankaError, JointPositions, MoveStatus, RealtimeConfig, Robot, RobotMode,
};
use kinematics::{Chain, JointState, Stamp, Transform};
use numbers::random::Random;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream, UdpSocket};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

const URDF: &str = include_str!("../../../kinematics/tests/data/panda.urdf");
pub(super) const FREE_PORT: &str = "127.0.0.1:0";
/// Timeout of the tests. It is long because a busy machine may be slow; a successful test does not
/// wait this long.
pub(super) const TEST_TIMEOUT: Duration = Duration::from_secs(20);
pub(super) const REST_RAD: [f64; N_JOINTS] = [0.1, -0.5, 0.2, -2.0, 0.3, 1.8, 0.7];
/// How long a robot waits for franka-rs, which does not correct a motion after a missed answer.
const CLIENT_WAIT: Duration = Duration::from_millis(200);
pub(super) const VERSIONS: [FciVersion; 2] = [FciVersion::V5, FciVersion::V10];

pub(super) fn chain(tip: &str) -> Chain {
    Chain::from_urdf(URDF, "link0", tip).unwrap()
}

/// A robot that waits for its answers no longer than a real one.
pub(super) fn robot(version: FciVersion, joint_simulator: JointSimulator) -> EmulatedRobot {
    waiting_robot(version, Duration::ZERO, joint_simulator)
}

/// A robot whose motions wait for each answer.
pub(super) fn waiting_robot(
    version: FciVersion,
    answer_wait: Duration,
    joint_simulator: JointSimulator,
) -> EmulatedRobot {
    let limits = if version == FciVersion::V5 {
        Limits::panda()
    } else {
        Limits::fr3()
    };
    let flange_from_tool = Transform::new(
        [0.0, 0.0, 0.1034].into(),
        [0.0, 0.0, -std::f64::consts::FRAC_PI_4].into(),
    );
    let address = FREE_PORT.parse().unwrap();
    let config = RobotConfig {
        address,
        version,
        chain: chain("link8"),
        flange_from_tool,
        limits,
    };
    EmulatedRobot::start_waiting(config, answer_wait, joint_simulator).unwrap()
}

pub(super) fn config(address: SocketAddr) -> ArmConfig {
    let chain = chain("link8");
    ArmConfig {
        address: address.to_string(),
        joint_names: chain.joint_names().to_vec(),
        chain,
    }
}

/// Joints that swing; their motion is a function of time.
pub(super) fn swinging_joints_at(stamp: Stamp) -> Joints {
    const RATE_RAD_S: f64 = 2.0;
    let phase = RATE_RAD_S * (stamp.0 as f64 * 1e-9);
    Joints {
        position_rad: REST_RAD.map(|rest| rest + 0.2 * phase.sin()),
        velocity_rad_s: [0.2 * RATE_RAD_S * phase.cos(); N_JOINTS],
        torque_nm: std::array::from_fn(|ix| ix as f64 - 3.0),
        ..Joints::default()
    }
}

/// Joints that follow their commands perfectly.
pub(super) fn ideal_joints() -> JointSimulator {
    let mut is_first = true;
    Box::new(move |_, commanded: &CommandedJoints| {
        let position_rad = if std::mem::take(&mut is_first) {
            REST_RAD
        } else {
            commanded.position_rad
        };
        Joints {
            position_rad,
            velocity_rad_s: commanded.velocity_rad_s,
            ..Joints::default()
        }
    })
}

/// Whether the joints of a state are those of the swinging joints at a time, up to the rounding of
/// the wire. A millisecond changes them by 1e-4 at least.
fn is_swing_at(state: &JointState, stamp: Stamp) -> bool {
    const ROUNDING: f64 = 1e-5;
    let truth = swinging_joints_at(stamp);
    let is_near = |reported: f64, expected: f64| (reported - expected).abs() < ROUNDING;
    is_near(state.position[0], truth.position_rad[0])
        && is_near(state.velocity[0], truth.velocity_rad_s[0])
}

/// A robot that sends states at the pace of a test, and the times of its states on its own clock.
struct PacedRobot {
    emulated: EmulatedRobot,
    pace: Pace,
    sent: Arc<Mutex<Vec<Stamp>>>,
}

impl PacedRobot {
    fn start(version: FciVersion) -> Self {
        let (pace, sent) = (Pace::default(), Arc::<Mutex<Vec<Stamp>>>::default());
        let (paced, record) = (pace.clone(), Arc::clone(&sent));
        let swinging = move |stamp, _: &CommandedJoints| {
            paced.wait();
            record.lock().unwrap().push(stamp);
            swinging_joints_at(stamp)
        };
        Self {
            emulated: robot(version, Box::new(swinging)),
            pace,
            sent,
        }
    }

    /// The time of a state on the clock of the robot.
    fn time_of(&self, state: &JointState) -> Stamp {
        let sent = self.sent.lock().unwrap();
        let found = sent.iter().rfind(|stamp| is_swing_at(state, **stamp));
        *found.expect("the robot has sent the state")
    }

    /// Stops the robot, and reads until no state is on its way. Returns the number of states that
    /// the robot has sent, and the number of states that were read.
    fn catch_up(&self, arm: &mut FrankaArm) -> (usize, u64) {
        self.pace.limit(0);
        let deadline = Instant::now() + TEST_TIMEOUT;
        let mut n_read = 0;
        loop {
            match arm.read(Duration::from_millis(100)) {
                Ok(state) => {
                    n_read += 1;
                    let sent = self.sent.lock().unwrap();
                    if sent.last().is_some_and(|last| is_swing_at(&state, *last)) {
                        return (sent.len(), n_read);
                    }
                }
                // The newest state may have been lost before; the next one will arrive.
                Err(Error::NoJoints { .. }) => {}
                Err(error) => panic!("{error}"),
            }
            assert!(Instant::now() < deadline, "{}", arm.statistics());
        }
    }
}

#[test]
fn ten_thousand_states_are_received_in_both_versions() {
    const N_STATES: usize = 10_000;
    // Number of states that the robot may be ahead of this test. The receive buffer of a socket
    // holds about 40, so that loopback loses nothing, however slow the machine is.
    const MAX_AHEAD: u64 = 15;
    // Maximum delay of a stamp, from the wake-up latency of one thread.
    const MAX_LATE_SECS: f64 = 5e-3;
    for version in VERSIONS {
        let robot = PacedRobot::start(version);
        let mut arm = FrankaArm::open(&config(robot.emulated.address())).unwrap();
        assert_eq!(arm.version(), version);
        let first = robot.time_of(&arm.read(TEST_TIMEOUT).unwrap());
        let (n_sent, n_caught_up) = robot.catch_up(&mut arm);
        robot.pace.limit(MAX_AHEAD);
        let mut states: Vec<JointState> = Vec::new();
        let mut max_error: f64 = 0.0;
        for ix in 0..N_STATES {
            let state = arm.read(TEST_TIMEOUT).unwrap();
            robot.pace.extend();
            let sent = robot.sent.lock().unwrap()[n_sent + ix];
            assert!(
                is_swing_at(&state, sent),
                "{version:?}: state {ix} is missing; {}",
                arm.statistics()
            );
            let truth = swinging_joints_at(state.stamp);
            if ix > 1000 {
                let errors = state
                    .position
                    .iter()
                    .zip(truth.position_rad)
                    .map(|(reported, is)| (reported - is).abs());
                max_error = errors.fold(max_error, f64::max);
            }
            assert_eq!(state.effort, truth.torque_nm);
            states.push(state);
        }
        let statistics = arm.statistics();
        eprintln!(
            "{version:?}: {statistics}; positions at their stamps within {max_error:.1e} rad"
        );
        assert!(
            max_error < 0.4 * MAX_LATE_SECS,
            "{version:?}: {max_error} rad; {statistics}"
        );
        // The robot numbers its states by milliseconds, and skips those that were due while its
        // thread stalled. Every missing state must be counted.
        let n_queued = statistics.n_received - statistics.n_dropped;
        while 1 + n_caught_up + (states.len() as u64) < n_queued {
            states.push(arm.read(TEST_TIMEOUT).unwrap());
        }
        assert!(states.is_sorted_by(|a, b| a.stamp < b.stamp));
        let span = robot
            .time_of(&states[states.len() - 1])
            .duration_since(first);
        assert_eq!(
            u128::from(statistics.n_received + statistics.n_lost),
            span.as_millis() + 1,
            "{version:?}: {statistics}"
        );
    }
}

#[test]
fn second_client_is_rejected_with_advice() {
    let emulated = robot(FciVersion::V5, ideal_joints());
    let first = FrankaArm::open(&config(emulated.address())).unwrap();
    let second_client = FrankaArm::open(&config(emulated.address()))
        .unwrap_err()
        .to_string();
    assert!(
        second_client.contains("one client") && second_client.contains("arm.driver = \"udp\""),
        "{second_client}"
    );
    drop(first);
    // The controller detects the disconnect within a few milliseconds.
    let deadline = Instant::now() + TEST_TIMEOUT;
    while let Err(error) = FrankaArm::open(&config(emulated.address())) {
        assert!(Instant::now() < deadline, "{error}");
    }
    let address = emulated.address();
    drop(emulated);
    let absent = FrankaArm::open(&config(address)).unwrap_err().to_string();
    assert!(
        absent.contains(&address.to_string()) && absent.contains("FCI"),
        "{absent}"
    );
}

#[test]
fn unresponsive_or_unsupported_controller_is_error() {
    let listener = std::net::TcpListener::bind(FREE_PORT).unwrap();
    let address = listener.local_addr().unwrap();
    let no_answer = FrankaArm::open(&config(address)).unwrap_err().to_string();
    assert!(
        no_answer.contains("does not answer") && no_answer.contains("udp"),
        "{no_answer}"
    );
    let listener = std::net::TcpListener::bind(FREE_PORT).unwrap();
    let address = listener.local_addr().unwrap();
    let thread = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.read_exact(&mut [0; 16]).unwrap();
        stream
            .write_all(b"HTTP/1.1 400 Bad Request\r\n\r\n")
            .unwrap();
        stream
    });
    let web_server = FrankaArm::open(&config(address)).unwrap_err().to_string();
    assert!(
        web_server.contains("not the control interface (FCI) of a Franka controller")
            && web_server.contains(&address.to_string())
            && web_server.contains(&format!("{ROBOT_COMMAND_PORT} (FCI)"))
            && !web_server.contains("one client"),
        "{web_server}"
    );
    thread.join().unwrap();
    for (answer, expected) in [
        (vec![1, 7, 0], "version 7"),
        (vec![9, 10, 0], "status 9"),
        (vec![0], "too short"),
    ] {
        let listener = std::net::TcpListener::bind(FREE_PORT).unwrap();
        let address = listener.local_addr().unwrap();
        let thread = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            let mut request = [0; 16];
            stream.read_exact(&mut request).unwrap();
            let n = 12 + u32::try_from(answer.len()).unwrap();
            let header = [
                [0; 4],
                [request[4], request[5], request[6], request[7]],
                n.to_le_bytes(),
            ]
            .concat();
            stream.write_all(&[header, answer].concat()).unwrap();
            stream
        });
        let message = FrankaArm::open(&config(address)).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
        thread.join().unwrap();
    }
}

#[test]
fn flange_mismatch_reports_both_poses() {
    let emulated = robot(FciVersion::V10, ideal_joints());
    let with_tip = |tip| ArmConfig {
        chain: chain(tip),
        ..config(emulated.address())
    };
    let wrong_tip = FrankaArm::open(&with_tip("link7")).unwrap_err().to_string();
    for part in ["\"link7\"", "107.0 mm", "arm.flange_link", "F_T_EE", "yaw"] {
        assert!(
            wrong_tip.contains(part),
            "{part:?} is missing in: {wrong_tip}"
        );
    }
    let mut swapped = config(emulated.address());
    swapped.joint_names.swap(1, 3);
    assert!(
        FrankaArm::open(&swapped)
            .unwrap_err()
            .to_string()
            .contains("order")
    );
    let too_few_joints = ArmConfig {
        joint_names: vec!["joint1".to_owned()],
        ..config(emulated.address())
    };
    assert!(
        FrankaArm::open(&too_few_joints)
            .unwrap_err()
            .to_string()
            .contains("1 joints")
    );
}

#[test]
fn lost_robot_is_an_error() {
    let emulated = robot(FciVersion::V10, ideal_joints());
    let mut arm = FrankaArm::open(&config(emulated.address())).unwrap();
    arm.read(TEST_TIMEOUT).unwrap();
    drop(emulated);
    let deadline = Instant::now() + TEST_TIMEOUT;
    let lost = loop {
        match arm.read(TEST_TIMEOUT) {
            Ok(_) => assert!(Instant::now() < deadline),
            Err(error) => break error,
        }
    };
    assert!(matches!(lost, Error::Fci { .. }), "{lost}");
    assert!(matches!(
        arm.read(Duration::from_millis(1)),
        Err(Error::NoJoints { .. })
    ));
}

/// A smooth motion by `by_rad`, as a function of the fraction of the time (a quintic, at rest at
/// both ends).
fn quintic(frac: f64, by_rad: f64) -> f64 {
    by_rad * frac.powi(3) * (10.0 - 15.0 * frac + 6.0 * frac * frac)
}

/// Moves the fourth joint with franka-rs, which implements libfranka's loop, without its limits and
/// filters.
fn move_to(client: &Robot, goal_rad: f64, secs: f64) -> Result<(), FrankaError> {
    let mut start = None;
    let mut time = 0.0;
    client.control_joint_positions(
        |state, period| {
            let start = *start.get_or_insert(state.q_d);
            time += period.as_secs_f64();
            let frac = (time / secs).min(1.0);
            let mut q = start;
            q[3] += quintic(frac, goal_rad - start[3]);
            let mut output = JointPositions::new(q);
            output.motion_finished = frac >= 1.0;
            output
        },
        ControllerMode::JointImpedance,
        false,
        franka::MAX_CUTOFF_FREQUENCY,
    )
}

/// Clears a reflex, and waits for a state that confirms it: earlier states may still be in flight.
fn recover(client: &Robot) {
    client.automatic_error_recovery().unwrap();
    let deadline = Instant::now() + TEST_TIMEOUT;
    loop {
        let state = client.read_once().unwrap();
        if state.robot_mode == RobotMode::Idle && !state.current_errors.any() {
            return;
        }
        assert!(Instant::now() < deadline, "{:?}", state.robot_mode);
    }
}

#[test]
fn motion_beyond_limits_triggers_reflex_until_recovery() {
    for version in VERSIONS {
        let emulated = waiting_robot(version, CLIENT_WAIT, ideal_joints());
        let client = Robot::new(&emulated.address().to_string(), RealtimeConfig::Ignore).unwrap();
        assert_eq!(client.fci_version(), version);
        move_to(&client, REST_RAD[3] + 0.1, 1.0).unwrap();
        let arrived = client.read_once().unwrap();
        assert!(
            (arrived.q[3] - (REST_RAD[3] + 0.1)).abs() < 1e-6,
            "{:?}",
            arrived.q
        );
        assert_eq!(arrived.robot_mode, RobotMode::Idle);
        // Half a radian within a fifth of a second takes up to 72 rad/s².
        let stopped = match move_to(&client, REST_RAD[3] + 0.6, 0.2) {
            Err(FrankaError::Control(stopped)) => stopped,
            other => panic!("{other:?}"),
        };
        assert_eq!(stopped.move_status, Some(MoveStatus::ReflexAborted));
        let reports_discontinuity = |errors: &franka::Errors| {
            errors
                .names()
                .iter()
                .any(|name| name.contains("discontinuity"))
        };
        assert!(
            reports_discontinuity(&stopped.last_motion_errors),
            "{:?}",
            stopped.last_motion_errors.names()
        );
        let state = client.read_once().unwrap();
        assert_eq!(state.robot_mode, RobotMode::Reflex);
        assert!(reports_discontinuity(&state.current_errors));
        assert!(
            move_to(&client, REST_RAD[3], 1.0).is_err(),
            "no motion is accepted before the recovery"
        );
        recover(&client);
        move_to(&client, REST_RAD[3], 1.0).unwrap();
    }
}

#[test]
fn contact_above_threshold_ends_motion() {
    let contact_nm = Arc::new(Mutex::new(0.0));
    let contact = Arc::clone(&contact_nm);
    let mut follow_command = ideal_joints();
    let joint_simulator: JointSimulator = Box::new(move |stamp, commanded| {
        let mut joints = follow_command(stamp, commanded);
        let is_moving = commanded.velocity_rad_s[3].abs() > 0.01;
        joints.external_torque_nm[2] = if is_moving {
            *contact.lock().unwrap()
        } else {
            0.0
        };
        joints
    });
    let emulated = waiting_robot(FciVersion::V10, CLIENT_WAIT, joint_simulator);
    let client = Robot::new(&emulated.address().to_string(), RealtimeConfig::Ignore).unwrap();
    client
        .set_collision_behavior_simple([5.0; 7], [10.0; 7], [20.0; 6], [40.0; 6])
        .unwrap();
    *contact_nm.lock().unwrap() = 9.0;
    move_to(&client, REST_RAD[3] + 0.05, 0.5).unwrap();
    *contact_nm.lock().unwrap() = 11.0;
    match move_to(&client, REST_RAD[3], 0.5) {
        Err(FrankaError::Control(stopped)) => {
            assert_eq!(stopped.last_motion_errors.names(), ["joint_reflex"])
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn malformed_bytes_stop_neither_robot_nor_client() {
    let mut random = Random::new(1);
    let mut byte = move || random.byte();
    let emulated = robot(FciVersion::V10, ideal_joints());
    // Requests: headers of all kinds, with valid and invalid lengths, truncated anywhere.
    for ix in 0..300_u32 {
        let mut stream = TcpStream::connect(emulated.address()).unwrap();
        let n = usize::from(byte()) * 2;
        let mut bytes: Vec<u8> = (0..n).map(|_| byte()).collect();
        if ix % 3 > 0 {
            let port = [byte(), byte()];
            let hello = [
                &[0; 8][..],
                &16_u32.to_le_bytes(),
                &10_u16.to_le_bytes(),
                &port,
            ]
            .concat();
            let size = if ix % 3 == 1 {
                12 + u32::try_from(n).unwrap()
            } else {
                u32::from(byte()) << (byte() % 25)
            };
            let header = [(ix % 16).to_le_bytes(), [byte(); 4], size.to_le_bytes()].concat();
            bytes = [hello, header, bytes].concat();
        }
        // The robot may disconnect in the middle, and does so at once while another client is
        // connected.
        let _ = stream.write_all(&bytes);
    }
    let deadline = Instant::now() + TEST_TIMEOUT;
    let mut arm = loop {
        match FrankaArm::open(&config(emulated.address())) {
            Ok(arm) => break arm,
            Err(error) => assert!(Instant::now() < deadline, "{error}"),
        }
    };
    arm.read(TEST_TIMEOUT).unwrap();
    drop(arm);
    // Motion commands: a client that receives states sends junk to their source address.
    let (stream, states) = raw_client(&emulated);
    let mut state = [0; 2000];
    let (n_bytes, from) = states.recv_from(&mut state).unwrap();
    for _ in 0..1000 {
        let n = usize::from(byte()) * 2;
        let bytes: Vec<u8> = (0..n).map(|_| byte()).collect();
        states.send_to(&bytes, from).unwrap();
    }
    states.recv_from(&mut state).unwrap();
    drop((stream, emulated));
    // States: a controller that sends junk between valid ones.
    let listener = std::net::TcpListener::bind(FREE_PORT).unwrap();
    let address = listener.local_addr().unwrap();
    let good = state[..n_bytes].to_vec();
    let thread = std::thread::spawn(move || {
        let (mut stream, peer) = listener.accept().unwrap();
        let mut request = [0; 16];
        stream.read_exact(&mut request).unwrap();
        stream
            .write_all(&[&[0; 8][..], &15_u32.to_le_bytes(), &[0, 10, 0]].concat())
            .unwrap();
        let to = SocketAddr::new(peer.ip(), u16::from_le_bytes([request[14], request[15]]));
        let udp = UdpSocket::bind(FREE_PORT).unwrap();
        for number in 0..200_u64 {
            let mut bytes = good.clone();
            bytes[..8].copy_from_slice(&(5_000_000 + number).to_le_bytes());
            udp.send_to(&bytes, to).unwrap();
            let n = usize::from(byte()) * 11;
            let junk: Vec<u8> = (0..n).map(|_| byte()).collect();
            udp.send_to(&junk, to).unwrap();
            std::thread::sleep(Duration::from_millis(1));
        }
        stream
    });
    let mut arm = FrankaArm::open(&config(address)).unwrap();
    for _ in 0..150 {
        assert_eq!(arm.read(TEST_TIMEOUT).unwrap().position.len(), N_JOINTS);
    }
    let statistics = arm.statistics();
    assert!(
        statistics.n_rejected > 100 && statistics.n_lost == 0,
        "{statistics}"
    );
    thread.join().unwrap();
}

#[test]
fn states_from_another_port_of_the_controller_are_rejected() {
    // The number is small enough for the receive buffer of a socket.
    const N_FOREIGN: u32 = 20;
    let emulated = robot(
        FciVersion::V10,
        Box::new(|stamp, _| swinging_joints_at(stamp)),
    );
    let mut state_port = 0;
    let mut arm = FrankaArm::open_with(&config(emulated.address()), |connection, _| {
        state_port = connection.network.udp.port();
        Ok(None)
    })
    .unwrap();
    let earlier = arm.read(TEST_TIMEOUT).unwrap().stamp;
    let n_rejected = arm.statistics().n_rejected;
    // These datagrams have the address of the emulated robot, and contain valid states with other
    // numbers.
    let foreign = UdpSocket::bind(FREE_PORT).unwrap();
    for state in state_datagrams(FciVersion::V10, N_FOREIGN) {
        foreign.send_to(&state, ("127.0.0.1", state_port)).unwrap();
    }
    let deadline = Instant::now() + TEST_TIMEOUT;
    while arm.statistics().n_rejected < n_rejected + u64::from(N_FOREIGN) {
        assert!(Instant::now() < deadline, "{}", arm.statistics());
        assert!(arm.read(TEST_TIMEOUT).unwrap().stamp > earlier);
    }
    assert_eq!(arm.statistics().n_restarts, 0, "{}", arm.statistics());
}

/// A client that only sends the connection request; the second socket receives states.
fn raw_client(emulated: &EmulatedRobot) -> (TcpStream, UdpSocket) {
    let states = UdpSocket::bind(FREE_PORT).unwrap();
    states.set_read_timeout(Some(TEST_TIMEOUT)).unwrap();
    let port = states.local_addr().unwrap().port().to_le_bytes();
    let hello = [
        &[0; 8][..],
        &16_u32.to_le_bytes(),
        &10_u16.to_le_bytes(),
        &port,
    ]
    .concat();
    let deadline = Instant::now() + TEST_TIMEOUT;
    loop {
        // The robot rejects us until the previous client is gone.
        let mut stream = TcpStream::connect(emulated.address()).unwrap();
        let mut answer = [0; 15];
        if stream
            .write_all(&hello)
            .and_then(|()| stream.read_exact(&mut answer))
            .is_ok()
        {
            return (stream, states);
        }
        assert!(Instant::now() < deadline);
    }
}

#[test]
fn invalid_states_are_rejected() {
    use super::state::{MAX_STATE_BYTES, decode};
    use franka::wire::robot::{v5, v10};
    use zerocopy::IntoBytes;
    let [good_5, good_10] = [
        v5::RobotState::default().as_bytes().to_vec(),
        v10::RobotState::default().as_bytes().to_vec(),
    ];
    for (version, good, other) in [
        (FciVersion::V5, &good_5, &good_10),
        (FciVersion::V10, &good_10, &good_5),
    ] {
        assert!(decode(version, good).is_some());
        assert!(decode(version, other).is_none());
        for n in 0..MAX_STATE_BYTES {
            let bytes: Vec<u8> = good.iter().copied().chain([0]).cycle().take(n).collect();
            assert_eq!(
                decode(version, &bytes).is_some(),
                n == good.len(),
                "{n} bytes"
            );
        }
        // Bytes of all ones are not numbers.
        let mut bytes = good.clone();
        bytes[8..].fill(0xFF);
        assert!(decode(version, &bytes).is_none());
    }
}
