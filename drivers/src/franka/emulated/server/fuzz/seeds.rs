//! States of an emulated robot and messages of a client; the seeds of two fuzz targets.

use super::{FIRST, REST_RAD, server};
use crate::franka::emulated::{Joints, Limits};
use franka::FciVersion;
use franka::wire::HeaderLayout;
use franka::wire::robot::{v5, v10};
use zerocopy::IntoBytes;
use zerocopy::little_endian::{F64, U64};

/// States of a robot whose joints move a little from each state to the next.
pub(crate) fn state_datagrams(version: FciVersion, n: u32) -> Vec<Vec<u8>> {
    let limits = if version == FciVersion::V5 {
        Limits::panda()
    } else {
        Limits::fr3()
    };
    let mut server = server(version, limits);
    let mut states = Vec::new();
    for ix in 0..n {
        let position_rad = REST_RAD.map(|rest| rest + 0.002 * f64::from(ix));
        server.robot.observe(Joints {
            position_rad,
            ..Joints::default()
        });
        states.push(server.robot.state(FIRST + u64::from(ix)));
    }
    states
}

fn record(kind: u8, bytes: &[u8]) -> Vec<u8> {
    let length = u16::try_from(bytes.len())
        .expect("shorter than 64 kB")
        .to_le_bytes();
    [&[kind], &length[..], bytes].concat()
}

fn message(command: u32, payload: &[u8]) -> Vec<u8> {
    let mut bytes = HeaderLayout::Robot.encode_header(command, 1, payload.len());
    bytes.extend(payload);
    record(0, &bytes)
}

/// A client that connects, sets a threshold, moves the joints a little and waits: records in the
/// format of [`super::client`].
pub(crate) fn example_traffic(version: FciVersion) -> Vec<Vec<u8>> {
    let (number, connect, collision, begin, n_begin) = match version {
        FciVersion::V5 => (
            5_u16,
            v5::Command::Connect.to_u32(),
            v5::Command::SetCollisionBehavior.to_u32(),
            v5::Command::Move.to_u32(),
            size_of::<v5::MoveRequest>(),
        ),
        FciVersion::V10 => (
            10,
            v10::Command::Connect.to_u32(),
            v10::Command::SetCollisionBehavior.to_u32(),
            v10::Command::Move.to_u32(),
            size_of::<v10::MoveRequest>(),
        ),
    };
    let mut records = vec![message(connect, &[number.to_le_bytes(), [1, 2]].concat())];
    records.push(message(
        collision,
        &[0x40; size_of::<v10::SetCollisionBehaviorRequest>()],
    ));
    // Joint impedance and joint positions have number 0 in both versions.
    records.push(message(begin, &vec![0; n_begin]));
    for step in 0..12_u32 {
        // Within the jerk limits of both robots: a third of a microradian per cubic millisecond.
        let offset_rad = 3e-7 * f64::from(step.pow(3)) / 6.0;
        records.push(record(
            1,
            &command(version, FIRST + 2 + u64::from(step), offset_rad),
        ));
    }
    records.push([&[2_u8][..], &40_u16.to_le_bytes()].concat());
    records
}

fn command(version: FciVersion, number: u64, offset_rad: f64) -> Vec<u8> {
    let q_c = REST_RAD.map(|rest| F64::new(rest + offset_rad));
    match version {
        FciVersion::V5 => {
            let mut command = v5::RobotCommand {
                message_id: U64::new(number),
                ..Default::default()
            };
            command.motion.q_c = q_c;
            command.as_bytes().to_vec()
        }
        FciVersion::V10 => {
            let mut command = v10::RobotCommand {
                message_id: U64::new(number),
                ..Default::default()
            };
            command.motion.q_c = q_c;
            command.as_bytes().to_vec()
        }
    }
}
