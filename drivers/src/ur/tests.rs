//! Tests over loopback sockets: our driver against emulated controllers.

use super::emulated::{ControllerConfig, EmulatedController, Joints, Modes};
use super::flange_check::check_flange;
use super::message::{self, PackageType};
use super::state::RobotState;
use super::{ArmConfig, N_JOINTS, RTDE_PORT, StateStatistics, UrArm, controller_version};
use crate::{Arm, Error};
use kinematics::{Chain, JointState, Stamp, Transform};
use numbers::random::Random;
use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::{Duration, Instant};

const URDF: &str = include_str!("../../../kinematics/tests/data/ur5e-dh.urdf");
/// Timeout of the tests. It is long because a busy machine may be slow; a successful test does not
/// wait this long.
pub(super) const TEST_TIMEOUT: Duration = Duration::from_secs(30);
pub(super) const REST_RAD: [f64; N_JOINTS] = [0.3, -1.4, 1.6, -1.8, -1.5, 0.4];

/// An address of this computer that no other test uses, with the ports of a controller.
pub(super) fn free_address() -> SocketAddr {
    static N_USED: AtomicU8 = AtomicU8::new(1);
    let [_, _, high, low] = std::process::id().to_be_bytes();
    let ix = N_USED.fetch_add(1, Ordering::Relaxed);
    (Ipv4Addr::new(127, high.max(1), low, ix), RTDE_PORT).into()
}

pub(super) fn chain(base: &str, tip: &str) -> Chain {
    Chain::from_urdf(URDF, base, tip).unwrap()
}

pub(super) fn flange_chain() -> Chain {
    chain("base_link_inertia", "tool0")
}

pub(super) fn config(address: SocketAddr) -> ArmConfig {
    let chain = flange_chain();
    ArmConfig {
        address: address.to_string(),
        joint_names: chain.joint_names().to_vec(),
        chain,
    }
}

/// Phase speed of the swinging joints.
const SWING_RAD_S: f64 = 2.0;
const AMPLITUDE_RAD: f64 = 0.2;

/// Joints that swing; their motion is a function of time.
fn swinging_joints_at(stamp: Stamp) -> Joints {
    let phase = SWING_RAD_S * (stamp.0 as f64 * 1e-9);
    Joints {
        position_rad: REST_RAD.map(|rest| rest + AMPLITUDE_RAD * phase.sin()),
        velocity_rad_s: [AMPLITUDE_RAD * SWING_RAD_S * phase.cos(); N_JOINTS],
        torque_nm: std::array::from_fn(|ix| ix as f64 - 3.0),
    }
}

/// Seconds between two states of the swinging joints, from their positions and velocities. They must
/// be less than a period apart.
fn secs_between([earlier, later]: &[JointState; 2]) -> f64 {
    let phase = |state: &JointState| {
        (state.position[0] - REST_RAD[0]).atan2(state.velocity[0] / SWING_RAD_S)
    };
    (phase(later) - phase(earlier)).rem_euclid(std::f64::consts::TAU) / SWING_RAD_S
}

fn start(config: ControllerConfig) -> EmulatedController {
    EmulatedController::start(config, Box::new(|stamp, _| swinging_joints_at(stamp))).unwrap()
}

fn e_series() -> EmulatedController {
    start(ControllerConfig::e_series(free_address(), flange_chain()))
}

/// Reads states until the statistics fulfill a condition.
fn read_until(arm: &mut UrArm, condition: impl Fn(&StateStatistics) -> bool) {
    let deadline = Instant::now() + TEST_TIMEOUT;
    while !condition(&arm.statistics()) {
        assert!(Instant::now() < deadline, "{}", arm.statistics());
        match arm.read(Duration::from_millis(20)) {
            Ok(_) | Err(Error::NoJoints { .. } | Error::ArmReconnecting { .. }) => {}
            Err(error) => panic!("{error}"),
        }
    }
}

/// The error after which an arm sends no more states.
fn final_error(arm: &mut UrArm) -> String {
    let deadline = Instant::now() + TEST_TIMEOUT;
    loop {
        assert!(Instant::now() < deadline, "{}", arm.statistics());
        match arm.read(Duration::from_millis(20)) {
            Ok(_) | Err(Error::NoJoints { .. } | Error::ArmReconnecting { .. }) => {}
            Err(error) => return error.to_string(),
        }
    }
}

#[test]
fn states_have_the_rate_of_the_controller_and_stamps_on_our_clock() {
    // The robot moves by up to 0.4 rad/s. Stamps may be late by the wake-up latency of a thread.
    const MAX_ERROR_RAD: f64 = 0.4 * 10e-3;
    let address = free_address();
    for (controller, n_states, period_secs, has_torque) in [
        (
            ControllerConfig::e_series(address, flange_chain()),
            4000,
            0.002,
            true,
        ),
        (
            ControllerConfig::cb3(address, flange_chain()),
            1000,
            0.008,
            false,
        ),
    ] {
        let emulated = start(controller);
        let mut arm = UrArm::open(&config(address)).unwrap();
        assert_eq!(arm.version().rate_hz(), 1.0 / period_secs);
        let mut states: Vec<JointState> = (0..n_states)
            .map(|_| arm.read(TEST_TIMEOUT).unwrap())
            .collect();
        let mut max_error: f64 = 0.0;
        for state in &states[n_states / 2..] {
            let truth = swinging_joints_at(state.stamp);
            for (reported, expected) in std::iter::zip(&state.position, truth.position_rad) {
                max_error = max_error.max((reported - expected).abs());
            }
            assert_eq!(state.effort.is_empty(), !has_torque);
            assert!(!has_torque || state.effort == truth.torque_nm);
        }
        assert!(states.is_sorted_by(|a, b| a.stamp < b.stamp));
        let statistics = arm.statistics();
        assert!(max_error < MAX_ERROR_RAD, "{max_error} rad; {statistics}");
        // Every state that is missing must be counted. A busy machine may skip some.
        let n_queued = usize::try_from(statistics.n_received - statistics.n_dropped).unwrap();
        while states.len() < n_queued {
            states.push(arm.read(TEST_TIMEOUT).unwrap());
        }
        let n_missing: f64 = states[..n_queued]
            .array_windows()
            .map(|pair| (secs_between(pair) / period_secs).round() - 1.0)
            .sum();
        assert_eq!(
            n_missing,
            (statistics.n_lost + statistics.n_dropped) as f64,
            "{statistics}"
        );
        assert!(emulated.n_states_sent() >= statistics.n_received);
        assert_eq!(statistics.n_rejected, 0, "{statistics}");
    }
}

#[test]
fn truncated_packages_are_rejected_and_counted() {
    let emulated = e_series();
    let mut arm = UrArm::open(&config(emulated.address())).unwrap();
    arm.read(TEST_TIMEOUT).unwrap();
    // A state that is cut off, one of another recipe, one without values, and a message.
    for payload in [&[1; 100][..], &[9; 400], &[]] {
        emulated.inject(&message::encode(PackageType::Data, payload));
    }
    let text = [&[5], &b"hello"[..], &[4], b"test", &[2]].concat();
    emulated.inject(&message::encode(PackageType::TextMessage, &text));
    read_until(&mut arm, |statistics| statistics.n_rejected == 3);
    let n_received = arm.statistics().n_received;
    read_until(&mut arm, |statistics| {
        statistics.n_received > n_received + 100
    });
    assert_eq!(arm.statistics().n_reconnects, 0);
}

#[test]
fn garbage_and_lost_connections_are_followed_by_a_reconnect() {
    let emulated = e_series();
    let mut arm = UrArm::open(&config(emulated.address())).unwrap();
    arm.read(TEST_TIMEOUT).unwrap();
    emulated.inject(b"\x00\x01garbage that is not RTDE");
    read_until(&mut arm, |statistics| statistics.n_reconnects == 1);
    emulated.disconnect();
    read_until(&mut arm, |statistics| statistics.n_reconnects == 2);
    emulated.set_silent(true);
    let deadline = Instant::now() + TEST_TIMEOUT;
    while !matches!(
        arm.read(Duration::from_millis(20)),
        Err(Error::ArmReconnecting { .. })
    ) {
        assert!(Instant::now() < deadline, "{}", arm.statistics());
    }
    emulated.set_silent(false);
    read_until(&mut arm, |statistics| statistics.n_reconnects >= 3);
    let before = arm.statistics();
    // States during the outages count as lost, because images at these times have no pose.
    assert!(before.n_lost > 0, "{before}");
    let stamps: Vec<_> = (0..100)
        .map(|_| arm.read(TEST_TIMEOUT).unwrap().stamp)
        .collect();
    assert!(stamps.is_sorted());
}

#[test]
fn restarted_controller_is_followed() {
    let address = free_address();
    let controller = ControllerConfig::e_series(address, flange_chain());
    let emulated = start(controller.clone());
    let mut arm = UrArm::open(&config(address)).unwrap();
    // The clock of the new controller must be behind by more than reordered messages can be.
    read_until(&mut arm, |statistics| statistics.n_received > 1000);
    drop(emulated);
    let _emulated = start(controller);
    read_until(&mut arm, |statistics| statistics.n_restarts == 1);
    let statistics = arm.statistics();
    read_until(&mut arm, |now| now.n_received > statistics.n_received + 500);
    let state = arm.read(TEST_TIMEOUT).unwrap();
    let age = crate::clock::now().duration_since(state.stamp);
    assert!(age < TEST_TIMEOUT, "{age:?}");
}

#[test]
fn a_controller_that_does_not_return_ends_reading() {
    let emulated = e_series();
    let mut arm = UrArm::open_with(&config(emulated.address()), Duration::ZERO).unwrap();
    arm.read(TEST_TIMEOUT).unwrap();
    drop(emulated);
    let lost = final_error(&mut arm);
    assert!(
        lost.contains("closed the connection") || lost.contains("cannot receive"),
        "{lost}"
    );
    assert!(
        lost.contains("did not return") && lost.contains("cannot connect"),
        "{lost}"
    );
}

#[test]
fn angles_without_power_at_the_joints_are_not_used() {
    let emulated = e_series();
    let off = Modes {
        robot_mode: 3,
        safety_mode: 7,
        ..Modes::default()
    };
    emulated.set_modes(off);
    let deadline = Instant::now() + TEST_TIMEOUT;
    let error = loop {
        // The modes change with the next cycle.
        match UrArm::open(&config(emulated.address())) {
            Ok(_) => assert!(Instant::now() < deadline),
            Err(error) => break error.to_string(),
        }
    };
    assert!(
        error.contains("not measured") && error.contains("emergency stop"),
        "{error}"
    );
    emulated.set_modes(Modes::default());
    let mut arm = loop {
        match UrArm::open_with(&config(emulated.address()), Duration::ZERO) {
            Ok(arm) => break arm,
            Err(error) => assert!(Instant::now() < deadline, "{error}"),
        }
    };
    arm.read(TEST_TIMEOUT).unwrap();
    emulated.set_modes(off);
    let lost = final_error(&mut arm);
    assert!(
        lost.contains("emergency stop") && lost.contains("switch the robot on"),
        "{lost}"
    );
    assert!(arm.statistics().n_unpowered > 0);
}

#[test]
fn unsupported_controllers_are_reported_with_a_remedy() {
    let address = free_address();
    let open = |controller: ControllerConfig| {
        let _emulated = start(controller);
        UrArm::open(&config(address)).unwrap_err().to_string()
    };
    let supported = ControllerConfig::cb3(address, flange_chain());
    let old = open(ControllerConfig {
        rtde_version: 1,
        ..supported.clone()
    });
    assert!(
        old.contains("version 2") && old.contains("update PolyScope"),
        "{old}"
    );
    let without_variable = open(ControllerConfig {
        unknown_variables: vec!["runtime_state".to_owned()],
        ..supported
    });
    assert!(
        without_variable.contains("\"runtime_state\""),
        "{without_variable}"
    );
    let absent = UrArm::open(&config(address)).unwrap_err().to_string();
    assert!(
        absent.contains(&address.to_string()) && absent.contains("cannot connect"),
        "{absent}"
    );
    for (answer, expected) in [
        (
            &b"HTTP/1.1 400 Bad Request\r\n\r\n"[..],
            "another server answers, and not the RTDE interface of a controller of Universal Robots: it sent \"HTTP/1.1 400 Bad Request\"",
        ),
        (&[], "closed the connection without an answer"),
    ] {
        let listener = TcpListener::bind(address).unwrap();
        let thread = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            let mut request = [0; 5];
            stream.read_exact(&mut request).unwrap();
            stream.write_all(answer).unwrap();
        });
        let message = UrArm::open(&config(address)).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
        assert!(
            message.contains(&address.to_string())
                && message.contains(&format!("{RTDE_PORT} (RTDE)")),
            "{message}"
        );
        thread.join().unwrap();
    }
    let listener = TcpListener::bind(address).unwrap();
    let silent = UrArm::open(&config(address)).unwrap_err().to_string();
    assert!(silent.contains("does not answer"), "{silent}");
    drop(listener);
}

#[test]
fn random_bytes_stop_neither_controller_nor_driver() {
    let mut random = Random::new(1);
    let mut bytes = |n: usize| -> Vec<u8> { (0..n).map(|_| random.byte()).collect() };
    let emulated = e_series();
    let address = emulated.address();
    // Requests with valid headers and random payloads, random requests, and random lines.
    for ix in 0..200_usize {
        let port = [RTDE_PORT, 30002, 29999][ix % 3];
        let mut stream = TcpStream::connect((address.ip(), port)).unwrap();
        let payload = bytes(ix);
        let kinds = *b"VvMUOISP";
        let size = u16::try_from(payload.len() + 3).unwrap().to_be_bytes();
        let message = match ix % 2 {
            0 => [&size, &[kinds[ix % 8]][..], &payload].concat(),
            _ => payload,
        };
        // The controller may close the connection in the middle.
        let _ = stream.write_all(&message);
    }
    let mut arm = UrArm::open(&config(address)).unwrap();
    arm.read(TEST_TIMEOUT).unwrap();
    // States with random values of the right length, and of random lengths. Few of them have
    // plausible values by chance. They are sent in rounds that fit in the buffers of the sockets.
    for round in 1..=5 {
        for ix in 0..40 {
            let n = if ix % 2 == 0 { 1 + 8 + 6 * 48 + 20 } else { ix };
            let mut payload = bytes(n);
            if let Some(id) = payload.first_mut() {
                *id = 1;
            }
            emulated.inject(&message::encode(PackageType::Data, &payload));
        }
        read_until(&mut arm, |statistics| statistics.n_rejected >= 35 * round);
    }
    let n_received = arm.statistics().n_received;
    read_until(&mut arm, |statistics| {
        statistics.n_received > n_received + 100
    });
}

#[test]
fn several_clients_read_the_same_controller() {
    let emulated = e_series();
    let mut arms: Vec<UrArm> = (0..3)
        .map(|_| UrArm::open(&config(emulated.address())).unwrap())
        .collect();
    for arm in &mut arms {
        arm.read(TEST_TIMEOUT).unwrap();
    }
}

#[test]
fn flange_mismatch_reports_both_poses_and_the_cause() {
    let tool = Transform::translation(0.0, 0.0, 0.15);
    let emulated = start(ControllerConfig {
        flange_from_tool: tool,
        ..ControllerConfig::e_series(free_address(), flange_chain())
    });
    let open = |chain: Chain| {
        UrArm::open(&ArmConfig {
            joint_names: chain.joint_names().to_vec(),
            chain,
            ..config(emulated.address())
        })
    };
    // The tool of the controller does not matter, nor does the direction of the base.
    drop(open(flange_chain()).unwrap());
    drop(open(chain("base_link", "tool0")).unwrap());
    for (tip, expected) in [
        ("gripper", "tool center point"),
        ("flange", "only the orientation"),
        ("wrist_3_link", "likely causes"),
    ] {
        let error = open(chain("base_link_inertia", tip))
            .unwrap_err()
            .to_string();
        assert!(
            error.contains(expected) && error.contains("yaw") && error.contains(tip),
            "{error}"
        );
    }
    let mut swapped = config(emulated.address());
    swapped.joint_names.swap(1, 3);
    let error = UrArm::open(&swapped).unwrap_err().to_string();
    assert!(error.contains("order"), "{error}");
    let one_joint = ArmConfig {
        joint_names: vec!["elbow_joint".to_owned()],
        ..config(emulated.address())
    };
    let error = UrArm::open(&one_joint).unwrap_err().to_string();
    assert!(error.contains("1 joints"), "{error}");
}

#[test]
fn nominal_dimensions_and_unknown_tools_only_cause_a_warning() {
    let state = |urdf: &str, tool: Transform, reports_tool: bool| {
        let chain = Chain::from_urdf(urdf, "base_link_inertia", "tool0").unwrap();
        let base_from_tool = chain.forward(&REST_RAD).unwrap() * tool;
        let vector = |pose: &Transform| {
            let [x, y, z] = pose.translation.vector.into();
            let [about_x, about_y, about_z] = pose.rotation.scaled_axis().into();
            [x, y, z, about_x, about_y, about_z]
        };
        RobotState {
            position_rad: REST_RAD,
            base_from_tool: vector(&base_from_tool),
            flange_from_tool: reports_tool.then(|| vector(&tool)),
            ..RobotState::default()
        }
    };
    let config = config(free_address());
    let identity = Transform::identity();
    let tool = Transform::translation(0.0, 0.05, 0.15);
    // The measured upper arm of this robot is longer than the nominal one.
    let longer = |by_m: f64| URDF.replace("-0.425", &format!("{}", -0.425 - by_m));
    let checked = |state: RobotState| check_flange(&config, &state);
    let same = |state: RobotState| {
        let check = checked(state).expect("the same robot");
        assert_eq!(check.doubt, None);
        check.difference
    };
    let exact = same(state(URDF, tool, true));
    assert!(exact.is_within(1e-9, 1e-6), "{exact}");
    let longer_by_1_mm = same(state(&longer(1e-3), identity, true));
    assert!(
        longer_by_1_mm.to_string().starts_with("1.0 mm"),
        "{longer_by_1_mm}"
    );
    let doubtful = |state: RobotState| {
        let check = checked(state).expect("perhaps the same robot");
        check.doubt.expect("the difference is large")
    };
    let nominal = doubtful(state(&longer(8e-3), identity, true));
    assert!(
        nominal.contains("calibration") && nominal.contains("8.0 mm"),
        "{nominal}"
    );
    let unknown_tool = doubtful(state(URDF, tool, false));
    assert!(
        unknown_tool.contains("tool of its installation"),
        "{unknown_tool}"
    );
    assert!(checked(state(&longer(0.1), identity, true)).is_err());
}

#[test]
fn only_a_controller_tells_its_version() {
    let emulated = e_series();
    let version = controller_version(&emulated.address().to_string()).unwrap();
    assert_eq!(version.rate_hz(), 500.0);

    // A server of another kind greets its clients.
    let other = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = other.local_addr().unwrap().to_string();
    let greeting = std::thread::spawn(move || {
        let (mut client, _) = other.accept().unwrap();
        client.write_all(b"SSH-2.0-OpenSSH_9.2\r\n").unwrap();
        // It closes the connection after the first request, which it does not understand.
        client.read_exact(&mut [0]).unwrap();
    });
    let error = controller_version(&address).unwrap_err().to_string();
    assert!(
        error.contains(&address) && error.contains("it sent \"SSH-2.0-OpenSSH_9.2"),
        "{error}"
    );
    greeting.join().unwrap();
}
