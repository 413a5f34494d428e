//! Reads an arm whose joints are motors on CAN buses. One thread per bus polls and listens; the
//! caller receives states of all joints.

use super::bus::{Bus, MAX_SENDING};
use super::bus_load::max_cycle_rate_hz;
use super::config::{ArmConfig, BusConfig};
use super::frame_io::{BusEvent, WireErrors};
use super::joints::{JointReading, Joints};
use super::motor::Motor;
use crate::wire::can::{Frame, canopen};
use crate::{Arm, Error, clock};
use kinematics::{JointState, Stamp};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Maximum interval at which a bus thread checks whether it should stop. Dropping the arm waits for
/// its threads, so a longer interval would delay the drop.
const POLL: Duration = Duration::from_millis(50);
/// Capacity of the queue of readings. It holds one second of readings of seven motors at 1 kHz, in
/// case the caller is slow.
pub(super) const MAX_WAITING: usize = 7000;
/// If a loop iteration of a bus thread takes this much longer than its waits, the thread was not
/// scheduled.
const MAX_LOOP_DELAY: Duration = Duration::from_millis(20);
/// A motor that sends nothing for this long causes an error. With a lower value, a motor would
/// count as silent while its bus restarts after a bus-off. With a higher value, the caller learns
/// later that a joint is missing.
const MAX_SILENCE: Duration = Duration::from_secs(1);

/// A read-only arm, which cannot be moved. Dropping it stops the polling but does not affect the
/// motors otherwise.
#[derive(Debug)]
pub struct CanArm {
    names: Vec<String>,
    readings: Receiver<Result<JointReading, Error>>,
    joints: Joints,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl CanArm {
    /// Checks the configuration of the buses, finds all motors and starts reading.
    ///
    /// # Errors
    /// If a bus is not set up as configured or a motor does not answer.
    pub fn open(config: &ArmConfig) -> Result<Self, Error> {
        // The queue is bounded, so that a caller that does not read cannot make memory grow.
        let (sender, readings) = sync_channel(MAX_WAITING);
        let stop = Arc::new(AtomicBool::new(false));
        let mut buses = Vec::new();
        // All motors are found before the first thread starts. A missing motor is then an error of
        // this call. Also, no thread that reads the same bus can take the answers to these queries.
        for (bus_ix, bus) in config.buses.iter().enumerate() {
            let bus = Bus::open(bus)?;
            let motors_of_bus = config
                .motors
                .iter()
                .enumerate()
                .filter(|(_, motor)| motor.bus_ix == bus_ix);
            let motors =
                motors_of_bus.map(|(joint_ix, motor)| Ok((joint_ix, Motor::set_up(&bus, motor)?)));
            let motors = motors.collect::<Result<Vec<_>, Error>>()?;
            buses.push((bus, motors));
        }
        let names: Vec<String> = config
            .motors
            .iter()
            .map(|motor| motor.joint.clone())
            .collect();
        // The arm exists before its threads: if one of them cannot be started, dropping the arm
        // stops those that run already.
        let mut arm = Self {
            joints: Joints::new(names.len()),
            names,
            readings,
            stop,
            threads: Vec::new(),
        };
        for (bus, motors) in buses {
            let cycle = Cycle::new(bus.config(), &motors, config.rate_hz);
            let device = format!("CAN {}", bus.config().interface);
            let reader = BusReader {
                bus,
                motors,
                cycle,
                sender: sender.clone(),
                stop: Arc::clone(&arm.stop),
            };
            let thread = std::thread::Builder::new()
                .name(device.clone())
                .spawn(move || reader.run());
            arm.threads
                .push(thread.map_err(|source| Error::Thread { device, source })?);
        }
        Ok(arm)
    }
}

impl Arm for CanArm {
    fn joint_names(&self) -> &[String] {
        &self.names
    }

    /// Returns a state of all joints as soon as every motor has sent a new reading. The state has
    /// the stamp of the newest reading. All other readings are extrapolated to this stamp with
    /// their own velocity.
    fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
        let deadline = Instant::now() + timeout;
        loop {
            let remaining = deadline.saturating_duration_since(Instant::now());
            match self.readings.recv_timeout(remaining) {
                Ok(Ok(reading_of_joint)) => {
                    if let Some(state) = self.joints.take(&reading_of_joint) {
                        return Ok(state);
                    }
                }
                Ok(Err(error)) => return Err(error),
                // The queue is disconnected when every bus thread has ended. The errors that ended
                // them were returned by earlier calls.
                Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
                    return Err(Error::NoJoints { waited: timeout });
                }
            }
        }
    }
}

impl Drop for CanArm {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // A thread that panicked has already printed the panic message.
            let _ = thread.join();
        }
    }
}

/// The frames sent periodically on a bus.
#[derive(Debug)]
struct Cycle {
    poll_frames: Vec<Frame>,
    period: Duration,
}

impl Cycle {
    /// Polls at the requested rate, or at the highest rate that keeps the bus load within bounds.
    fn new(bus: &BusConfig, motors: &[(usize, Motor)], rate_hz: f64) -> Self {
        let mut poll_frames: Vec<_> = motors
            .iter()
            .filter_map(|(_, motor)| motor.protocol().poll_frame())
            .collect();
        if motors
            .iter()
            // One SYNC makes all CANopen drives of the bus sample at the same instant, so they need
            // no polls of their own.
            .any(|(_, motor)| motor.protocol().canopen_node().is_some())
        {
            poll_frames.push(canopen::encode_sync());
        }
        // The load of the bus includes the answers. Motors that report at their own rate cause a
        // load that does not depend on the polling rate, so this load is counted separately.
        let mut cycle_frames = poll_frames.clone();
        let mut unsolicited = Vec::new();
        for (answer, own_rate_hz) in motors
            .iter()
            .map(|(_, motor)| motor.protocol().typical_answer())
        {
            match own_rate_hz {
                Some(own_rate_hz) => unsolicited.push((answer, own_rate_hz)),
                None => cycle_frames.push(answer),
            }
        }
        let poll_rate_hz = if poll_frames.is_empty() {
            // Nothing is polled; the motors choose their own rates.
            rate_hz
        } else {
            max_cycle_rate_hz(bus, &cycle_frames, &unsolicited, rate_hz)
        };
        Self {
            poll_frames,
            period: Duration::from_secs_f64(1.0 / poll_rate_hz),
        }
    }
}

/// Frames that the thread of a bus has received and lost so far.
struct Progress {
    /// Time at which each motor was last heard.
    last_heard: Vec<Stamp>,
    errors: WireErrors,
    /// Readings that did not fit into the queue.
    n_dropped: u64,
    /// Polls for which the interface had no space.
    n_unsent: u64,
}

impl Progress {
    /// Excludes a stall of this computer from the measured silence of the motors, because no frames
    /// were read during the stall.
    fn excuse_silence(&mut self, stall: Duration) {
        for last_heard in &mut self.last_heard {
            *last_heard = last_heard.plus_secs(stall.as_secs_f64());
        }
    }
}

/// A bus with its motors, owned by the thread of the bus.
struct BusReader {
    bus: Bus,
    motors: Vec<(usize, Motor)>,
    cycle: Cycle,
    sender: SyncSender<Result<JointReading, Error>>,
    stop: Arc<AtomicBool>,
}

impl BusReader {
    fn run(self) {
        if let Err(error) = self.read() {
            // The receiver may be gone, or so far behind that the arm counts as silent anyway.
            let _ = self.sender.try_send(Err(error));
        }
    }

    fn read(&self) -> Result<(), Error> {
        let start = clock::now();
        let mut next_cycle = start;
        let mut previous = start;
        // An iteration waits up to `POLL` for a frame. It also waits for each poll that finds the
        // queue of the interface full. These waits on a blocked bus are not a stall of this
        // computer, so the motors of the bus count as silent meanwhile.
        let n_polls = u32::try_from(self.cycle.poll_frames.len()).unwrap_or(u32::MAX);
        let max_iteration = POLL + MAX_SENDING.saturating_mul(n_polls) + MAX_LOOP_DELAY;
        let mut progress = Progress {
            last_heard: vec![start; self.motors.len()],
            errors: WireErrors::default(),
            n_dropped: 0,
            n_unsent: 0,
        };
        while !self.stop.load(Ordering::Relaxed) {
            let now = clock::now();
            let stall = now.duration_since(std::mem::replace(&mut previous, now));
            if stall > max_iteration {
                progress.excuse_silence(stall);
            }
            if !self.cycle.poll_frames.is_empty() && now >= next_cycle {
                self.poll(&mut progress)?;
                // Missed cycles are not made up for.
                next_cycle = (next_cycle + self.cycle.period).max(now);
                // On a busy bus, `receive` never times out, so silence is checked here as well.
                self.check_silence(&progress, now)?;
            }
            let remaining = if self.cycle.poll_frames.is_empty() {
                POLL
            } else {
                next_cycle.duration_since(now).min(POLL)
            };
            match self.bus.receive(remaining)? {
                Some((stamp, BusEvent::Frame(frame))) => {
                    if !self.deliver(&frame, stamp, now, &mut progress) {
                        return Ok(());
                    }
                }
                Some((_, BusEvent::Errors(new_errors))) => {
                    self.log_errors(&mut progress.errors, &new_errors)
                }
                None => self.check_silence(&progress, clock::now())?,
            }
        }
        self.log_summary(start, &progress);
        Ok(())
    }

    /// Sends the poll frames of one cycle.
    fn poll(&self, progress: &mut Progress) -> Result<(), Error> {
        for poll_frame in &self.cycle.poll_frames {
            // A poll that finds the queue full is only counted, because the next cycle sends a new
            // poll. If the bus stays blocked, its motors count as silent.
            progress.n_unsent += u64::from(!self.bus.send(poll_frame)?);
        }
        Ok(())
    }

    /// Passes the reading in a frame, if there is one, to the arm. `now` is the time of reading.
    /// Returns whether the arm still exists.
    fn deliver(&self, frame: &Frame, stamp: Stamp, now: Stamp, progress: &mut Progress) -> bool {
        for (ix, (joint_ix, motor)) in self.motors.iter().enumerate() {
            let Some(reading) = motor.read(frame) else {
                continue;
            };
            // The time of reading is used instead of the stamp, because a motor is not silent if
            // only the reader is late.
            progress.last_heard[ix] = now;
            let reading_of_joint = JointReading {
                joint_ix: *joint_ix,
                stamp,
                reading,
            };
            match self.sender.try_send(Ok(reading_of_joint)) {
                Ok(()) => {}
                // Waiting for a slow caller would fill the socket's buffer, and frames would be
                // lost without being counted.
                Err(TrySendError::Full(_)) => progress.n_dropped += 1,
                Err(TrySendError::Disconnected(_)) => return false,
            }
            // Addresses on a bus are unique, so no other motor has sent this frame.
            break;
        }
        true
    }

    /// Logs how well the bus was read since `start`.
    fn log_summary(&self, start: Stamp, progress: &Progress) {
        let seconds = clock::now().secs_since(start);
        let interface = &self.bus.config().interface;
        // The bound avoids a division by zero if the arm is dropped at once.
        let load = 100.0 * self.bus.busy().as_secs_f64() / seconds.max(1e-9);
        let Progress {
            errors,
            n_dropped,
            n_unsent,
            ..
        } = progress;
        log::info!(
            "{interface}: bus load {load:.1} % without stuff bits; {n_unsent} polls not sent (queue full), {n_dropped} readings dropped; \
             errors on the wire: {errors}"
        );
    }

    /// Returns an error for the first motor that has been silent for too long. After this error,
    /// the arm returns no more joint states. The error includes the errors on the wire, because a
    /// failed bus silences its motors, too.
    fn check_silence(&self, progress: &Progress, now: Stamp) -> Result<(), Error> {
        let silent = |last_heard: &Stamp| now.duration_since(*last_heard) > MAX_SILENCE;
        let Some(((_, motor), _)) = self
            .motors
            .iter()
            .zip(&progress.last_heard)
            .find(|(_, last_heard)| silent(last_heard))
        else {
            return Ok(());
        };
        let errors = &progress.errors;
        let mut reason = format!("no frame from the motor for {MAX_SILENCE:?}");
        if errors.n_frames > 0 {
            reason += &format!("; errors on the wire so far: {errors}");
        }
        let interface = self.bus.config().interface.clone();
        Err(Error::Motor {
            joint: motor.config().joint.clone(),
            interface,
            reason,
        })
    }

    /// Logs errors on the wire each time the controller goes bus-off or restarts. Otherwise, logs
    /// them each time their number has doubled.
    fn log_errors(&self, total: &mut WireErrors, new_errors: &WireErrors) {
        // A controller retransmits an unacknowledged frame continuously, and each attempt may be
        // reported. Logging at powers of two shows the first errors at once and does not flood the
        // log.
        let previous = total.n_frames.checked_ilog2();
        total.add(new_errors);
        if new_errors.n_bus_off + new_errors.n_restarts > 0
            || total.n_frames.checked_ilog2() != previous
        {
            log::warn!(
                "{}: errors on the wire so far: {total}",
                self.bus.config().interface
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::config::{FollowingLimits, MotorConfig};
    use super::super::damiao::Damiao;
    use super::*;

    #[test]
    fn maximum_silence_is_documented() {
        let row = format!("| CAN motors | {} s |", MAX_SILENCE.as_secs());
        assert!(include_str!("../../../docs/reference/rig.md").contains(&row));
    }

    #[test]
    fn rate_keeps_classic_bus_load_under_70_percent() {
        let bus = BusConfig {
            interface: "can0".to_owned(),
            bitrate_hz: 1_000_000,
            data_bitrate_hz: None,
            accept_no_restart: false,
        };
        let motors: Vec<_> = (0..7)
            .map(|ix| {
                let protocol = Arc::new(Damiao {
                    motor: ix + 1,
                    feedback: 0x10 + ix,
                });
                let joint = format!("joint{ix}");
                let config = MotorConfig {
                    joint,
                    bus_ix: 0,
                    protocol,
                    gear_ratio: 1.0,
                    is_reversed: false,
                    offset_rad: 0.0,
                    gains: None,
                    following: FollowingLimits::default(),
                };
                (
                    usize::from(ix),
                    Motor::with_limits(config, crate::wire::can::mit::Limits::of(12.5, 30.0, 10.0)),
                )
            })
            .collect();
        // Seven motors with two frames each need 1.89 ms per cycle, at no more than 135 bits per
        // frame.
        let cycle = Cycle::new(&bus, &motors, 500.0);
        let rate_hz = 1.0 / cycle.period.as_secs_f64();
        assert!((rate_hz - 0.7 / (14.0 * 135e-6)).abs() < 0.1, "{rate_hz}");
        assert_eq!(
            Cycle::new(&bus, &motors[..2], 500.0).period,
            Duration::from_millis(2),
            "two motors fit"
        );
    }
}
