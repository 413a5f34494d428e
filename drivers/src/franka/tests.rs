//! Over real sockets of the loopback interface: our driver, and franka-rs as a client that moves, against played robots.

use super::played::{Joints, Limits, Owner, PlayedRobot, RobotConfig, Wanted};
use super::{ArmConfig, FciVersion, FrankaArm, N_JOINTS};
use crate::{Arm, Error};
use franka::{ControllerMode, FrankaError, JointPositions, MoveStatus, RealtimeConfig, Robot, RobotMode};
use kinematics::{Chain, Stamp, Transform};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream, UdpSocket};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

const URDF: &str = include_str!("../../../kinematics/tests/data/panda.urdf");
pub(super) const FREE_PORT: &str = "127.0.0.1:0";
/// Long, as a busy machine may be slow; nothing waits so long where all is well.
pub(super) const PATIENCE: Duration = Duration::from_secs(20);
pub(super) const REST_RAD: [f64; N_JOINTS] = [0.1, -0.5, 0.2, -2.0, 0.3, 1.8, 0.7];
pub(super) const VERSIONS: [FciVersion; 2] = [FciVersion::V5, FciVersion::V10];

pub(super) fn chain(tip: &str) -> Chain {
    Chain::from_urdf(URDF, "link0", tip).unwrap()
}

pub(super) fn robot(version: FciVersion, owner: Owner) -> PlayedRobot {
    let limits = if version == FciVersion::V5 { Limits::panda() } else { Limits::fr3() };
    let flange_from_ee = Transform::new([0.0, 0.0, 0.1034].into(), [0.0, 0.0, -std::f64::consts::FRAC_PI_4].into());
    let address = FREE_PORT.parse().unwrap();
    PlayedRobot::start(RobotConfig { address, version, chain: chain("link8"), flange_from_ee, limits }, owner).unwrap()
}

pub(super) fn config(address: SocketAddr) -> ArmConfig {
    let chain = chain("link8");
    ArmConfig { address: address.to_string(), joint_names: chain.joint_names().to_vec(), chain }
}

/// Joints that swing by themselves; what they do is a function of the time.
fn swing_at(stamp: Stamp) -> Joints {
    const RATE_RAD_S: f64 = 2.0;
    let phase = RATE_RAD_S * (stamp.0 as f64 * 1e-9);
    Joints {
        position_rad: REST_RAD.map(|rest| rest + 0.2 * phase.sin()),
        velocity_rad_s: [0.2 * RATE_RAD_S * phase.cos(); N_JOINTS],
        torque_nm: std::array::from_fn(|ix| ix as f64 - 3.0),
        ..Joints::default()
    }
}

/// Joints that are where they are wanted.
pub(super) fn obedient() -> Owner {
    let mut is_first = true;
    Box::new(move |_, wanted: &Wanted| {
        let position_rad = if std::mem::take(&mut is_first) { REST_RAD } else { wanted.position_rad };
        Joints { position_rad, velocity_rad_s: wanted.velocity_rad_s, ..Joints::default() }
    })
}

#[test]
fn ten_thousand_states_of_either_version_come_through() {
    // Loopback loses nothing; what is missing is what a busy machine did not get to send or take in time.
    const LEAST_FRAC: f64 = 0.99;
    // Where the swing is, told by stamps that are late by at most the wake-up of one thread.
    const LATE_SECS: f64 = 5e-3;
    for version in VERSIONS {
        let played = robot(version, Box::new(|stamp, _| swing_at(stamp)));
        let mut arm = FrankaArm::open(&config(played.address())).unwrap();
        assert_eq!(arm.version(), version);
        let mut last = None;
        let mut worst: f64 = 0.0;
        for ix in 0..10_000 {
            let state = arm.read(PATIENCE).unwrap();
            assert!(last.is_none_or(|last| state.stamp > last));
            last = Some(state.stamp);
            let truth = swing_at(state.stamp);
            if ix > 1000 {
                let offs = state.position.iter().zip(truth.position_rad).map(|(told, is)| (told - is).abs());
                worst = offs.fold(worst, f64::max);
            }
            assert_eq!(state.effort, truth.torque_nm);
        }
        let statistics = arm.statistics();
        eprintln!("{version:?}: {statistics}; positions at their stamps within {worst:.1e} rad");
        assert!(statistics.success_frac() > LEAST_FRAC, "{version:?}: {statistics}");
        assert!(worst < 0.4 * LATE_SECS, "{version:?}: {worst} rad; {statistics}");
    }
}

#[test]
fn one_client_is_taken_and_the_next_hears_what_to_do() {
    let played = robot(FciVersion::V5, obedient());
    let first = FrankaArm::open(&config(played.address())).unwrap();
    let refused = FrankaArm::open(&config(played.address())).unwrap_err().to_string();
    assert!(refused.contains("one client") && refused.contains("arm.driver = \"udp\""), "{refused}");
    drop(first);
    // The controller notices within a millisecond or a few.
    let until = Instant::now() + PATIENCE;
    while let Err(error) = FrankaArm::open(&config(played.address())) {
        assert!(Instant::now() < until, "{error}");
    }
    let address = played.address();
    drop(played);
    let absent = FrankaArm::open(&config(address)).unwrap_err().to_string();
    assert!(absent.contains(&address.to_string()) && absent.contains("FCI"), "{absent}");
}

#[test]
fn a_controller_that_does_not_answer_or_speaks_otherwise_is_an_error() {
    let listener = std::net::TcpListener::bind(FREE_PORT).unwrap();
    let address = listener.local_addr().unwrap();
    let silent = FrankaArm::open(&config(address)).unwrap_err().to_string();
    assert!(silent.contains("does not answer") && silent.contains("udp"), "{silent}");
    for (answer, expected) in [(vec![1, 7, 0], "version 7"), (vec![9, 10, 0], "status 9"), (vec![0], "too short")] {
        let listener = std::net::TcpListener::bind(FREE_PORT).unwrap();
        let address = listener.local_addr().unwrap();
        let thread = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            let mut request = [0; 16];
            stream.read_exact(&mut request).unwrap();
            let n = 12 + u32::try_from(answer.len()).unwrap();
            let header = [[0; 4], [request[4], request[5], request[6], request[7]], n.to_le_bytes()].concat();
            stream.write_all(&[header, answer].concat()).unwrap();
            stream
        });
        let message = FrankaArm::open(&config(address)).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
        thread.join().unwrap();
    }
}

#[test]
fn another_flange_than_the_robots_is_an_error_that_tells_both() {
    let played = robot(FciVersion::V10, obedient());
    let with_tip = |tip| ArmConfig { chain: chain(tip), ..config(played.address()) };
    let at_hand = FrankaArm::open(&with_tip("link7")).unwrap_err().to_string();
    for part in ["\"link7\"", "107.0 mm", "arm.flange_link", "F_T_EE", "yaw"] {
        assert!(at_hand.contains(part), "{part} is missing: {at_hand}");
    }
    let mut turned = config(played.address());
    turned.joint_names.swap(1, 3);
    assert!(FrankaArm::open(&turned).unwrap_err().to_string().contains("order"));
    let few = ArmConfig { joint_names: vec!["joint1".to_owned()], ..config(played.address()) };
    assert!(FrankaArm::open(&few).unwrap_err().to_string().contains("1 joints"));
}

#[test]
fn a_robot_that_goes_away_is_told() {
    let played = robot(FciVersion::V10, obedient());
    let mut arm = FrankaArm::open(&config(played.address())).unwrap();
    arm.read(PATIENCE).unwrap();
    drop(played);
    let until = Instant::now() + PATIENCE;
    let lost = loop {
        match arm.read(PATIENCE) {
            Ok(_) => assert!(Instant::now() < until),
            Err(error) => break error,
        }
    };
    assert!(matches!(lost, Error::Fci { .. }), "{lost}");
    assert!(matches!(arm.read(Duration::from_millis(1)), Err(Error::NoJoints { .. })));
}

/// A smooth way by `by_rad` of one joint in `secs`, as a share of the time (a quintic, at rest at both ends).
fn way(frac: f64, by_rad: f64) -> f64 {
    by_rad * frac.powi(3) * (10.0 - 15.0 * frac + 6.0 * frac * frac)
}

/// Moves the fourth joint with franka-rs, which is libfranka's loop; without its limits and filters.
///
/// On a machine so busy that the client is not woken for 20 ms the robot stops, as it should; then the motion begins anew.
fn move_to(client: &Robot, goal_rad: f64, secs: f64) -> Result<(), FrankaError> {
    const MAX_BEGUN: usize = 5;
    let mut result = Ok(());
    for _ in 0..MAX_BEGUN {
        result = move_once(client, goal_rad, secs);
        match &result {
            Err(FrankaError::Control(stopped))
                if stopped.last_motion_errors.get("communication_constraints_violation") =>
            {
                recover(client);
            }
            _ => return result,
        }
    }
    result
}

fn move_once(client: &Robot, goal_rad: f64, secs: f64) -> Result<(), FrankaError> {
    let mut start = None;
    let mut time = 0.0;
    client.control_joint_positions(
        |state, period| {
            let start = *start.get_or_insert(state.q_d);
            time += period.as_secs_f64();
            let frac = (time / secs).min(1.0);
            let mut q = start;
            q[3] += way(frac, goal_rad - start[3]);
            let mut output = JointPositions::new(q);
            output.motion_finished = frac >= 1.0;
            output
        },
        ControllerMode::JointImpedance,
        false,
        franka::MAX_CUTOFF_FREQUENCY,
    )
}

/// Clears a reflex, and waits for a state that says so: those from before may still be on their way.
fn recover(client: &Robot) {
    client.automatic_error_recovery().unwrap();
    let until = Instant::now() + PATIENCE;
    loop {
        let state = client.read_once().unwrap();
        if state.robot_mode == RobotMode::Idle && !state.current_errors.any() {
            return;
        }
        assert!(Instant::now() < until, "{:?}", state.robot_mode);
    }
}

#[test]
fn a_motion_within_limits_arrives_and_one_beyond_ends_in_a_reflex_until_recovery() {
    for version in VERSIONS {
        let played = robot(version, obedient());
        let client = Robot::new(&played.address().to_string(), RealtimeConfig::Ignore).unwrap();
        assert_eq!(client.fci_version(), version);
        move_to(&client, REST_RAD[3] + 0.1, 1.0).unwrap();
        let arrived = client.read_once().unwrap();
        assert!((arrived.q[3] - (REST_RAD[3] + 0.1)).abs() < 1e-6, "{:?}", arrived.q);
        assert_eq!(arrived.robot_mode, RobotMode::Idle);
        // Half a radian in a fifth of a second takes up to 72 rad/s².
        let stopped = match move_to(&client, REST_RAD[3] + 0.6, 0.2) {
            Err(FrankaError::Control(stopped)) => stopped,
            other => panic!("{other:?}"),
        };
        assert_eq!(stopped.move_status, Some(MoveStatus::ReflexAborted));
        let is_told = |errors: &franka::Errors| errors.names().iter().any(|name| name.contains("discontinuity"));
        assert!(is_told(&stopped.last_motion_errors), "{:?}", stopped.last_motion_errors.names());
        let state = client.read_once().unwrap();
        assert_eq!(state.robot_mode, RobotMode::Reflex);
        assert!(is_told(&state.current_errors));
        assert!(move_to(&client, REST_RAD[3], 1.0).is_err(), "no motion before the recovery");
        recover(&client);
        move_to(&client, REST_RAD[3], 1.0).unwrap();
    }
}

#[test]
fn contacts_beyond_what_a_client_allows_end_a_motion() {
    let touch_nm = Arc::new(Mutex::new(0.0));
    let touched = Arc::clone(&touch_nm);
    let mut obey = obedient();
    let owner: Owner = Box::new(move |stamp, wanted| {
        let mut joints = obey(stamp, wanted);
        let is_on_its_way = wanted.velocity_rad_s[3].abs() > 0.01;
        joints.external_torque_nm[2] = if is_on_its_way { *touched.lock().unwrap() } else { 0.0 };
        joints
    });
    let played = robot(FciVersion::V10, owner);
    let client = Robot::new(&played.address().to_string(), RealtimeConfig::Ignore).unwrap();
    client.set_collision_behavior_simple([5.0; 7], [10.0; 7], [20.0; 6], [40.0; 6]).unwrap();
    *touch_nm.lock().unwrap() = 9.0;
    move_to(&client, REST_RAD[3] + 0.05, 0.5).unwrap();
    *touch_nm.lock().unwrap() = 11.0;
    match move_to(&client, REST_RAD[3], 0.5) {
        Err(FrankaError::Control(stopped)) => assert_eq!(stopped.last_motion_errors.names(), ["joint_reflex"]),
        other => panic!("{other:?}"),
    }
}

#[test]
fn cut_and_random_bytes_neither_stop_a_robot_nor_a_client() {
    let mut random = 0x9E37_79B9_7F4A_7C15_u64;
    let mut byte = move || {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        random.to_le_bytes()[3]
    };
    let played = robot(FciVersion::V10, obedient());
    // Commands: headers of all kinds, with lengths that fit and do not, cut anywhere.
    for ix in 0..300_u32 {
        let mut stream = TcpStream::connect(played.address()).unwrap();
        let n = usize::from(byte()) * 2;
        let mut bytes: Vec<u8> = (0..n).map(|_| byte()).collect();
        if ix % 3 > 0 {
            let port = [byte(), byte()];
            let hello = [&[0; 8][..], &16_u32.to_le_bytes(), &10_u16.to_le_bytes(), &port].concat();
            let size = if ix % 3 == 1 { 12 + u32::try_from(n).unwrap() } else { u32::from(byte()) << (byte() % 25) };
            let header = [(ix % 16).to_le_bytes(), [byte(); 4], size.to_le_bytes()].concat();
            bytes = [hello, header, bytes].concat();
        }
        // It may hang up in the middle, and while another is there it does so at once.
        let _ = stream.write_all(&bytes);
    }
    let until = Instant::now() + PATIENCE;
    let mut arm = loop {
        match FrankaArm::open(&config(played.address())) {
            Ok(arm) => break arm,
            Err(error) => assert!(Instant::now() < until, "{error}"),
        }
    };
    arm.read(PATIENCE).unwrap();
    drop(arm);
    // Commands of motions: a client that gets states sends junk to where they come from.
    let (stream, states) = raw_client(&played);
    let mut state = [0; 2000];
    let (n_bytes, from) = states.recv_from(&mut state).unwrap();
    for _ in 0..1000 {
        let n = usize::from(byte()) * 2;
        let bytes: Vec<u8> = (0..n).map(|_| byte()).collect();
        states.send_to(&bytes, from).unwrap();
    }
    states.recv_from(&mut state).unwrap();
    drop((stream, played));
    // States: a controller that sends junk between good ones.
    let listener = std::net::TcpListener::bind(FREE_PORT).unwrap();
    let address = listener.local_addr().unwrap();
    let good = state[..n_bytes].to_vec();
    let thread = std::thread::spawn(move || {
        let (mut stream, peer) = listener.accept().unwrap();
        let mut request = [0; 16];
        stream.read_exact(&mut request).unwrap();
        stream.write_all(&[&[0; 8][..], &15_u32.to_le_bytes(), &[0, 10, 0]].concat()).unwrap();
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
        assert_eq!(arm.read(PATIENCE).unwrap().position.len(), N_JOINTS);
    }
    let statistics = arm.statistics();
    assert!(statistics.n_refused > 100 && statistics.n_lost == 0, "{statistics}");
    thread.join().unwrap();
}

/// A client that says hello and nothing more; the second socket gets states.
fn raw_client(played: &PlayedRobot) -> (TcpStream, UdpSocket) {
    let states = UdpSocket::bind(FREE_PORT).unwrap();
    states.set_read_timeout(Some(PATIENCE)).unwrap();
    let port = states.local_addr().unwrap().port().to_le_bytes();
    let hello = [&[0; 8][..], &16_u32.to_le_bytes(), &10_u16.to_le_bytes(), &port].concat();
    let until = Instant::now() + PATIENCE;
    loop {
        // Until the one before is gone it sends us away.
        let mut stream = TcpStream::connect(played.address()).unwrap();
        let mut answer = [0; 15];
        if stream.write_all(&hello).and_then(|()| stream.read_exact(&mut answer)).is_ok() {
            return (stream, states);
        }
        assert!(Instant::now() < until);
    }
}

#[test]
fn states_that_are_none_are_refused() {
    use super::state::{MAX_STATE_BYTES, decode};
    use franka::wire::robot::{v5, v10};
    use zerocopy::IntoBytes;
    let [good_5, good_10] =
        [v5::RobotState::default().as_bytes().to_vec(), v10::RobotState::default().as_bytes().to_vec()];
    for (version, good, other) in [(FciVersion::V5, &good_5, &good_10), (FciVersion::V10, &good_10, &good_5)] {
        assert!(decode(version, good).is_some());
        assert!(decode(version, other).is_none());
        for n in 0..MAX_STATE_BYTES {
            let bytes: Vec<u8> = good.iter().copied().chain([0]).cycle().take(n).collect();
            assert_eq!(decode(version, &bytes).is_some(), n == good.len(), "{n} bytes");
        }
        // All ones are no numbers, wherever they stand in joints.
        let mut bytes = good.clone();
        bytes[8..].fill(0xFF);
        assert!(decode(version, &bytes).is_none());
    }
}
