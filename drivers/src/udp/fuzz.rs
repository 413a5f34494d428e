//! Fuzz target for datagrams of an arm, a base and a range scanner, and for those that drive a
//! base.

use super::reader::DatagramReader;
use super::scanner::UdpScanner;
use super::sequence::SequenceTracker;
use crate::RangePoint;
use crate::base_motion::BaseVelocity;
use crate::datagrams::receiver::ReceivedDatagram;
use crate::wire::base_drive::{decode_command, decode_reply, encode_command, encode_reply};
use crate::wire::datagram::{
    Clock, DatagramHeader, JointsDatagram, PoseDatagram, ScanPart, decode_joints, decode_pose,
    encode_joints, encode_pose, encode_scan,
};
use kinematics::{Stamp, Transform};
use std::cell::RefCell;
use std::time::Duration;

/// Arrival time of the first datagram. Stamps in the seeds are close to it.
pub(crate) const START_TIME: Stamp = Stamp(1_000_000_000_000);
/// Limit of received values and of each point coordinate, in meters, radians or the unit of a
/// joint.
const MAX_ABS_VALUE: f64 = 1e4;

/// An arm with three joints, a base, and a scanner named `lidar`. Data from their sockets are not
/// used.
struct Readers {
    names: Vec<String>,
    arm: DatagramReader,
    base: DatagramReader,
    scanner: UdpScanner,
}

thread_local! {
    /// Sockets are opened once. Their state is reset for each input.
    static READERS: RefCell<Readers> = RefCell::new(Readers::new());
}

impl Readers {
    fn new() -> Self {
        let any = "127.0.0.1:0".parse().expect("an address");
        let open = |device, plural| DatagramReader::open(device, plural, any).expect("a free port");
        Self {
            names: ["a", "b", "c"].map(str::to_owned).to_vec(),
            arm: open("arm", "joint states"),
            base: open("base", "poses"),
            scanner: UdpScanner::open("lidar", any).expect("a free port"),
        }
    }
}

/// Reads datagrams, one per line and one millisecond apart. A line with an integer lets that many
/// milliseconds pass instead.
///
/// Checks that stamps of each device increase and are recent, and that values are within the limits
/// of the format.
pub fn datagrams(bytes: &[u8]) {
    joint_states(bytes);
}

/// Reads a line as a command to a base, and as its reply. Accepted messages must have possible
/// velocities, and be unchanged after encoding and decoding.
fn check_driving(line: &[u8]) {
    let is_possible = |velocity: BaseVelocity| velocity.is_finite() && velocity.speed_m_s() < 200.0;
    if let Ok(command) = decode_command(line) {
        assert!(is_possible(command.velocity), "{command:?}");
        let is_stop = command.velocity == BaseVelocity::ZERO;
        assert!(is_stop || command.expires_nanos.is_some(), "{command:?}");
        assert_eq!(decode_command(&encode_command(&command)), Ok(command));
    }
    if let Ok(reply) = decode_reply(line) {
        assert!(is_possible(reply.velocity), "{reply:?}");
        assert_eq!(decode_reply(&encode_reply(&reply)), Ok(reply));
    }
}

/// Positions of the arm's joints received in the datagrams; see [`datagrams`].
pub(crate) fn joint_states(bytes: &[u8]) -> Vec<Vec<f64>> {
    READERS.with_borrow_mut(|readers| {
        let Readers {
            names,
            arm,
            base,
            scanner,
        } = readers;
        arm.sequence = SequenceTracker::default();
        base.sequence = SequenceTracker::default();
        scanner.reset();
        let mut at = START_TIME;
        let mut newest = [None; 3];
        let mut reported = Vec::new();
        for line in bytes.split(|byte| *byte == b'\n') {
            check_driving(line);
            let millis = str::from_utf8(line)
                .ok()
                .and_then(|line| line.parse::<u32>().ok());
            at += Duration::from_millis(millis.unwrap_or(1).into());
            let datagram = ReceivedDatagram {
                at,
                from: ([127, 0, 0, 1], 7).into(),
                bytes: line.to_vec(),
                n_dropped: 0,
            };
            let read = arm.take(&datagram, |bytes| decode_joints(bytes, names));
            if let Some((stamp, state)) = read {
                assert_monotonic(&mut newest[0], stamp, at);
                assert_eq!(state.position.len(), names.len());
                let numbers = state
                    .position
                    .iter()
                    .chain(&state.velocity)
                    .chain(&state.effort);
                assert!(
                    numbers
                        .into_iter()
                        .all(|number| number.abs() <= MAX_ABS_VALUE),
                    "{state:?}"
                );
                reported.push(state.position);
            }
            let decode = |bytes: &[u8]| {
                decode_pose(bytes).map(
                    |PoseDatagram {
                         header,
                         world_from_base,
                         ..
                     }| (header, Some(world_from_base)),
                )
            };
            if let Some((stamp, pose)) = base.take(&datagram, decode) {
                assert_monotonic(&mut newest[1], stamp, at);
                assert!(pose.translation.vector.amax() <= MAX_ABS_VALUE, "{pose:?}");
                assert!(
                    (pose.rotation.quaternion().norm() - 1.0).abs() < 1e-9,
                    "{pose:?}"
                );
            }
            scanner.take(&datagram);
            while let Some(scan) = scanner.completed.pop_front() {
                assert_monotonic(&mut newest[2], scan.stamp, at);
                let coordinates = scan.points.iter().flat_map(|point| point.position_m);
                assert!(
                    coordinates
                        .into_iter()
                        .all(|along| f64::from(along.abs()) <= MAX_ABS_VALUE),
                    "{scan:?}"
                );
            }
        }
        reported
    })
}

/// Checks that a stamp is after the previous one and not after its arrival, except for rounding.
fn assert_monotonic(newest: &mut Option<Stamp>, stamp: Stamp, arrival: Stamp) {
    assert!(
        newest.is_none_or(|newest| stamp > newest),
        "{newest:?}, then {stamp:?}"
    );
    assert!(
        stamp.secs_since(arrival) <= 1e-3,
        "{stamp:?} arrived at {arrival:?}"
    );
    *newest = Some(stamp);
}

/// Datagrams that an arm, a base and a scanner send in 30 ms.
pub(crate) fn example_traffic() -> Vec<Vec<u8>> {
    let names = ["a", "b", "c"].map(str::to_owned);
    let mut lines = Vec::new();
    for seq in 0..10_u32 {
        let stamp_nanos = START_TIME.0 + i64::from(seq) * 3_000_000;
        let header = DatagramHeader {
            seq: seq.into(),
            clock: Clock::Monotonic,
            stamp_nanos,
        };
        let position = [0.0, 1.0, 2.0]
            .map(|zero| zero + 0.01 * f64::from(seq))
            .to_vec();
        let joints = JointsDatagram {
            header,
            position,
            velocity: vec![0.5; 3],
            effort: Vec::new(),
        };
        lines.push(encode_joints(&joints, &names));
        let header = DatagramHeader {
            clock: Clock::Device,
            ..header
        };
        let world_from_base = Transform::translation(0.1 * f64::from(seq), 0.0, 0.5);
        lines.push(encode_pose(&PoseDatagram {
            header,
            world_from_base,
            covariance: None,
        }));
        let point = RangePoint {
            position_m: [1.0, -2.0, 0.5],
            ring: 3,
            offset_micros: 7,
        };
        let header = DatagramHeader {
            seq: u64::from(seq / 2),
            stamp_nanos: i64::from(seq / 2) * 6_000_000,
            ..header
        };
        let part = ScanPart {
            header,
            frame: "lidar".to_owned(),
            part: seq % 2,
            n_parts: 2,
            points: vec![point; 2],
        };
        lines.push(encode_scan(&part));
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use numbers::random::Random;

    #[test]
    fn corrupted_datagrams_move_no_joint() {
        let lines = example_traffic();
        let reported = joint_states(&lines.join(&b'\n'));
        assert_eq!(reported.len(), 10);
        let read = |lines: &[Vec<u8>]| {
            let read = joint_states(&lines.join(&b'\n'));
            assert!(
                read.iter().all(|positions| reported.contains(positions)),
                "{read:?}"
            );
            read.len()
        };
        let doubled: Vec<_> = lines
            .iter()
            .flat_map(|line| [line.clone(), line.clone()])
            .collect();
        assert_eq!(read(&doubled), 10, "duplicates are ignored");
        let mut random = Random::new(2);
        for _ in 0..50 {
            let mut shuffled = lines.clone();
            random.shuffle(&mut shuffled);
            assert!(read(&shuffled) <= 10);
        }
        for n_bytes in 0..lines[0].len() {
            let cut: Vec<_> = lines
                .iter()
                .map(|line| line[..line.len().min(n_bytes)].to_vec())
                .collect();
            assert_eq!(read(&cut), 0, "{n_bytes} bytes");
        }
        let doubled_payload: Vec<_> = lines.iter().map(|line| line.repeat(2)).collect();
        assert_eq!(
            read(&doubled_payload),
            0,
            "two messages in one datagram are rejected"
        );
    }
}
