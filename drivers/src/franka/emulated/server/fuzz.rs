//! Fuzz target: arbitrary messages and motion commands to an emulated robot.

pub(crate) mod seeds;

use super::super::{CommandedJoints, JointSimulator, Joints, Limits, RobotConfig};
use super::{Client, N_JOINTS, Robot, Server};
use crate::fuzz::input::take;
use franka::FciVersion;
use kinematics::{Chain, Stamp, Transform};
use std::io::{ErrorKind, Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream, UdpSocket};
use std::sync::{Arc, LazyLock};
use std::time::Duration;

static CHAIN: LazyLock<Chain> = LazyLock::new(|| {
    let urdf = include_str!("../../../../../kinematics/tests/data/panda.urdf");
    Chain::from_urdf(urdf, "link0", "link8").expect("the URDF is valid")
});
const REST_RAD: [f64; N_JOINTS] = [0.1, -0.5, 0.2, -2.0, 0.3, 1.8, 0.7];
/// Number of the first state.
pub(crate) const FIRST: u64 = 1_000_000;
/// Maximum number of milliseconds to simulate without a client action; a step takes 0.1 ms.
const MAX_STEPS: u16 = 500;

/// Executes concatenated client actions. Each starts with one byte for the kind and two bytes for
/// the length, little-endian.
///
/// Kind 0 sends that many bytes over TCP. Kind 1 sends them as a motion command over UDP. Kind 2
/// lets `length` milliseconds pass. Checks that the commanded joint positions never violate the
/// limits.
pub fn client(bytes: &[u8]) {
    for version in [FciVersion::V5, FciVersion::V10] {
        commanded(version, bytes);
    }
}

/// Commanded joint states before and after the actions, see [`client`].
pub(crate) fn commanded(
    version: FciVersion,
    mut bytes: &[u8],
) -> (CommandedJoints, CommandedJoints) {
    let limits = if version == FciVersion::V5 {
        Limits::panda()
    } else {
        Limits::fr3()
    };
    let mut server = server(version, limits.clone());
    let first = server.robot.commanded;
    let Some((mut stream, commands)) = connect(&mut server) else {
        return (first, first);
    };
    let mut number = FIRST;
    let mut n_remaining = MAX_STEPS;
    while !bytes.is_empty() {
        let [kind] = take(&mut bytes);
        let length = u16::from_le_bytes(take(&mut bytes));
        let mut n_steps = 1;
        if kind % 3 == 2 {
            // The total is bounded, so that an input of a few bytes cannot keep the fuzzer busy for
            // minutes.
            n_steps = length.min(n_remaining);
            n_remaining -= n_steps;
        } else {
            let (sent, rest) = bytes.split_at(bytes.len().min(length.into()));
            bytes = rest;
            // Writes may fail if the server disconnected or its buffers are full, as for any
            // client.
            let _ = match kind % 3 {
                0 => stream.write(sent),
                _ => commands.send(sent),
            };
        }
        for _ in 0..n_steps {
            let before = server.robot.commanded;
            server.step(Stamp(0), number, true);
            number += 1;
            check(&limits, &before, &server.robot.commanded);
            drain(&mut stream);
        }
    }
    (first, server.robot.commanded)
}

/// A robot whose joints follow their commands perfectly.
fn server(version: FciVersion, limits: Limits) -> Server {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a free port");
    let states = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("a free port");
    listener
        .set_nonblocking(true)
        .and_then(|()| states.set_nonblocking(true))
        .expect("an open socket");
    let address = listener.local_addr().expect("an open socket");
    let config = RobotConfig {
        address,
        version,
        chain: CHAIN.clone(),
        flange_from_tool: Transform::identity(),
        limits,
    };
    let joint_simulator: JointSimulator = Box::new(|_, commanded: &CommandedJoints| Joints {
        position_rad: commanded.position_rad,
        velocity_rad_s: commanded.velocity_rad_s,
        ..Joints::default()
    });
    let robot = Robot::new(
        config,
        Joints {
            position_rad: REST_RAD,
            ..Joints::default()
        },
    );
    Server {
        listener,
        states,
        robot,
        joint_simulator,
        answer_wait: Duration::ZERO,
        client: None,
        n_states_sent: Arc::default(),
        stop: Arc::default(),
    }
}

/// A client accepted by the server, and its socket for commands.
fn connect(server: &mut Server) -> Option<(TcpStream, UdpSocket)> {
    let stream = TcpStream::connect(server.listener.local_addr().ok()?).ok()?;
    stream.set_nonblocking(true).ok()?;
    let commands = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).ok()?;
    commands.connect(server.states.local_addr().ok()?).ok()?;
    for _ in 0..100 {
        server.accept_client();
        if let Some(Client { .. }) = server.client {
            return Some((stream, commands));
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    None
}

/// Reads what the server sent, so that its replies do not fill the buffer.
fn drain(stream: &mut TcpStream) {
    let mut buffer = [0; 4096];
    loop {
        match stream.read(&mut buffer) {
            Ok(n) if n == buffer.len() => {}
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            _ => return,
        }
    }
}

/// Checks that positions are finite and change no more than the velocity limits allow in a
/// millisecond.
fn check(limits: &Limits, before: &CommandedJoints, now: &CommandedJoints) {
    for ix in 0..N_JOINTS {
        let moved_rad = (now.position_rad[ix] - before.position_rad[ix]).abs();
        assert!(
            moved_rad <= limits.velocity_rad_s[ix] * 1e-3 + 1e-7,
            "joint {ix}: {before:?}, then {now:?}"
        );
    }
}

#[cfg(test)]
mod tests {
    use super::seeds::example_traffic;
    use super::*;
    use numbers::random::Random;

    #[test]
    fn only_a_started_motion_moves_joints() {
        let mut random = Random::new(4);
        for version in crate::franka::fuzz::VERSIONS {
            let records = example_traffic(version);
            let (first, last) = commanded(version, &records.concat());
            assert_ne!(
                first.position_rad, last.position_rad,
                "the motion that is corrupted below: {version:?}"
            );
            // The record that starts the motion is left out. The others are sent in any order,
            // truncated or duplicated.
            for round in 0..30 {
                let mut corrupted: Vec<_> = records
                    .iter()
                    .filter(|record| **record != records[2])
                    .cloned()
                    .collect();
                random.shuffle(&mut corrupted);
                match round % 3 {
                    0 => {
                        corrupted = corrupted
                            .iter()
                            .flat_map(|record| [record.clone(), record.clone()])
                            .collect()
                    }
                    1 => corrupted
                        .iter_mut()
                        .for_each(|record| record.truncate(record.len() / 2)),
                    _ => {}
                }
                let (first, last) = commanded(version, &corrupted.concat());
                assert_eq!(
                    first.position_rad, last.position_rad,
                    "{version:?}, round {round}"
                );
            }
        }
    }
}
