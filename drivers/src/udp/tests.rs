//! Tests over a real socket of the loopback interface.

use super::{DatagramCounts, UdpArm, UdpBase, UdpScanner};
use crate::wire::datagram::{
    Clock, DatagramHeader, JointsDatagram, PoseDatagram, ScanPart, encode_joints, encode_pose,
    encode_scan,
};
use crate::{
    Arm, Base, Devices, Error, LiveDevices, RangePoint, RangeScanner, Sample, Source, clock,
};
use kinematics::Transform;
use std::net::{SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

/// Timeout for events that must happen; long because a machine may be busy.
const LONG_TIMEOUT: Duration = Duration::from_secs(20);
/// Timeout for events that must not happen.
const SHORT_TIMEOUT: Duration = Duration::from_millis(150);
/// Limits for accepted poses, meters and radians.
const MAX_SIGMA: [f64; 2] = [0.05, 0.03];
const FREE_PORT: &str = "127.0.0.1:0";

fn sender(to: SocketAddr) -> impl Fn(&[u8]) {
    let socket = UdpSocket::bind(FREE_PORT).unwrap();
    move |bytes| assert_eq!(socket.send_to(bytes, to).unwrap(), bytes.len())
}

fn scanner() -> (UdpScanner, impl Fn(&[u8])) {
    let scanner = UdpScanner::open("lidar", FREE_PORT.parse().unwrap()).unwrap();
    let send = sender(scanner.address());
    (scanner, send)
}

fn now(seq: u64) -> DatagramHeader {
    DatagramHeader {
        seq,
        clock: Clock::Monotonic,
        stamp_nanos: clock::now().0,
    }
}

/// A part of a scan with one point at the given distance.
fn part(header: DatagramHeader, part: u32, n_parts: u32, range_m: f32) -> Vec<u8> {
    let point = RangePoint {
        position_m: [range_m, 0.0, 0.0],
        ring: 2,
        offset_micros: 5,
    };
    encode_scan(&ScanPart {
        header,
        frame: "lidar".into(),
        part,
        n_parts,
        points: vec![point],
    })
}

fn ranges(scanner: &mut UdpScanner) -> Vec<f32> {
    scanner
        .next_scan(LONG_TIMEOUT)
        .unwrap()
        .points
        .iter()
        .map(|point| point.position_m[0])
        .collect()
}

fn pose(header: DatagramHeader, x_m: f64) -> Vec<u8> {
    encode_pose(&PoseDatagram {
        header,
        world_from_base: Transform::translation(x_m, 0.0, 0.0),
        covariance: None,
    })
}

#[test]
fn scans_are_assembled_with_stamps() {
    let (mut scanner, send) = scanner();
    let header = now(0);
    send(&part(header, 0, 1, 1.5));
    let scan = scanner.next_scan(LONG_TIMEOUT).unwrap();
    assert_eq!(
        (&*scan.scanner, scan.stamp.0),
        ("lidar", header.stamp_nanos)
    );
    let expected = RangePoint {
        position_m: [1.5, 0.0, 0.0],
        ring: 2,
        offset_micros: 5,
    };
    assert_eq!(*scan.points, [expected]);
    // Parts may arrive in any order.
    let header = now(1);
    for (ix, range_m) in [(2, 3.0), (0, 1.0), (1, 2.0)] {
        send(&part(header, ix, 3, range_m));
    }
    assert_eq!(ranges(&mut scanner), [1.0, 2.0, 3.0]);
    // With a device clock, the first stamp is the arrival time.
    let before = clock::now();
    send(&part(
        DatagramHeader {
            seq: 2,
            clock: Clock::Device,
            stamp_nanos: -77,
        },
        0,
        1,
        1.0,
    ));
    let scan = scanner.next_scan(LONG_TIMEOUT).unwrap();
    assert!(scan.stamp > before && scan.stamp <= clock::now());
    assert_eq!(
        scanner.counts(),
        DatagramCounts {
            n_received: 5,
            ..DatagramCounts::default()
        }
    );
}

#[test]
fn lost_duplicate_and_late_scans_are_counted() {
    let (mut scanner, send) = scanner();
    let (first, second, fifth, sixth) = (now(1), now(2), now(5), now(6));
    send(&part(first, 0, 1, 1.0));
    send(&part(first, 0, 1, 1.0)); // Duplicate.
    send(&part(second, 0, 2, 2.0)); // The other half is lost ...
    send(&part(second, 0, 2, 2.0)); // ... and this one is a duplicate.
    send(&part(fifth, 1, 2, 5.0)); // Two scans before it are lost.
    send(&part(second, 1, 2, 2.5)); // Late.
    send(&part(fifth, 0, 3, 5.0)); // Contradicts the other part.
    send(&part(fifth, 0, 2, 4.5));
    send(&part(sixth, 0, 1, 6.0));
    assert_eq!(ranges(&mut scanner), [1.0]);
    assert_eq!(ranges(&mut scanner), [2.0]);
    assert_eq!(ranges(&mut scanner), [4.5, 5.0]);
    assert_eq!(ranges(&mut scanner), [6.0]);
    let expected = DatagramCounts {
        n_received: 9,
        n_rejected: 1,
        n_lost: 3,
        n_late: 3,
        ..DatagramCounts::default()
    };
    assert_eq!(scanner.counts(), expected);
}

#[test]
fn malformed_datagrams_are_rejected() {
    let (mut scanner, send) = scanner();
    let good = part(now(0), 0, 1, 1.0);
    let mut n_sent = 0;
    let mut junk = |bytes: &[u8]| {
        send(bytes);
        n_sent += 1;
    };
    junk(b"");
    junk(b"null");
    junk(&[0xff; 1400]);
    junk(&vec![b'['; 60_000]);
    for end in [1, good.len() / 3, good.len() - 1] {
        junk(&good[..end]);
    }
    junk(&pose(now(0), 1.0));
    junk(&part(
        DatagramHeader {
            stamp_nanos: i64::MAX,
            ..now(3)
        },
        0,
        1,
        1.0,
    ));
    junk(&part(
        DatagramHeader {
            stamp_nanos: i64::MIN,
            ..now(4)
        },
        0,
        1,
        1.0,
    ));
    junk(
        String::from_utf8(part(now(5), 0, 1, 1.0))
            .unwrap()
            .replace("lidar", "radar")
            .as_bytes(),
    );
    junk(&part(
        DatagramHeader {
            seq: u64::MAX,
            clock: Clock::Monotonic,
            stamp_nanos: 0,
        },
        0,
        1,
        1.0,
    ));
    let n_junk = n_sent;
    send(&part(now(0), 0, 1, 7.0));
    assert_eq!(ranges(&mut scanner), [7.0]);
    let counts = scanner.counts();
    assert_eq!((counts.n_received, counts.n_rejected), (n_junk + 1, n_junk));
    // The wait also ends if only invalid datagrams arrive.
    for _ in 0..1000 {
        send(b"?");
    }
    let started = Instant::now();
    let timeout_error = scanner.next_scan(SHORT_TIMEOUT).unwrap_err();
    assert!(
        matches!(timeout_error, Error::NoScan { .. }),
        "{timeout_error}"
    );
    assert!(started.elapsed() < LONG_TIMEOUT);
}

#[test]
fn base_poses_are_ordered_and_drop_frees_port() {
    let mut base = UdpBase::open(FREE_PORT.parse().unwrap(), MAX_SIGMA).unwrap();
    let (address, send) = (base.address(), sender(base.address()));
    assert!(matches!(
        base.next_pose(SHORT_TIMEOUT),
        Err(Error::NoBasePose { .. })
    ));
    let heads: Vec<DatagramHeader> = (0..4).map(now).collect();
    for ix in [0, 1, 1, 3, 2] {
        send(&pose(heads[ix], ix as f64));
    }
    for ix in [0, 1, 3] {
        let reported = base.next_pose(LONG_TIMEOUT).unwrap();
        assert_eq!(
            (reported.stamp.0, reported.world_from_base.translation.x),
            (heads[ix].stamp_nanos, ix as f64)
        );
    }
    assert!(base.next_pose(SHORT_TIMEOUT).is_err());
    let expected = DatagramCounts {
        n_received: 5,
        n_lost: 1,
        n_late: 2,
        ..DatagramCounts::default()
    };
    assert_eq!(base.counts(), expected);
    let taken = UdpBase::open(address, MAX_SIGMA).unwrap_err();
    assert!(taken.to_string().contains(&address.to_string()), "{taken}");
    drop(base);
    UdpBase::open(address, MAX_SIGMA).unwrap();
}

#[test]
fn uncertain_poses_are_skipped_and_counted() {
    let mut base = UdpBase::open(FREE_PORT.parse().unwrap(), MAX_SIGMA).unwrap();
    let send = sender(base.address());
    let header: Vec<DatagramHeader> = (0..5).map(now).collect();
    let reported = |ix: usize, sigma_m: f64, sigma_rad: f64| {
        let mut covariance = Box::new([0.0; 36]);
        (covariance[0], covariance[28]) = (sigma_m * sigma_m, sigma_rad * sigma_rad);
        let world_from_base = Transform::translation(ix as f64, 0.0, 0.0);
        encode_pose(&PoseDatagram {
            header: header[ix],
            world_from_base,
            covariance: Some(covariance),
        })
    };
    let [max_m, max_rad] = MAX_SIGMA;
    send(&reported(0, 0.9 * max_m, 0.9 * max_rad));
    send(&reported(1, 1.1 * max_m, 0.0));
    send(&reported(2, 0.0, 1.1 * max_rad));
    send(&pose(header[3], 3.0));
    for ix in [0, 3] {
        assert_eq!(
            base.next_pose(LONG_TIMEOUT)
                .unwrap()
                .world_from_base
                .translation
                .x,
            f64::from(ix)
        );
    }
    send(&reported(4, 1.0, 0.0));
    assert!(base.next_pose(SHORT_TIMEOUT).is_err());
    assert_eq!(
        base.counts(),
        DatagramCounts {
            n_received: 5,
            n_uncertain: 3,
            ..DatagramCounts::default()
        }
    );
}

#[test]
fn joint_states_are_ordered_and_other_joints_ignored() {
    let names = ["shoulder", "elbow"].map(str::to_owned);
    let mut arm = UdpArm::open(&names, FREE_PORT.parse().unwrap()).unwrap();
    let send = sender(arm.address());
    assert_eq!(arm.joint_names(), names);
    let state = |header, at: f64| JointsDatagram {
        header,
        position: vec![at, -at],
        velocity: vec![],
        effort: vec![at; 2],
    };
    let other_names = ["left", "right"].map(str::to_owned);
    let heads: Vec<DatagramHeader> = (0..4).map(now).collect();
    for ix in [0, 2, 1, 3] {
        let (of_hand, of_arm) = (
            DatagramHeader {
                seq: 2 * ix as u64,
                ..heads[ix]
            },
            DatagramHeader {
                seq: 2 * ix as u64 + 1,
                ..heads[ix]
            },
        );
        send(&encode_joints(&state(of_hand, 9.0), &other_names));
        send(&encode_joints(&state(of_arm, ix as f64), &names));
    }
    for ix in [0, 2, 3] {
        let reported = arm.read(LONG_TIMEOUT).unwrap();
        let at = ix as f64;
        assert_eq!(
            (reported.stamp.0, reported.position, reported.effort),
            (heads[ix].stamp_nanos, vec![at, -at], vec![at; 2])
        );
        assert!(reported.velocity.is_empty());
    }
    assert!(matches!(
        arm.read(SHORT_TIMEOUT),
        Err(Error::NoJoints { .. })
    ));
    let expected = DatagramCounts {
        n_received: 8,
        n_other: 3,
        n_lost: 2,
        n_late: 2,
        ..DatagramCounts::default()
    };
    assert_eq!(arm.counts(), expected);
    let unmatched_names = arm.monitor().unmatched_names().unwrap();
    let of_arm = names.join(", ");
    assert_eq!(
        unmatched_names,
        format!("names has left, right, and arm.joints has {of_arm}")
    );
}

#[test]
fn only_one_sender_is_received_from() {
    let mut arm = UdpArm::open(&["shoulder".to_owned()], FREE_PORT.parse().unwrap()).unwrap();
    let [first, second] = [sender(arm.address()), sender(arm.address())];
    let state = |seq, at: f64| {
        let state = JointsDatagram {
            header: now(seq),
            position: vec![at],
            velocity: vec![],
            effort: vec![],
        };
        encode_joints(&state, &["shoulder".to_owned()])
    };
    first(&state(0, 0.25));
    assert_eq!(arm.read(LONG_TIMEOUT).unwrap().position, [0.25]);
    for seq in 1..50 {
        second(&state(1000 * seq, 1.0));
        first(&state(seq, 0.25));
        assert_eq!(arm.read(LONG_TIMEOUT).unwrap().position, [0.25]);
    }
    assert_eq!(
        arm.counts(),
        DatagramCounts {
            n_received: 99,
            n_foreign: 49,
            ..DatagramCounts::default()
        }
    );
}

#[test]
fn sender_with_a_new_socket_for_each_datagram_is_received_from() {
    let names = ["shoulder".to_owned()];
    let mut arm = UdpArm::open(&names, FREE_PORT.parse().unwrap()).unwrap();
    assert!(
        arm.read(SHORT_TIMEOUT).is_err(),
        "older datagrams are discarded by the first read"
    );
    // All sockets stay open, so that their ports differ.
    let sockets: Vec<_> = (0..30).map(|_| sender(arm.address())).collect();
    for (seq, send) in (0..).zip(&sockets) {
        let state = JointsDatagram {
            header: now(seq),
            position: vec![0.25],
            velocity: vec![],
            effort: vec![],
        };
        send(&encode_joints(&state, &names));
    }
    for ix in 0..27 {
        assert_eq!(arm.read(LONG_TIMEOUT).unwrap().position, [0.25], "{ix}");
    }
    assert!(arm.read(SHORT_TIMEOUT).is_err(), "three were ignored");
    let expected = DatagramCounts {
        n_received: 30,
        n_foreign: 3,
        n_lost: 3,
        ..DatagramCounts::default()
    };
    assert_eq!(arm.counts(), expected);
}

#[test]
fn monitors_report_counts_and_the_last_rejection() {
    let mut arm = UdpArm::open(&["shoulder".to_owned()], FREE_PORT.parse().unwrap()).unwrap();
    let mut base = UdpBase::open(FREE_PORT.parse().unwrap(), MAX_SIGMA).unwrap();
    let (mut scanner, send_scan) = scanner();
    let monitors = [arm.monitor(), base.monitor(), scanner.monitor()];
    assert_eq!(
        monitors.each_ref().map(|monitor| monitor.device()),
        ["arm", "base", "range scanner \"lidar\""]
    );
    let addresses = [arm.address(), base.address(), scanner.address()];
    assert_eq!(
        monitors.each_ref().map(|monitor| monitor.address()),
        addresses
    );
    let mut read_all = || {
        assert!(arm.read(SHORT_TIMEOUT).is_err() && base.next_pose(SHORT_TIMEOUT).is_err());
        assert!(scanner.next_scan(SHORT_TIMEOUT).is_err());
    };
    read_all(); // The first read discards older datagrams.
    assert!(
        monitors
            .iter()
            .all(|monitor| monitor.counts().n_received == 0 && monitor.last_rejection().is_none())
    );
    sender(addresses[0])(b"{\"kind\":\"joints\"}");
    sender(addresses[1])(&pose(
        DatagramHeader {
            stamp_nanos: i64::MAX,
            ..now(0)
        },
        1.0,
    ));
    send_scan(&part(
        DatagramHeader {
            stamp_nanos: i64::MAX,
            ..now(0)
        },
        0,
        1,
        1.0,
    ));
    let started = Instant::now();
    while monitors
        .iter()
        .any(|monitor| monitor.counts().n_received == 0)
    {
        read_all();
        assert!(started.elapsed() < LONG_TIMEOUT, "{monitors:?}");
    }
    let expected = DatagramCounts {
        n_received: 1,
        n_rejected: 1,
        ..DatagramCounts::default()
    };
    assert!(
        monitors.iter().all(|monitor| monitor.counts() == expected),
        "{monitors:?}"
    );
    let reasons = monitors.map(|monitor| monitor.last_rejection().unwrap());
    assert!(
        !reasons[0].is_empty()
            && reasons[1..]
                .iter()
                .all(|reason| reason.contains("\"device\"")),
        "{reasons:?}"
    );
}

#[test]
fn live_merges_devices_and_names_silent_one() {
    let (scanner, send_scan) = scanner();
    let base = UdpBase::open(FREE_PORT.parse().unwrap(), MAX_SIGMA).unwrap();
    let send_pose = sender(base.address());
    let devices = Devices {
        base: Some(Box::new(base)),
        scanners: vec![Box::new(scanner)],
        ..Devices::default()
    };
    let mut live = LiveDevices::new(devices).unwrap();
    for seq in 0..3 {
        send_pose(&pose(now(seq), 0.0));
        send_scan(&part(now(seq), 0, 1, 1.0));
    }
    let mut n = [0; 2];
    while n != [3, 3] {
        match live.next_sample().unwrap() {
            Some(Sample::Base(_)) => n[0] += 1,
            Some(Sample::Range(_)) => n[1] += 1,
            other => panic!("{other:?}"),
        }
    }
    let timeout_error = live.next_sample().unwrap_err();
    assert!(
        matches!(
            timeout_error,
            Error::NoScan { .. } | Error::NoBasePose { .. }
        ),
        "{timeout_error}"
    );
}
