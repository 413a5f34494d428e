//! Joint states, base poses and range scans as datagrams, each when it was said.

use super::{Clockwork, Script};
use drivers::clock;
use drivers::wire::datagram::{
    Clock, Head, JointsDatagram, PoseDatagram, ScanPart, encode_joints, encode_pose, encode_scan,
};
use drivers::{BasePose, Error, RangeScan};
use kinematics::{JointState, Stamp};
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Echoes in one datagram: as JSON they take about 60 bytes each, and 65 507 fit.
const MAX_POINTS: usize = 1000;
/// How soon the thread notices that it is to stop.
const POLL: Duration = Duration::from_millis(50);

/// Who listens to what.
#[derive(Clone, Debug, Default)]
pub struct Listeners {
    /// To the joints of these names.
    pub joints: Option<(SocketAddr, Vec<String>)>,
    /// To the base's poses.
    pub base: Option<SocketAddr>,
    /// To scanners, by name.
    pub scanners: Vec<(String, SocketAddr)>,
}

/// A thread that sends until the script is over or it is dropped.
#[derive(Debug)]
pub struct PlayedSenders {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl PlayedSenders {
    /// Begins to wait for the first datagram's time.
    pub fn start(script: &Script, clockwork: Clockwork, listeners: Listeners) -> Result<Self, Error> {
        let device = "played datagrams".to_owned();
        let any = SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0));
        let socket = UdpSocket::bind(any);
        let socket = socket.map_err(|source| Error::Listen { device: device.clone(), address: any, source })?;
        let mut datagrams = datagrams(script, clockwork, &listeners);
        datagrams.sort_by_key(|datagram| datagram.due);
        let stop = Arc::new(AtomicBool::new(false));
        let stopping = Arc::clone(&stop);
        let send = move || {
            for Datagram { due, to, bytes } in datagrams {
                loop {
                    if stopping.load(Ordering::Relaxed) {
                        return;
                    }
                    let left = due.duration_since(clock::now());
                    if left.is_zero() {
                        break;
                    }
                    std::thread::sleep(left.min(POLL));
                }
                // Nobody may listen yet, or any more.
                let _ = socket.send_to(&bytes, to);
            }
        };
        let thread = std::thread::Builder::new().name(device.clone()).spawn(send);
        let thread = thread.map_err(|source| Error::Thread { device, source })?;
        Ok(Self { stop, thread: Some(thread) })
    }
}

impl Drop for PlayedSenders {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has said so.
            let _ = thread.join();
        }
    }
}

struct Datagram {
    due: Stamp,
    to: SocketAddr,
    bytes: Vec<u8>,
}

/// Everything that is sent, and when.
fn datagrams(script: &Script, clockwork: Clockwork, listeners: &Listeners) -> Vec<Datagram> {
    let head = |seq: usize, stamp: Stamp| Head {
        seq: seq as u64,
        clock: Clock::Monotonic,
        stamp_nanos: clockwork.played_at(stamp).0,
    };
    let mut all = Vec::new();
    if let Some((to, names)) = &listeners.joints {
        all.extend(script.joints.iter().enumerate().map(|(seq, state)| {
            let JointState { stamp, position, velocity, effort } = state.clone();
            let joints = JointsDatagram { head: head(seq, stamp), position, velocity, effort };
            Datagram { due: clockwork.played_at(stamp), to: *to, bytes: encode_joints(&joints, names) }
        }));
    }
    if let Some(to) = listeners.base {
        all.extend(script.poses.iter().enumerate().map(|(seq, BasePose { stamp, world_from_base })| {
            let pose = PoseDatagram { head: head(seq, *stamp), world_from_base: *world_from_base };
            Datagram { due: clockwork.played_at(*stamp), to, bytes: encode_pose(&pose) }
        }));
    }
    for (name, to) in &listeners.scanners {
        let turns = script.scans.iter().filter(|scan| *scan.scanner == **name);
        for (seq, RangeScan { stamp, points, .. }) in turns.enumerate() {
            let last_micros = points.iter().map(|point| point.offset_micros).max().unwrap_or(0);
            let due = clockwork.played_at(stamp.plus_secs(f64::from(last_micros) * 1e-6));
            let chunks: Vec<_> =
                if points.is_empty() { vec![&points[..]] } else { points.chunks(MAX_POINTS).collect() };
            let n_parts = u32::try_from(chunks.len()).unwrap_or(u32::MAX);
            for (part, points) in (0..).zip(chunks) {
                let points = points.to_vec();
                let scan = ScanPart { head: head(seq, *stamp), frame: name.clone(), part, n_parts, points };
                all.push(Datagram { due, to: *to, bytes: encode_scan(&scan) });
            }
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivers::udp::{UdpArm, UdpBase, UdpScanner};
    use drivers::{Arm, Base, RangePoint, RangeScanner};
    use kinematics::Transform;

    #[test]
    fn what_is_played_is_what_the_drivers_hear_stamped_when_it_was_so() {
        const MILLI: i64 = 1_000_000;
        let point = |ix: u16| RangePoint { position_m: [f32::from(ix), 1.0, 0.5], ring: 2, offset_micros: ix.into() };
        let script = Script {
            joints: vec![JointState {
                stamp: Stamp(5 * MILLI),
                position: vec![0.25, -1.5],
                velocity: vec![0.5, 0.0],
                effort: vec![],
            }],
            poses: vec![BasePose { stamp: Stamp(6 * MILLI), world_from_base: Transform::translation(1.0, 2.0, 3.0) }],
            scans: vec![RangeScan {
                scanner: "lidar".into(),
                stamp: Stamp(7 * MILLI),
                points: (0..2500).map(point).collect(),
            }],
        };
        let names: Vec<String> = vec!["a".into(), "b".into()];
        let free = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
        let mut arm = UdpArm::open(&names, free).expect("a free port");
        let mut base = UdpBase::open(free).expect("a free port");
        let mut scanner = UdpScanner::open("lidar", free).expect("a free port");
        let played = clock::now().plus_secs(0.05);
        let listeners = Listeners {
            joints: Some((arm.address(), names)),
            base: Some(base.address()),
            scanners: vec![("lidar".into(), scanner.address())],
        };
        let clockwork = Clockwork { scripted: Stamp(0), played };
        let _senders = PlayedSenders::start(&script, clockwork, listeners).expect("a socket");
        let wait = Duration::from_secs(5);
        let joints = arm.read(wait).expect("joints");
        assert_eq!(joints, JointState { stamp: clockwork.played_at(Stamp(5 * MILLI)), ..script.joints[0].clone() });
        let pose = base.next_pose(wait).expect("a pose");
        assert_eq!((pose.stamp, pose.world_from_base.translation.z), (clockwork.played_at(Stamp(6 * MILLI)), 3.0));
        let scan = scanner.next_scan(wait).expect("a scan");
        assert_eq!((scan.stamp, &scan.points), (clockwork.played_at(Stamp(7 * MILLI)), &script.scans[0].points));
    }
}
