//! Reads an arm whose joints are motors on CAN buses. One thread per bus polls and listens; the
//! caller receives states of all joints.

use super::bus::Bus;
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

/// Interval at which a bus thread checks whether it should stop, if no cycle is due earlier.
const POLL: Duration = Duration::from_millis(50);
/// Capacity of the queue of readings for a slow caller: one second of seven motors at 1 kHz.
pub(super) const MAX_WAITING: usize = 7000;
/// If a loop iteration of a bus thread takes longer than this, the thread was not scheduled.
const MAX_LOOP_DELAY: Duration = Duration::from_millis(200);
/// A motor that sends nothing for this long causes an error.
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
        let (sender, readings) = sync_channel(MAX_WAITING);
        let stop = Arc::new(AtomicBool::new(false));
        let mut buses = Vec::new();
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
    /// the stamp of the newest of these readings; the others are extrapolated to it with their own
    /// velocity.
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
            .any(|(_, motor)| motor.protocol().canopen_node().is_some())
        {
            poll_frames.push(canopen::encode_sync());
        }
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
        let poll_rate_hz = match poll_frames.is_empty() {
            // Nothing is polled; the motors choose their own rates.
            true => rate_hz,
            false => max_cycle_rate_hz(bus, &cycle_frames, &unsolicited, rate_hz),
        };
        Self {
            poll_frames,
            period: Duration::from_secs_f64(1.0 / poll_rate_hz),
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
        let mut errors = WireErrors::default();
        let mut last_heard: Vec<Stamp> = vec![start; self.motors.len()];
        let (mut n_dropped, mut n_unsent) = (0_u64, 0_u64);
        let mut previous = start;
        while !self.stop.load(Ordering::Relaxed) {
            let now = clock::now();
            let stall = now.duration_since(std::mem::replace(&mut previous, now));
            if stall > MAX_LOOP_DELAY {
                // While this computer was stalled, no frames were read, so this time does not count
                // as silence of a motor.
                last_heard
                    .iter_mut()
                    .for_each(|last_heard| *last_heard = last_heard.plus_secs(stall.as_secs_f64()));
            }
            if !self.cycle.poll_frames.is_empty() && now >= next_cycle {
                for poll_frame in &self.cycle.poll_frames {
                    n_unsent += u64::from(!self.bus.send(poll_frame)?);
                }
                // Missed cycles are not made up for.
                next_cycle = (next_cycle + self.cycle.period).max(now);
                self.check_silence(&last_heard, now, &errors)?;
            }
            let remaining = if self.cycle.poll_frames.is_empty() {
                POLL
            } else {
                next_cycle.duration_since(now).min(POLL)
            };
            match self.bus.receive(remaining)? {
                Some((stamp, BusEvent::Frame(frame))) => {
                    for (ix, (joint_ix, motor)) in self.motors.iter().enumerate() {
                        let Some(reading) = motor.read(&frame) else {
                            continue;
                        };
                        // Uses the time of reading, not the stamp: a late reader does not make a
                        // motor silent.
                        last_heard[ix] = now;
                        let reading_of_joint = JointReading {
                            joint_ix: *joint_ix,
                            stamp,
                            reading,
                        };
                        match self.sender.try_send(Ok(reading_of_joint)) {
                            Ok(()) => {}
                            Err(TrySendError::Full(_)) => n_dropped += 1,
                            Err(TrySendError::Disconnected(_)) => return Ok(()),
                        }
                        break;
                    }
                }
                Some((_, BusEvent::Errors(new_errors))) => {
                    self.log_errors(&mut errors, &new_errors)
                }
                None => self.check_silence(&last_heard, clock::now(), &errors)?,
            }
        }
        let seconds = clock::now().secs_since(start);
        let interface = &self.bus.config().interface;
        let load = 100.0 * self.bus.busy().as_secs_f64() / seconds.max(1e-9);
        log::info!(
            "{interface}: bus load {load:.1} % without stuff bits; {n_unsent} polls not sent (queue full), {n_dropped} readings dropped; \
             errors on the wire: {errors}"
        );
        Ok(())
    }

    /// Returns an error for the first motor that has been silent for too long; this ends the joint
    /// states. The error includes the errors on the wire, because a failed bus silences its motors,
    /// too.
    fn check_silence(
        &self,
        last_heard: &[Stamp],
        now: Stamp,
        errors: &WireErrors,
    ) -> Result<(), Error> {
        let silent = |last_heard: &Stamp| now.duration_since(*last_heard) > MAX_SILENCE;
        let Some(((_, motor), _)) = self
            .motors
            .iter()
            .zip(last_heard)
            .find(|(_, last_heard)| silent(last_heard))
        else {
            return Ok(());
        };
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

    /// Logs errors on the wire each time the controller goes bus-off or restarts, and otherwise
    /// each time their number has doubled.
    fn log_errors(&self, total: &mut WireErrors, new_errors: &WireErrors) {
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
        // Seven motors with two frames each, at most 135 bits per frame: 1.89 ms per cycle.
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
