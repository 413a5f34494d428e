//! A read-only arm. A thread receives the states of the robot, and the caller gets joint states.

use super::config::ArmConfig;
use super::connection::{Connection, ControllerVersion, POLL, Reading};
use super::flange_check::check_flange;
use super::motion_loop::{Cycle, MotionLoop};
use super::state::RobotState;
use super::timing::{StateTiming, Timed};
use super::{N_JOINTS, StateStatistics, words};
use crate::{Arm, Error, FlangeDifference, clock};
use kinematics::{JointState, Stamp};
use parking_lot::{Condvar, Mutex};
use std::collections::VecDeque;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Capacity of the queue of states. It holds the states of two seconds at 500 Hz, in case the
/// caller is slow. When the queue is full, the oldest state is dropped.
const MAX_WAITING: usize = 1000;
/// A connection that brings no state for this long counts as lost. At 125 or 500 states per second,
/// such a silence is caused by a cable, the power or the controller.
const MAX_SILENCE: Duration = Duration::from_secs(1);
/// Maximum time for reconnecting, since the last state. It suffices to plug a cable in again. The
/// restart of a controller takes a minute, and images without joint states are useless.
const MAX_OUTAGE: Duration = Duration::from_secs(20);
/// Interval between attempts to reconnect.
const RECONNECT_INTERVAL: Duration = Duration::from_millis(500);

/// A read-only arm of Universal Robots, which cannot be moved. Dropping it closes the connection.
#[derive(Debug)]
pub struct UrArm {
    device: String,
    names: Vec<String>,
    version: ControllerVersion,
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
    /// Time at which the connection was lost, while the thread tries to reconnect.
    lost_since: Option<Stamp>,
    error: Option<Error>,
    stop: bool,
}

impl UrArm {
    /// Connects, checks that the rig file describes this robot, and starts reading.
    pub fn open(config: &ArmConfig) -> Result<Self, Error> {
        Self::open_with(config, MAX_OUTAGE)
    }

    /// Like [`UrArm::open`], with another time limit for reconnecting.
    pub(super) fn open_with(config: &ArmConfig, max_outage: Duration) -> Result<Self, Error> {
        Self::open_arm(config, max_outage, None)
    }

    /// Like [`UrArm::open`], with a motion loop that is created for the rate of the controller and
    /// then moves the arm. A lost connection is not opened again, because a person must look at an
    /// arm that was moving.
    pub(super) fn open_to_move(
        config: &ArmConfig,
        motion_loop: impl FnOnce(f64) -> MotionLoop,
    ) -> Result<Self, Error> {
        Self::open_arm(config, Duration::ZERO, Some(Box::new(motion_loop)))
    }

    fn open_arm(
        config: &ArmConfig,
        max_outage: Duration,
        motion_loop: Option<Box<dyn FnOnce(f64) -> MotionLoop + '_>>,
    ) -> Result<Self, Error> {
        let address = &config.address;
        let n = config.joint_names.len();
        if n != N_JOINTS || config.chain.n_joints() != N_JOINTS {
            return Err(fault(
                address,
                format!("the rig file names {n} joints, but the arm has {N_JOINTS}"),
            ));
        }
        let opened = Connection::open(address, motion_loop.is_some()).and_then(|mut connection| {
            let first = first_state(&mut connection)?;
            Ok((connection, first))
        });
        let (connection, first) = opened.map_err(|reason| fault(address, reason))?;
        let device = format!("arm at {address}");
        // A wrong robot description would give every image a wrong pose, and the error would look
        // like a bad calibration.
        let flange = check_flange(config, &first).map_err(|reason| fault(address, reason))?;
        if let Some(doubt) = &flange.doubt {
            log::warn!("{device}: {doubt}");
        }
        let version = connection.version;
        log::info!(
            "{device}: PolyScope {version}, {} states per second",
            version.rate_hz()
        );
        let shared = Arc::new(Shared::default());
        let mut reader = StateReader {
            address: address.clone(),
            timing: StateTiming::new(version.rate_hz()),
            mode: String::new(),
            max_outage,
            motion_loop: motion_loop.map(|create| create(version.rate_hz())),
        };
        reader.log_mode(&first);
        // A robot that is stopped already is reported at once, and not at the first target.
        if let Some(motion_loop) = &mut reader.motion_loop {
            motion_loop.take_mode(&first);
        }
        let reading = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("ur".to_owned())
            .spawn(move || reader.run(connection, &reading));
        let thread = thread.map_err(|source| Error::Thread {
            device: device.clone(),
            source,
        })?;
        Ok(Self {
            device,
            names: config.joint_names.clone(),
            version,
            flange_difference: flange.difference,
            shared,
            thread: Some(thread),
        })
    }

    /// Version of the controller's software.
    pub fn version(&self) -> ControllerVersion {
        self.version
    }

    /// Statistics of the states so far.
    pub fn statistics(&self) -> StateStatistics {
        self.shared.state.lock().statistics.clone()
    }
}

impl Arm for UrArm {
    fn joint_names(&self) -> &[String] {
        &self.names
    }

    /// Returns the next state. Its stamp is the time on the controller's clock, mapped to the clock
    /// of this computer. Efforts are torques computed from the motor currents, which controllers
    /// report since PolyScope 5.23; the list is empty for earlier ones.
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
                return Err(match state.lost_since {
                    Some(since) => Error::ArmReconnecting {
                        device: self.device.clone(),
                        waited: clock::now().duration_since(since),
                    },
                    None => Error::NoJoints { waited: timeout },
                });
            }
            self.shared.arrived.wait_for(&mut state, remaining);
        }
    }

    fn flange_difference(&self) -> Option<FlangeDifference> {
        Some(self.flange_difference)
    }
}

impl Drop for UrArm {
    fn drop(&mut self) {
        self.shared.state.lock().stop = true;
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has already printed the panic message.
            let _ = thread.join();
        }
        log::info!("{}: {}", self.device, self.statistics());
    }
}

/// An error of the controller at this address.
pub(super) fn fault(address: &str, reason: String) -> Error {
    Error::Rtde {
        address: address.to_owned(),
        reason,
    }
}

/// Waits for the first state whose joint angles are measured.
pub(super) fn first_state(connection: &mut Connection) -> Result<RobotState, String> {
    let deadline = clock::now() + MAX_SILENCE;
    let mut unpowered = None;
    while clock::now() < deadline {
        match connection.next(POLL)? {
            Some(Reading::State(state)) if words::has_joint_power(&state) => return Ok(*state),
            Some(Reading::State(state)) => unpowered = Some(words::describe(&state)),
            Some(Reading::Rejected) | None => {}
        }
    }
    Err(match unpowered {
        Some(mode) => format!("its joint angles are not measured: {mode}"),
        None => format!("it has sent no valid states for {MAX_SILENCE:?}"),
    })
}

/// State of the reading thread.
struct StateReader {
    address: String,
    timing: StateTiming,
    /// Description of the newest mode.
    mode: String,
    /// Maximum time for reconnecting.
    max_outage: Duration,
    motion_loop: Option<MotionLoop>,
}

impl StateReader {
    fn run(mut self, mut connection: Connection, shared: &Shared) {
        loop {
            let Err(reason) = self.read(&mut connection, shared) else {
                return;
            };
            // A caller that moves the arm must learn that the connection has ended, even if nobody
            // reads joint states.
            let reconnected = match &mut self.motion_loop {
                Some(motion_loop) => {
                    motion_loop.handle_disconnect(&reason);
                    Err(reason)
                }
                None => self.reconnect(connection, shared, &reason),
            };
            connection = match reconnected {
                Ok(Some(connection)) => connection,
                Ok(None) => return,
                Err(reason) => {
                    shared.state.lock().error = Some(fault(&self.address, reason));
                    shared.arrived.notify_all();
                    return;
                }
            };
        }
    }

    /// Receives states until asked to stop. Returns the reason if no more states can be received.
    fn read(&mut self, connection: &mut Connection, shared: &Shared) -> Result<(), String> {
        let mut last_received = clock::now();
        let mut last_cycle = last_received;
        loop {
            let mut reading = connection.next(POLL)?;
            let mut n_cycles = 0;
            let mut is_newer = false;
            let mut newest = None;
            // All waiting states are read, so that each gets a stamp. Only the newest one is
            // answered with a setpoint.
            while let Some(received) = reading {
                if let Some((state, taken)) = self.take(shared, received, clock::now()) {
                    is_newer |= taken.is_some();
                    n_cycles += taken.map_or(1, |timed| timed.n_skipped + 1);
                    newest = Some(state);
                }
                reading = connection.next_received()?;
            }
            let now = clock::now();
            if is_newer {
                last_received = now;
                shared.arrived.notify_all();
            }
            if let (Some(motion_loop), Some(state)) = (&mut self.motion_loop, newest) {
                let pause = now.duration_since(last_cycle);
                last_cycle = now;
                motion_loop.cycle(
                    &Cycle {
                        state: &state,
                        n_cycles,
                        pause,
                    },
                    connection,
                )?;
            }
            if shared.state.lock().stop {
                return Ok(());
            }
            let silence = now.duration_since(last_received);
            if silence > MAX_SILENCE {
                return Err(format!(
                    "it has sent no valid states for {silence:.1?} ({})",
                    self.mode
                ));
            }
        }
    }

    /// Queues a state if its angles are measured and it is later than all earlier ones. Returns the
    /// state, and its time if it was queued. `None` if the package was no state.
    fn take(
        &mut self,
        shared: &Shared,
        reading: Reading,
        at: Stamp,
    ) -> Option<(Box<RobotState>, Option<Timed>)> {
        let state = match reading {
            Reading::State(state) => state,
            Reading::Rejected => {
                shared.state.lock().statistics.n_rejected += 1;
                return None;
            }
        };
        self.log_mode(&state);
        let mut state_queue = shared.state.lock();
        let statistics = &mut state_queue.statistics;
        if !words::has_joint_power(&state) {
            statistics.n_unpowered += 1;
            return Some((state, None));
        }
        let Some(timed) = self.timing.time(&state, at) else {
            statistics.n_rejected += 1;
            return Some((state, None));
        };
        statistics.n_lost += timed.n_skipped;
        statistics.n_restarts = self.timing.n_restarts();
        statistics.count(at.duration_since(timed.stamp));
        // The oldest state is dropped, because joint states are needed for images that are about to
        // arrive.
        if state_queue.queue.len() >= MAX_WAITING {
            state_queue.queue.pop_front();
            state_queue.statistics.n_dropped += 1;
        }
        state_queue.queue.push_back(JointState {
            stamp: timed.stamp,
            position: state.position_rad.to_vec(),
            velocity: state.velocity_rad_s.to_vec(),
            effort: state
                .torque_nm
                .map_or_else(Vec::new, |torque| torque.to_vec()),
        });
        Some((state, Some(timed)))
    }

    /// Connects again after a loss. Returns `None` if asked to stop.
    ///
    /// # Errors
    /// If the controller cannot be reached in time. The text names the first reason and the last.
    fn reconnect(
        &self,
        lost: Connection,
        shared: &Shared,
        reason: &str,
    ) -> Result<Option<Connection>, String> {
        let address = &self.address;
        log::warn!("arm at {address}: {reason}; reconnecting");
        // The controller may accept only a limited number of clients.
        drop(lost);
        let since = clock::now();
        shared.state.lock().lost_since = Some(since);
        loop {
            let opened = Connection::open(address, false).and_then(|mut connection| {
                first_state(&mut connection)?;
                Ok(connection)
            });
            let mut state = shared.state.lock();
            if state.stop {
                return Ok(None);
            }
            match opened {
                Ok(connection) => {
                    state.lost_since = None;
                    state.statistics.n_reconnects += 1;
                    log::info!("arm at {address}: connected again");
                    return Ok(Some(connection));
                }
                Err(failure) if clock::now().duration_since(since) > self.max_outage => {
                    return Err(format!(
                        "{reason}; it did not return within {:?}: {failure}",
                        self.max_outage
                    ));
                }
                Err(_) => {}
            }
            drop(state);
            std::thread::sleep(RECONNECT_INTERVAL);
        }
    }

    /// Logs the modes of the robot whenever they change.
    fn log_mode(&mut self, state: &RobotState) {
        let mode = words::describe(state);
        if mode == self.mode {
            return;
        }
        let address = &self.address;
        match words::blocking_reason(state) {
            Some(_) => log::warn!("arm at {address}: {mode}"),
            None => log::info!("arm at {address}: {mode}"),
        }
        self.mode = mode;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maximum_outage_is_documented() {
        let row = format!(
            "| arm of Universal Robots | {} s |",
            (MAX_SILENCE + MAX_OUTAGE).as_secs()
        );
        assert!(include_str!("../../../docs/reference/rig.md").contains(&row));
    }
}
