//! A read-only arm. A thread receives the robot's states, and the caller gets joint states.

#[cfg(any(test, fuzzing))]
pub(crate) mod fuzz;

use super::connection::{Connection, error_text, fault};
use super::motion_loop::{MotionLoop, StampedState};
use super::state::{MAX_STATE_BYTES, NumberedState, decode, pose};
use super::{N_JOINTS, StateStatistics, realtime};
use crate::flange_difference::FlangePoses;
use crate::udp::sequence::{SequencePosition, SequenceTracker};
use crate::wire::datagram::{Clock, DatagramHeader};
use crate::{Arm, Error, FlangeDifference, clock};
use franka::{FciVersion, RobotMode, RobotState};
use kinematics::{Chain, JointState, Stamp};
use parking_lot::{Condvar, Mutex};
use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Capacity of the queue of states. It holds the states of one second, in case the caller is slow.
/// When the queue is full, the oldest state is dropped.
const MAX_WAITING: usize = 1000;
/// A robot that sends nothing for this long counts as lost. At a thousand states per second, lost
/// datagrams cannot cause such a silence. The cause is a cable, the power or a closed connection.
const MAX_SILENCE: Duration = Duration::from_secs(1);
/// Maximum difference between the flange position from our forward kinematics and the position that
/// the robot reports. With a larger difference, the description belongs to another robot. FCI 10
/// rounds poses by less than a micrometer. A wrong link or tool is usually off by centimeters, so
/// the value need not be exact.
const MAX_POSE_ERROR_M: f64 = 2e-3;
const MAX_POSE_ERROR_RAD: f64 = 0.5 / 180.0 * std::f64::consts::PI;
const NANOS_PER_STATE: i64 = 1_000_000;
/// A robot that received no answer for this long has stopped waiting. States that arrived in the
/// meantime are not answered. The time corresponds to 20 missed commands, after which a robot ends
/// its motion.
const MAX_RESPONSE_GAP: Duration = Duration::from_millis(20);

/// Configuration of an arm from the rig file.
#[derive(Clone, Debug)]
pub struct ArmConfig {
    /// Host of the controller, with the port if it is not 1337.
    pub address: String,
    /// The seven joints, from the base to the flange.
    pub joint_names: Vec<String>,
    /// Chain from the parent link of the first joint to the flange.
    pub chain: Chain,
}

/// A read-only Franka arm, which cannot be moved. Dropping it frees the robot's interface.
#[derive(Debug)]
pub struct FrankaArm {
    device: String,
    names: Vec<String>,
    version: FciVersion,
    flange_difference: FlangeDifference,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<StateQueue>,
    arrived: Condvar,
}

/// State shared by the thread and the caller.
#[derive(Debug, Default)]
struct StateQueue {
    queue: VecDeque<JointState>,
    statistics: StateStatistics,
    error: Option<Error>,
    stop: bool,
}

impl FrankaArm {
    /// Connects, checks that the rig file describes this robot, and starts reading.
    pub fn open(config: &ArmConfig) -> Result<Self, Error> {
        Self::open_with(config, |_, _| Ok(None))
    }

    /// Like [`FrankaArm::open`], with a motion loop that is created from the first state and then
    /// moves the arm.
    pub(super) fn open_with(
        config: &ArmConfig,
        motion_loop: impl FnOnce(&Arc<Connection>, &RobotState) -> Result<Option<MotionLoop>, String>,
    ) -> Result<Self, Error> {
        let address = &config.address;
        let n = config.joint_names.len();
        if n != N_JOINTS || config.chain.n_joints() != N_JOINTS {
            return Err(fault(
                address,
                format!("the rig file names {n} joints, but the arm has {N_JOINTS}"),
            ));
        }
        let connection = Arc::new(Connection::open(address)?);
        let version = connection.version;
        let (sender, first) = first_state(address, &connection)?;
        // A wrong robot description would give every image a wrong pose, and the error would look
        // like a bad calibration. The description is therefore checked before anything is read or
        // moved.
        let flange_difference =
            check_kinematics(config, &first).map_err(|reason| fault(address, reason))?;
        let motion_loop =
            motion_loop(&connection, &first).map_err(|reason| fault(address, reason))?;
        let mut reader = StateReader::new(address.clone(), version, motion_loop);
        reader.log_mode(&first);
        let shared = Arc::new(Shared::default());
        let device = format!("arm at {address}");
        let reading = Arc::clone(&shared);
        let name = "franka".to_owned();
        let thread = std::thread::Builder::new()
            .name(name)
            .spawn(move || reader.run(&connection, sender, &reading));
        let thread = thread.map_err(|source| Error::Thread {
            device: device.clone(),
            source,
        })?;
        log::info!(
            "{device}: uses FCI version {}",
            if version == FciVersion::V5 { 5 } else { 10 }
        );
        Ok(Self {
            device,
            names: config.joint_names.clone(),
            version,
            flange_difference,
            shared,
            thread: Some(thread),
        })
    }

    /// FCI version of the controller.
    pub fn version(&self) -> FciVersion {
        self.version
    }

    /// Statistics of the states so far.
    pub fn statistics(&self) -> StateStatistics {
        self.shared.state.lock().statistics.clone()
    }
}

impl Arm for FrankaArm {
    fn joint_names(&self) -> &[String] {
        &self.names
    }

    /// Returns the next state. Its stamp is the time on the robot's clock, mapped to the clock of
    /// this computer. Efforts are the measured link-side torques, including gravity.
    fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
        let deadline = Instant::now() + timeout;
        let mut state = self.shared.state.lock();
        loop {
            if let Some(joints) = state.queue.pop_front() {
                return Ok(joints);
            }
            if let Some(error) = state.error.take() {
                return Err(error);
            }
            let remaining = deadline.saturating_duration_since(Instant::now());
            if remaining.is_zero() {
                return Err(Error::NoJoints { waited: timeout });
            }
            self.shared.arrived.wait_for(&mut state, remaining);
        }
    }

    fn flange_difference(&self) -> Option<FlangeDifference> {
        Some(self.flange_difference)
    }
}

impl Drop for FrankaArm {
    fn drop(&mut self) {
        self.shared.state.lock().stop = true;
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has already printed the panic message.
            let _ = thread.join();
        }
        log::info!("{}: {}", self.device, self.statistics());
    }
}

/// Waits for the first state of a controller that has accepted the connection, and returns it with
/// its source address.
fn first_state(address: &str, connection: &Connection) -> Result<(SocketAddr, RobotState), Error> {
    let Connection { network, version } = connection;
    let deadline = clock::now() + MAX_SILENCE;
    let mut buffer = [0; MAX_STATE_BYTES];
    loop {
        // After a receive error, a state may still arrive.
        let n = network.udp.blocking_receive(&mut buffer).unwrap_or(0);
        let sender = network
            .udp_peer()
            .filter(|peer| peer.ip() == network.server_ip);
        match sender.zip(decode(*version, &buffer[..n])) {
            Some((sender, first)) => return Ok((sender, first.state)),
            None if clock::now() < deadline => {}
            None => {
                // TCP works, because the controller has answered a request. A firewall may block
                // the UDP port to which the states are sent.
                return Err(fault(
                    address,
                    format!(
                        "it sends no states; check that this computer's firewall lets UDP datagrams to port {} pass",
                        network.udp.port()
                    ),
                ));
            }
        }
    }
}

/// Compares the flange pose according to the rig file with the pose that the robot reports.
fn check_kinematics(config: &ArmConfig, state: &RobotState) -> Result<FlangeDifference, String> {
    let matrix = |name, matrix| {
        pose(matrix).map_err(|error| format!("its {name} is not a valid pose: {error}"))
    };
    // The robot reports its tool, whose pose depends on settings in Desk.
    let poses = FlangePoses::new(
        &config.chain,
        &config.joint_names,
        &state.q,
        matrix("O_T_EE", &state.O_T_EE)?,
        &matrix("F_T_EE", &state.F_T_EE)?,
    )?;
    let difference = FlangeDifference::between(&poses.described, &poses.reported);
    if difference.is_within(MAX_POSE_ERROR_M, MAX_POSE_ERROR_RAD) {
        return Ok(difference);
    }
    // If the rig file agrees with the pose of the tool instead, it names the hand as the flange.
    // The error reports this mistake separately.
    let tip = config.chain.tip_link();
    let from_tool = FlangeDifference::between(&poses.described, &poses.base_from_tool);
    let likely_cause = if from_tool.is_within(MAX_POSE_ERROR_M, MAX_POSE_ERROR_RAD) {
        format!(
            "{tip:?} is at the robot's end effector: arm.flange_link must name the flange, which differs from it by F_T_EE"
        )
    } else {
        format!(
            "likely causes: arm.flange_link is not the flange (panda_link8, fr3_link8), the end effector was changed in Desk, \
             arm.joints is in the wrong order, or arm.urdf is of another robot; {tip:?} is {from_tool} from the robot's end effector"
        )
    };
    let source = "the robot reports its flange (O_T_EE without F_T_EE)";
    let described = poses.describe(tip, source, &difference);
    Err(format!("{described}; {likely_cause}"))
}

/// State of the reading thread.
struct StateReader {
    address: String,
    version: FciVersion,
    sequence: SequenceTracker,
    mode: RobotMode,
    motion_loop: Option<MotionLoop>,
}

impl StateReader {
    fn new(address: String, version: FciVersion, motion_loop: Option<MotionLoop>) -> Self {
        Self {
            address,
            version,
            sequence: SequenceTracker::default(),
            mode: RobotMode::Other,
            motion_loop,
        }
    }

    /// Reads the states of `sender`, the source address of the first state.
    fn run(mut self, connection: &Connection, sender: SocketAddr, shared: &Shared) {
        realtime::request_realtime(&format!("arm at {}", self.address));
        if let Err(reason) = self.read(connection, sender, shared) {
            // A caller that moves the arm must learn that the connection has ended, even if nobody
            // reads joint states.
            if let Some(motion_loop) = &mut self.motion_loop {
                motion_loop.handle_disconnect(&reason);
            }
            shared.state.lock().error = Some(Error::Fci {
                address: self.address,
                reason,
            });
            shared.arrived.notify_all();
        }
    }

    /// Receives states until asked to stop. Returns the reason if no more states can be received.
    fn read(
        &mut self,
        connection: &Connection,
        sender: SocketAddr,
        shared: &Shared,
    ) -> Result<(), String> {
        let network = &connection.network;
        let mut buffer = [0; MAX_STATE_BYTES];
        // States that were queued before this thread started are all read at once. Their arrival
        // times are useless for estimating the robot's clock, so they are discarded.
        while let Ok(Some(_)) = network.udp.try_receive(&mut buffer) {}
        let mut last_received = clock::now();
        loop {
            let mut received = network.udp.blocking_receive(&mut buffer).ok();
            let mut at = clock::now();
            // The time is measured when the first waiting state is read. After a stall of this
            // thread, the robot no longer waits for an answer to any of the waiting states.
            let is_fresh = at.duration_since(last_received) <= MAX_RESPONSE_GAP;
            // All waiting states are read, so that each gets a stamp. Only the newest one is
            // answered, because answers to the earlier ones would be too late.
            let mut newest = None;
            while let Some(n) = received {
                // A controller sends all states of a connection from one port. Datagrams from other
                // senders are rejected, even from other ports of its address, because their message
                // numbers would restart the sequence.
                let from = network.udp_peer().filter(|peer| *peer == sender);
                let state = from.zip(decode(self.version, &buffer[..n]));
                if !self.handle_datagram(shared, state, at, &mut newest) {
                    return Ok(());
                }
                received = network.udp.try_receive(&mut buffer).unwrap_or(None);
                // Every state gets its own arrival time. With the arrival time of an earlier state,
                // a state could seem to have arrived before it was sent. Such a state would shift
                // the stamps of all later states.
                at = clock::now();
            }
            if let Some((from, numbered, stamp)) = newest {
                // Late and duplicate states do not count. A robot that only repeats old states
                // counts as lost.
                last_received = at;
                shared.arrived.notify_all();
                self.log_mode(&numbered.state);
                if let Some(motion_loop) = &mut self.motion_loop {
                    motion_loop.cycle(&StampedState {
                        numbered: &numbered,
                        stamp,
                        from,
                        is_fresh,
                    });
                }
                continue;
            }
            // Without states, `handle_datagram` does not see the request to stop.
            if shared.state.lock().stop {
                return Ok(());
            }
            // This check notices a closed connection earlier than the check for silence.
            network
                .tcp
                .throw_if_connection_closed()
                .map_err(|error| error_text(&error))?;
            let silence = at.duration_since(last_received);
            if silence > MAX_SILENCE {
                return Err(format!("it has sent no states for {silence:.1?}"));
            }
        }
    }

    /// Processes a datagram, or counts it as rejected. Returns whether to continue.
    fn handle_datagram(
        &mut self,
        shared: &Shared,
        state: Option<(SocketAddr, NumberedState)>,
        at: Stamp,
        newest: &mut Option<(SocketAddr, NumberedState, Stamp)>,
    ) -> bool {
        let mut state_queue = shared.state.lock();
        match state {
            Some((from, numbered)) => {
                if let Some(stamp) = self.take(&mut state_queue, &numbered, at) {
                    *newest = Some((from, numbered, stamp));
                }
            }
            None => state_queue.statistics.n_rejected += 1,
        }
        !state_queue.stop
    }

    /// Queues a state if it is later than all earlier states, and returns its stamp on our clock.
    fn take(
        &mut self,
        state_queue: &mut StateQueue,
        numbered: &NumberedState,
        at: Stamp,
    ) -> Option<Stamp> {
        let NumberedState { number, state } = numbered;
        let statistics = &mut state_queue.statistics;
        match self.sequence.position(*number, at) {
            // UDP may lose, duplicate and reorder datagrams. The numbers distinguish these cases.
            SequencePosition::New { n_lost } => statistics.n_lost += n_lost,
            SequencePosition::Restart => statistics.n_restarts += 1,
            SequencePosition::Current | SequencePosition::Late => {
                statistics.n_late += 1;
                return None;
            }
        }
        // The robot increments the number of its states once per millisecond of its own clock.
        let stamp_nanos = i64::try_from(*number)
            .unwrap_or(i64::MAX)
            .saturating_mul(NANOS_PER_STATE);
        let header = DatagramHeader {
            seq: *number,
            clock: Clock::Device,
            stamp_nanos,
        };
        // The robot sends at a steady rate, but the network and the scheduler delay the arrival.
        // The map between the clocks removes that jitter.
        let Some(stamp) = self.sequence.stamp(&header, at) else {
            statistics.n_rejected += 1;
            return None;
        };
        statistics.count(at.duration_since(stamp));
        // The oldest state is dropped, because joint states are needed for images that are about to
        // arrive.
        if state_queue.queue.len() >= MAX_WAITING {
            state_queue.queue.pop_front();
            statistics.n_dropped += 1;
        }
        state_queue.queue.push_back(JointState {
            stamp,
            position: state.q.to_vec(),
            velocity: state.dq.to_vec(),
            effort: state.tau_J.to_vec(),
        });
        Some(stamp)
    }

    /// Logs the robot's mode whenever it changes. If the arm can be moved, its motion loop reports
    /// reflexes, with the robot's reply about the motion.
    fn log_mode(&mut self, state: &RobotState) {
        if state.robot_mode == self.mode {
            return;
        }
        self.mode = state.robot_mode;
        let address = &self.address;
        let mode = self.mode;
        match mode {
            RobotMode::Reflex if self.motion_loop.is_none() => {
                let reasons = state.last_motion_errors.names().join(", ");
                log::warn!("arm at {address}: stopped by a reflex: {reasons}");
            }
            _ => log::info!("arm at {address}: mode {mode:?}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{TEST_TIMEOUT, config, robot, swinging_joints_at};
    use super::*;

    #[test]
    fn maximum_silence_is_documented() {
        let row = format!("| Franka arm | {} s |", MAX_SILENCE.as_secs());
        assert!(include_str!("../../../docs/reference/rig.md").contains(&row));
    }

    #[test]
    fn stalled_thread_does_not_shift_stamps() {
        const STALL: Duration = Duration::from_millis(50);
        // The joints rotate by up to 0.4 rad/s.
        const MAX_ERROR_RAD: f64 = 0.4 * 5e-3;
        let emulated = robot(
            FciVersion::V10,
            Box::new(|stamp, _| swinging_joints_at(stamp)),
        );
        let mut arm = FrankaArm::open(&config(emulated.address())).unwrap();
        let max_error_after = |arm: &mut FrankaArm, n_skipped: usize| {
            let states: Vec<_> = (0..n_skipped + 200)
                .map(|_| arm.read(TEST_TIMEOUT).unwrap())
                .collect();
            let errors = states[n_skipped..].iter().flat_map(|state| {
                let truth = swinging_joints_at(state.stamp);
                std::iter::zip(&state.position, truth.position_rad)
                    .map(|(reported, expected)| (reported - expected).abs())
            });
            errors.fold(0.0, f64::max)
        };
        let before = max_error_after(&mut arm, 500);
        let n_rejected = arm.statistics().n_rejected;
        let queue = arm.shared.state.lock();
        std::thread::sleep(STALL);
        drop(queue);
        let after = max_error_after(&mut arm, 100);
        assert!(
            before < MAX_ERROR_RAD && after < MAX_ERROR_RAD,
            "{before} rad before, {after} rad after"
        );
        assert_eq!(arm.statistics().n_rejected, n_rejected, "stamps increase");
    }
}
