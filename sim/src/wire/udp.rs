//! Sends joint states, base poses and range scans as datagrams at the times of the script.

use super::{DeviceScript, PlaybackClock};
use drivers::clock;
use drivers::wire::datagram::{
    Clock, DatagramHeader, JointsDatagram, PoseDatagram, ScanPart, encode_joints, encode_pose,
    encode_scan,
};
use drivers::{Error, RangeScan};
use kinematics::{JointState, Stamp};
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Maximum number of echoes per datagram. An echo takes about 60 bytes as JSON, and a datagram
/// holds at most 65 507 bytes.
const MAX_POINTS: usize = 1000;
/// Period at which the state at rest is resent. Receivers consider a sender lost if they receive
/// nothing. They also interpolate only between readings that are close in time.
const RESEND_PERIOD: Duration = Duration::from_millis(20);
/// Period at which the thread checks whether to stop.
const STOP_CHECK_PERIOD: Duration = Duration::from_millis(50);

/// Receivers of the datagrams.
#[derive(Clone, Debug, Default)]
pub struct DatagramTargets {
    /// Address for the joints, and their names.
    pub joints: Option<(SocketAddr, Vec<String>)>,
    /// Address for the base's poses.
    pub base: Option<SocketAddr>,
    /// Names and addresses of the scanners.
    pub scanners: Vec<(String, SocketAddr)>,
}

/// A thread that sends datagrams until this value is dropped.
#[derive(Debug)]
pub struct EmulatedSenders {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl EmulatedSenders {
    /// Starts sending. Before and after the playback, joints and base are at rest in the first and
    /// last state of the script.
    pub fn start(
        script: &DeviceScript,
        playback_clock: PlaybackClock,
        datagram_targets: DatagramTargets,
    ) -> Result<Self, Error> {
        let device = "emulated datagrams".to_owned();
        let any = SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0));
        let socket = UdpSocket::bind(any);
        let socket = socket.map_err(|source| Error::Listen {
            device: device.clone(),
            address: any,
            source,
        })?;
        let stop = Arc::new(AtomicBool::new(false));
        let sender = Sender {
            script: script.clone(),
            playback_clock,
            n_sent: vec![0; datagram_targets.scanners.len()],
            datagram_targets,
            socket,
            n_joints_sent: 0,
            n_poses_sent: 0,
            stop: Arc::clone(&stop),
        };
        let thread = std::thread::Builder::new()
            .name(device.clone())
            .spawn(move || sender.run());
        let thread = thread.map_err(|source| Error::Thread { device, source })?;
        Ok(Self {
            stop,
            thread: Some(thread),
        })
    }
}

impl Drop for EmulatedSenders {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // The panic hook has already reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

/// One sample of the script, by its index.
#[derive(Clone, Copy)]
enum ScriptEntry {
    Joints(usize),
    Pose(usize),
    /// Scanner index and scan index.
    Scan(usize, usize),
}

struct Sender {
    script: DeviceScript,
    playback_clock: PlaybackClock,
    datagram_targets: DatagramTargets,
    socket: UdpSocket,
    n_joints_sent: u64,
    n_poses_sent: u64,
    /// Number of scans sent, for each scanner. A scan may take several datagrams.
    n_sent: Vec<u64>,
    stop: Arc<AtomicBool>,
}

impl Sender {
    fn run(mut self) {
        let script_entries = self.script_entries();
        if let Some((first, _)) = script_entries.first() {
            // Before the script begins, the devices rest in its first state, so that a program can
            // connect.
            self.resend_end_state(0, *first);
        }
        for (due_stamp, script_entry) in script_entries {
            if !self.wait(due_stamp) {
                return;
            }
            match script_entry {
                ScriptEntry::Joints(ix) => self.send_joints(ix, due_stamp, false),
                ScriptEntry::Pose(ix) => self.send_pose(ix, due_stamp),
                ScriptEntry::Scan(scanner_ix, ix) => self.send_scan(scanner_ix, ix),
            }
        }
        // After the script, the devices rest in its last state until the senders are dropped.
        self.resend_end_state(usize::MAX, Stamp(i64::MAX));
    }

    /// The script in the order in which it is sent. Scans are sent when complete.
    fn script_entries(&self) -> Vec<(Stamp, ScriptEntry)> {
        let DeviceScript {
            joints,
            poses,
            scans,
        } = &self.script;
        let at = |stamp: Stamp| self.playback_clock.playback_stamp_of(stamp);
        let mut script_entries = Vec::new();
        if self.datagram_targets.joints.is_some() {
            script_entries.extend(
                joints
                    .iter()
                    .enumerate()
                    .map(|(ix, state)| (at(state.stamp), ScriptEntry::Joints(ix))),
            );
        }
        if self.datagram_targets.base.is_some() {
            script_entries.extend(
                poses
                    .iter()
                    .enumerate()
                    .map(|(ix, pose)| (at(pose.stamp), ScriptEntry::Pose(ix))),
            );
        }
        for (scanner_ix, (name, _)) in self.datagram_targets.scanners.iter().enumerate() {
            let revolutions = scans
                .iter()
                .enumerate()
                .filter(|(_, scan)| *scan.scanner == **name);
            script_entries.extend(revolutions.map(|(ix, RangeScan { stamp, points, .. })| {
                // A scan can only be sent after its last point was measured.
                let last_micros = points
                    .iter()
                    .map(|point| point.offset_micros)
                    .max()
                    .unwrap_or(0);
                (
                    at(stamp.plus_secs(f64::from(last_micros) * 1e-6)),
                    ScriptEntry::Scan(scanner_ix, ix),
                )
            }));
        }
        // The sort is stable, so entries that are due at the same time keep their order.
        script_entries.sort_by_key(|(due_stamp, _)| *due_stamp);
        script_entries
    }

    /// Repeatedly sends the first (`end` is 0) or last (`end` is `usize::MAX`) joint state and base
    /// pose of the script, until shortly before `until`.
    fn resend_end_state(&mut self, end: usize, until: Stamp) {
        let last = |n: usize| n.checked_sub(1).map(|last| last.min(end));
        let joints_ix = last(self.script.joints.len());
        let pose_ix = last(self.script.poses.len());
        let mut now = clock::now();
        // The last resent state comes at least one period before the script. Its stamp is therefore
        // below the stamp of the script's first entry.
        while now.plus_secs(RESEND_PERIOD.as_secs_f64()) < until {
            if let Some(ix) = joints_ix {
                self.send_joints(ix, now, true);
            }
            if let Some(ix) = pose_ix {
                self.send_pose(ix, now);
            }
            if !self.wait(now.plus_secs(RESEND_PERIOD.as_secs_f64())) {
                return;
            }
            now = clock::now();
        }
    }

    /// Waits until a time. Returns false if the thread should stop.
    fn wait(&self, due_stamp: Stamp) -> bool {
        loop {
            if self.stop.load(Ordering::Relaxed) {
                return false;
            }
            let left = due_stamp.duration_since(clock::now());
            if left.is_zero() {
                return true;
            }
            // The thread sleeps in short pieces, so that dropping the senders does not wait for a
            // distant entry.
            std::thread::sleep(left.min(STOP_CHECK_PERIOD));
        }
    }

    fn send_joints(&mut self, ix: usize, stamp: Stamp, is_at_rest: bool) {
        let Some((to, names)) = &self.datagram_targets.joints else {
            return;
        };
        let JointState {
            position,
            mut velocity,
            effort,
            ..
        } = self.script.joints[ix].clone();
        if is_at_rest {
            velocity.fill(0.0);
        }
        let joints = JointsDatagram {
            header: header(self.n_joints_sent, stamp),
            position,
            velocity,
            effort,
        };
        self.send(&encode_joints(&joints, names), *to);
        self.n_joints_sent += 1;
    }

    fn send_pose(&mut self, ix: usize, stamp: Stamp) {
        let Some(to) = self.datagram_targets.base else {
            return;
        };
        let world_from_base = self.script.poses[ix].world_from_base;
        self.send(
            &encode_pose(&PoseDatagram {
                header: header(self.n_poses_sent, stamp),
                world_from_base,
                covariance: None,
            }),
            to,
        );
        self.n_poses_sent += 1;
    }

    fn send_scan(&mut self, scanner_ix: usize, ix: usize) {
        let (name, to) = self.datagram_targets.scanners[scanner_ix].clone();
        let RangeScan { stamp, points, .. } = &self.script.scans[ix];
        let header = header(
            self.n_sent[scanner_ix],
            self.playback_clock.playback_stamp_of(*stamp),
        );
        let chunks: Vec<_> = if points.is_empty() {
            vec![&points[..]]
        } else {
            points.chunks(MAX_POINTS).collect()
        };
        // Every datagram contains the number of parts, so that a receiver notices lost datagrams.
        let n_parts = u32::try_from(chunks.len()).unwrap_or(u32::MAX);
        for (part, points) in (0..).zip(chunks) {
            let scan = ScanPart {
                header,
                frame: name.clone(),
                part,
                n_parts,
                points: points.to_vec(),
            };
            self.send(&encode_scan(&scan), to);
        }
        self.n_sent[scanner_ix] += 1;
    }

    fn send(&self, bytes: &[u8], to: SocketAddr) {
        // Sending may fail while there is no receiver.
        let _ = self.socket.send_to(bytes, to);
    }
}

fn header(seq: u64, stamp: Stamp) -> DatagramHeader {
    DatagramHeader {
        seq,
        clock: Clock::Monotonic,
        stamp_nanos: stamp.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivers::udp::{UdpArm, UdpBase, UdpScanner};
    use drivers::{Arm, Base, BasePose, RangePoint, RangeScanner};
    use kinematics::Transform;

    #[test]
    fn drivers_receive_the_emulated_samples_with_stamps() {
        const MILLI: i64 = 1_000_000;
        let point = |ix: u16| RangePoint {
            position_m: [f32::from(ix), 1.0, 0.5],
            ring: 2,
            offset_micros: ix.into(),
        };
        let script = DeviceScript {
            joints: vec![JointState {
                stamp: Stamp(5 * MILLI),
                position: vec![0.25, -1.5],
                velocity: vec![0.5, 0.0],
                effort: vec![],
            }],
            poses: vec![BasePose {
                stamp: Stamp(6 * MILLI),
                world_from_base: Transform::translation(1.0, 2.0, 3.0),
            }],
            scans: vec![RangeScan {
                scanner: "lidar".into(),
                stamp: Stamp(7 * MILLI),
                points: (0..2500).map(point).collect(),
            }],
        };
        let names: Vec<String> = vec!["a".into(), "b".into()];
        let free = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
        let mut arm = UdpArm::open(&names, free).expect("a free port");
        let mut base = UdpBase::open(free, [1.0; 2]).expect("a free port");
        let mut scanner = UdpScanner::open("lidar", free).expect("a free port");
        let emulated = clock::now().plus_secs(0.2);
        let datagram_targets = DatagramTargets {
            joints: Some((arm.address(), names)),
            base: Some(base.address()),
            scanners: vec![("lidar".into(), scanner.address())],
        };
        let playback_clock = PlaybackClock {
            scripted: Stamp(0),
            emulated,
        };
        let _senders =
            EmulatedSenders::start(&script, playback_clock, datagram_targets).expect("a socket");
        let wait = Duration::from_secs(5);
        let at_rest_state = arm.read(wait).expect("joints");
        assert_eq!(at_rest_state.position, script.joints[0].position);
        assert!(
            at_rest_state.stamp < playback_clock.playback_stamp_of(Stamp(0)),
            "sent before playback starts"
        );
        let mut joints = at_rest_state;
        while joints.stamp < playback_clock.playback_stamp_of(Stamp(0)) {
            joints = arm.read(wait).expect("joints");
        }
        assert_eq!(
            joints,
            JointState {
                stamp: playback_clock.playback_stamp_of(Stamp(5 * MILLI)),
                ..script.joints[0].clone()
            }
        );
        let mut pose = base.next_pose(wait).expect("a pose");
        while pose.stamp < playback_clock.playback_stamp_of(Stamp(0)) {
            pose = base.next_pose(wait).expect("a pose");
        }
        assert_eq!(
            (pose.stamp, pose.world_from_base.translation.z),
            (playback_clock.playback_stamp_of(Stamp(6 * MILLI)), 3.0)
        );
        let scan = scanner.next_scan(wait).expect("a scan");
        assert_eq!(
            (scan.stamp, &scan.points),
            (
                playback_clock.playback_stamp_of(Stamp(7 * MILLI)),
                &script.scans[0].points
            )
        );
    }
}
