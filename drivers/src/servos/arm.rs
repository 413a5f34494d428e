//! Reads an arm whose joints are servos on a serial bus. One thread polls all servos with sync
//! reads; the caller receives states of all joints.

use super::bus::{BusCounts, ServoBus, SyncAnswers};
use super::config::ServoArmConfig;
use super::servo::{Reading, Servo, joint_error};
use crate::outage::Outage;
use crate::{Arm, Error, clock};
use kinematics::{JointState, Stamp};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Capacity of the queue of states. It holds one second of states at 1 kHz, in case the caller is
/// slow.
pub(super) const MAX_WAITING: usize = 1000;
/// Servos that do not answer for this long are disconnected. With a lower value, a busy computer
/// would reconnect. With a higher value, the caller learns later that a joint is missing.
const MAX_SILENCE: Duration = Duration::from_secs(1);
/// Time between two attempts to reconnect. An adapter needs about a second to appear.
const RETRY: Duration = Duration::from_millis(500);
/// Maximum wait without a check whether the arm was dropped.
const POLL: Duration = Duration::from_millis(50);

/// A read-only arm, which cannot be moved. Dropping it releases the port. If adapter or servos are
/// disconnected, the arm tries to reconnect for the time in its configuration.
#[derive(Debug)]
pub struct ServoArm {
    names: Vec<String>,
    device: PathBuf,
    states: Receiver<Result<JointState, Error>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl ServoArm {
    /// Opens the port, finds all servos and starts reading.
    ///
    /// # Errors
    /// If the port cannot be opened, or a servo does not answer or is not supported.
    pub fn open(config: &ServoArmConfig) -> Result<Self, Error> {
        // The queue is bounded, so that a caller that does not read cannot make memory grow.
        let (sender, states) = sync_channel(MAX_WAITING);
        let stop = Arc::new(AtomicBool::new(false));
        // All servos are found before the thread starts, so that a missing servo is an error of
        // this call.
        let connection = Connection::open(config)?;
        let reader = Reader {
            config: config.clone(),
            sender,
            stop: Arc::clone(&stop),
            known_faults: vec![false; config.servos.len()],
            losses: Losses::default(),
        };
        let device = format!("servos on {}", config.port.device.display());
        let thread = std::thread::Builder::new()
            .name("servos".to_owned())
            .spawn(move || reader.run(connection))
            .map_err(|source| Error::Thread { device, source })?;
        Ok(Self {
            names: config.joint_names(),
            device: config.port.device.clone(),
            states,
            stop,
            thread: Some(thread),
        })
    }
}

impl Arm for ServoArm {
    fn joint_names(&self) -> &[String] {
        &self.names
    }

    /// Returns the next state. Its stamp is the middle of the exchange with the servos. All its
    /// joints were read in the same exchange.
    ///
    /// # Errors
    /// [`Error::ArmReconnecting`] while the arm tries to reconnect.
    fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
        match self.states.recv_timeout(timeout) {
            Ok(state) => state,
            Err(RecvTimeoutError::Timeout) => Err(Error::NoJoints { waited: timeout }),
            // An earlier call returned the error that ended the thread.
            Err(RecvTimeoutError::Disconnected) => Err(Error::SerialPort {
                device: self.device.clone(),
                reason: "reading has ended".to_owned(),
            }),
        }
    }
}

impl Drop for ServoArm {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has already printed the panic message.
            let _ = thread.join();
        }
    }
}

/// An open bus whose servos have been found.
struct Connection {
    bus: ServoBus,
    servos: Vec<Servo>,
}

impl Connection {
    fn open(config: &ServoArmConfig) -> Result<Self, Error> {
        let mut bus = ServoBus::open(&config.port, config.protocol.format())?;
        let servos = Servo::find_all(&mut bus, config)?;
        Ok(Self { bus, servos })
    }
}

/// What was lost since the arm was opened.
#[derive(Debug, Default)]
struct Losses {
    n_states: u64,
    /// States without all joints.
    n_incomplete: u64,
    /// States that did not fit into the queue.
    n_dropped: u64,
    n_outages: u64,
}

/// The thread that reads the servos.
struct Reader {
    config: ServoArmConfig,
    sender: SyncSender<Result<JointState, Error>>,
    stop: Arc<AtomicBool>,
    /// Whether the fault of a servo has been logged.
    known_faults: Vec<bool>,
    losses: Losses,
}

impl Reader {
    fn run(mut self, mut connection: Connection) {
        let began = clock::now();
        loop {
            let problem = match self.read(&mut connection) {
                // The arm was dropped.
                Ok(()) => break,
                Err(problem) => problem,
            };
            log::warn!("{problem}; trying to reconnect");
            let counts = connection.bus.counts();
            self.summarize(began, counts);
            // The port is released, because it cannot be reopened while it is locked.
            drop(connection);
            match self.reconnect(problem) {
                Ok(Some(reconnected)) => connection = reconnected,
                Ok(None) => return,
                Err(error) => {
                    // The receiver may be gone, or so far behind that the arm counts as silent.
                    let _ = self.sender.try_send(Err(error));
                    return;
                }
            }
        }
        let counts = connection.bus.counts();
        self.summarize(began, counts);
    }

    /// Reads until the arm is dropped.
    ///
    /// # Errors
    /// If the port was disconnected, or servos are silent.
    fn read(&mut self, connection: &mut Connection) -> Result<(), Error> {
        let ids = self.config.ids();
        let block = self.config.protocol.feedback_block();
        let period = Duration::from_secs_f64(1.0 / self.config.rate_hz);
        let mut last_heard = vec![Instant::now(); ids.len()];
        let mut next_cycle = Instant::now();
        while !self.stop.load(Ordering::Relaxed) {
            let answers = connection.bus.sync_read(block.address, block.len, &ids)?;
            let now = Instant::now();
            for (last_heard, status) in last_heard.iter_mut().zip(&answers.statuses) {
                if status.is_some() {
                    *last_heard = now;
                }
            }
            self.log_faults(&mut connection.bus, &answers)?;
            if !self.deliver(&connection.servos, &answers) {
                return Ok(());
            }
            if let Some(ix) = last_heard
                .iter()
                .position(|last_heard| now.duration_since(*last_heard) > MAX_SILENCE)
            {
                let reason = format!(
                    "no answer from the servo with ID {} for {MAX_SILENCE:?}: check its power and its cable",
                    ids[ix]
                );
                let config = &connection.servos[ix].config;
                return Err(joint_error(config, connection.bus.device(), reason));
            }
            // Missed cycles are not made up for.
            next_cycle = (next_cycle + period).max(now);
            self.sleep_until(next_cycle);
        }
        Ok(())
    }

    /// Passes on a state if it is complete. Returns whether the arm still exists.
    fn deliver(&mut self, servos: &[Servo], answers: &SyncAnswers) -> bool {
        let protocol = self.config.protocol;
        // Every state consists of new readings only. Otherwise, a silent servo would keep its last
        // position in all later states.
        let readings = servos
            .iter()
            .zip(&answers.statuses)
            .map(|(servo, status)| servo.reading(protocol, status.as_ref()?))
            .collect::<Option<Vec<_>>>();
        let Some(readings) = readings else {
            self.losses.n_incomplete += 1;
            return true;
        };
        match self.sender.try_send(Ok(state(answers.stamp, &readings))) {
            Ok(()) => self.losses.n_states += 1,
            Err(TrySendError::Full(_)) => self.losses.n_dropped += 1,
            Err(TrySendError::Disconnected(_)) => return false,
        }
        true
    }

    /// Logs the faults of servos that report one, once per fault.
    fn log_faults(&mut self, bus: &mut ServoBus, answers: &SyncAnswers) -> Result<(), Error> {
        let protocol = self.config.protocol;
        for (ix, status) in answers.statuses.iter().enumerate() {
            let Some(status) = status else { continue };
            let has_fault = protocol.has_fault(status);
            let is_known = std::mem::replace(&mut self.known_faults[ix], has_fault);
            if has_fault && !is_known {
                let joint = &self.config.servos[ix].joint;
                let faults = protocol.faults(bus, status)?;
                log::warn!("joint {joint:?}: its servo reports: {faults}");
            }
        }
        Ok(())
    }

    /// Tries to reconnect. Returns `None` if the arm was dropped.
    ///
    /// # Errors
    /// The problem of the last attempt, when the time in the configuration is over.
    fn reconnect(&mut self, mut problem: Error) -> Result<Option<Connection>, Error> {
        self.losses.n_outages += 1;
        let reconnect_for = self.config.port.reconnect_for;
        let mut outage = None;
        let mut outage = Outage::of(&mut outage);
        while outage.since.elapsed() < reconnect_for {
            if self.stop.load(Ordering::Relaxed) {
                return Ok(None);
            }
            let reconnecting = Error::ArmReconnecting {
                device: format!("arm on {}", self.config.port.device.display()),
                waited: outage.since.elapsed(),
            };
            if let Err(TrySendError::Disconnected(_)) = self.sender.try_send(Err(reconnecting)) {
                return Ok(None);
            }
            if !outage.wait_for_retry(RETRY, Instant::now() + POLL) {
                continue;
            }
            match Connection::open(&self.config) {
                Ok(connection) => {
                    log::info!(
                        "{}: reconnected after {:.1} s",
                        self.config.port.device.display(),
                        outage.since.elapsed().as_secs_f64()
                    );
                    return Ok(Some(connection));
                }
                Err(error) => problem = error,
            }
        }
        Err(problem)
    }

    fn sleep_until(&self, instant: Instant) {
        while !self.stop.load(Ordering::Relaxed) {
            let remaining = instant.saturating_duration_since(Instant::now());
            if remaining.is_zero() {
                return;
            }
            std::thread::sleep(remaining.min(POLL));
        }
    }

    /// Logs how well the servos were read since `began`.
    fn summarize(&self, began: Stamp, counts: BusCounts) {
        let Losses {
            n_states,
            n_incomplete,
            n_dropped,
            n_outages,
        } = self.losses;
        let seconds = clock::now().secs_since(began).max(1e-9);
        log::info!(
            "{}: {:.0} joint states per second, {n_incomplete} incomplete, {n_dropped} dropped, {n_outages} reconnections; {counts}",
            self.config.port.device.display(),
            n_states as f64 / seconds
        );
    }
}

/// A state of all joints.
pub(super) fn state(stamp: Stamp, readings: &[Reading]) -> JointState {
    JointState {
        stamp,
        position: readings
            .iter()
            .map(|reading| reading.position_rad)
            .collect(),
        velocity: readings
            .iter()
            .map(|reading| reading.velocity_rad_s)
            .collect(),
        // The servos report a load or a current, but no torque.
        effort: Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maximum_silence_is_documented() {
        let row = format!("| servos on a serial bus | {} s", MAX_SILENCE.as_secs());
        assert!(include_str!("../../../docs/reference/rig.md").contains(&row));
    }
}
