//! An arm whose joints are motors on CAN buses: a thread a bus asks and listens, the caller gets states of all joints.

use super::bus::{Arrived, Bus, WireErrors};
use super::config::{ArmConfig, BusConfig};
use super::joints::{Joints, Told};
use super::motor::Motor;
use super::pace::affordable_hz;
use crate::wire::can::{Frame, canopen};
use crate::{Arm, Error, clock};
use kinematics::{JointState, Stamp};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// How soon a bus's thread notices that it is to stop, where no cycle is due before.
const POLL: Duration = Duration::from_millis(50);
/// Readings that may wait for a slow caller: a second of seven motors at 1 kHz.
pub(super) const MAX_WAITING: usize = 7000;
/// A turn of a bus's thread that took longer was held up from outside.
const MAX_TURN: Duration = Duration::from_millis(200);
/// A motor that says nothing for so long while the others do is told.
const MAX_SILENCE: Duration = Duration::from_secs(1);

/// An arm that is read; nothing here moves it. Dropping it stops asking; motors keep doing what they did.
#[derive(Debug)]
pub struct CanArm {
    names: Vec<String>,
    arriving: Receiver<Result<Told, Error>>,
    joints: Joints,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl CanArm {
    /// Checks how the buses are set up, finds all motors and starts to read; the first that does not answer is an error.
    pub fn open(config: &ArmConfig) -> Result<Self, Error> {
        let (sender, arriving) = sync_channel(MAX_WAITING);
        let stop = Arc::new(AtomicBool::new(false));
        let mut buses = Vec::new();
        for (bus_ix, bus) in config.buses.iter().enumerate() {
            let bus = Bus::open(bus)?;
            let own = config.motors.iter().enumerate().filter(|(_, motor)| motor.bus_ix == bus_ix);
            let motors = own.map(|(joint_ix, motor)| Ok((joint_ix, Motor::set_up(&bus, motor)?)));
            let motors = motors.collect::<Result<Vec<_>, Error>>()?;
            buses.push((bus, motors));
        }
        let names: Vec<String> = config.motors.iter().map(|motor| motor.joint.clone()).collect();
        let mut arm = Self { joints: Joints::new(names.len()), names, arriving, stop, threads: Vec::new() };
        for (bus, motors) in buses {
            let cycle = Cycle::new(bus.config(), &motors, config.rate_hz);
            let device = format!("CAN {}", bus.config().interface);
            let line = Line { bus, motors, cycle, sender: sender.clone(), stop: Arc::clone(&arm.stop) };
            let thread = std::thread::Builder::new().name(device.clone()).spawn(move || line.run());
            arm.threads.push(thread.map_err(|source| Error::Thread { device, source })?);
        }
        Ok(arm)
    }
}

impl Arm for CanArm {
    fn joint_names(&self) -> &[String] {
        &self.names
    }

    /// A state of all joints is told as soon as each has told something new; it is stamped with the newest of these readings, and
    /// the others are carried on to there with their own velocity.
    fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
        let until = Instant::now() + timeout;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            match self.arriving.recv_timeout(left) {
                Ok(Ok(told)) => {
                    if let Some(state) = self.joints.take(&told) {
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
            // A thread that panicked has said so.
            let _ = thread.join();
        }
    }
}

/// What is sent again and again on a bus.
#[derive(Debug)]
struct Cycle {
    questions: Vec<Frame>,
    period: Duration,
}

impl Cycle {
    /// Asks as often as wanted, or as often as keeps the bus's load in bounds.
    fn new(bus: &BusConfig, motors: &[(usize, Motor)], rate_hz: f64) -> Self {
        let mut questions: Vec<_> = motors.iter().filter_map(|(_, motor)| motor.question()).collect();
        if motors.iter().any(|(_, motor)| motor.wants_sync()) {
            questions.push(canopen::encode_sync());
        }
        let mut of_a_cycle = questions.clone();
        let mut unasked = Vec::new();
        for (answer, own_rate_hz) in motors.iter().map(|(_, motor)| motor.usual_answer()) {
            match own_rate_hz {
                Some(own_rate_hz) => unasked.push((answer, own_rate_hz)),
                None => of_a_cycle.push(answer),
            }
        }
        let asked_hz = match questions.is_empty() {
            // Nobody is asked; what comes, comes as often as the motors have it.
            true => rate_hz,
            false => affordable_hz(bus, &of_a_cycle, &unasked, rate_hz),
        };
        Self { questions, period: Duration::from_secs_f64(1.0 / asked_hz) }
    }
}

/// A bus with its motors, on its thread.
struct Line {
    bus: Bus,
    motors: Vec<(usize, Motor)>,
    cycle: Cycle,
    sender: SyncSender<Result<Told, Error>>,
    stop: Arc<AtomicBool>,
}

impl Line {
    fn run(self) {
        if let Err(error) = self.read() {
            // Nobody may listen any more, or be so far behind that the arm is as good as silent.
            let _ = self.sender.try_send(Err(error));
        }
    }

    fn read(&self) -> Result<(), Error> {
        let began = clock::now();
        let mut next_cycle = began;
        let mut errors = WireErrors::default();
        let mut heard: Vec<Stamp> = vec![began; self.motors.len()];
        let (mut n_dropped, mut n_unsent) = (0_u64, 0_u64);
        let mut before = began;
        while !self.stop.load(Ordering::Relaxed) {
            let now = clock::now();
            let stood_still = now.duration_since(std::mem::replace(&mut before, now));
            if stood_still > MAX_TURN {
                // While this computer did something else, nobody listened: no motor is silent for that.
                heard.iter_mut().for_each(|heard| *heard = heard.plus_secs(stood_still.as_secs_f64()));
            }
            if !self.cycle.questions.is_empty() && now >= next_cycle {
                for question in &self.cycle.questions {
                    n_unsent += u64::from(!self.bus.send(question)?);
                }
                // Cycles that were missed are not made up for.
                next_cycle = (next_cycle + self.cycle.period).max(now);
                self.look_for_silence(&heard, now, &errors)?;
            }
            let left = if self.cycle.questions.is_empty() { POLL } else { next_cycle.duration_since(now).min(POLL) };
            match self.bus.receive(left)? {
                Some((stamp, Arrived::Frame(frame))) => {
                    for (ix, (joint_ix, motor)) in self.motors.iter().enumerate() {
                        let Some(reading) = motor.read(&frame) else { continue };
                        // Not its stamp: whoever reads late does not make a motor silent.
                        heard[ix] = now;
                        let told = Told { joint_ix: *joint_ix, stamp, reading };
                        match self.sender.try_send(Ok(told)) {
                            Ok(()) => {}
                            Err(TrySendError::Full(_)) => n_dropped += 1,
                            Err(TrySendError::Disconnected(_)) => return Ok(()),
                        }
                        break;
                    }
                }
                Some((_, Arrived::Errors(more))) => self.tell_errors(&mut errors, &more),
                None => self.look_for_silence(&heard, clock::now(), &errors)?,
            }
        }
        let seconds = clock::now().secs_since(began);
        let interface = &self.bus.config().interface;
        let load = 100.0 * self.bus.busy().as_secs_f64() / seconds.max(1e-9);
        log::info!(
            "{interface}: {load:.1} % of the bus was in use, stuff bits left out; {n_unsent} questions found no room, {n_dropped} readings were dropped; \
             errors on the wire: {errors}"
        );
        Ok(())
    }

    /// The first motor that has said nothing for too long is an error: the joints' states stop with it. What was wrong on the wire is
    /// told with it, for a bus that is lost silences motors, too.
    fn look_for_silence(&self, heard: &[Stamp], now: Stamp, errors: &WireErrors) -> Result<(), Error> {
        let silent = |heard: &Stamp| now.duration_since(*heard) > MAX_SILENCE;
        let Some(((_, motor), _)) = self.motors.iter().zip(heard).find(|(_, heard)| silent(heard)) else {
            return Ok(());
        };
        let mut reason = format!("it has said nothing for {MAX_SILENCE:?}");
        if errors.n_frames > 0 {
            reason += &format!("; errors on the wire so far: {errors}");
        }
        let interface = self.bus.config().interface.clone();
        Err(Error::Motor { joint: motor.config().joint.clone(), interface, reason })
    }

    /// Logs errors on the wire: every time that the bus was lost, and others each time that they have doubled.
    fn tell_errors(&self, sum: &mut WireErrors, more: &WireErrors) {
        let before = sum.n_frames.checked_ilog2();
        sum.add(more);
        if more.n_bus_off + more.n_restarts > 0 || sum.n_frames.checked_ilog2() != before {
            log::warn!("{}: errors on the wire so far: {sum}", self.bus.config().interface);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::config::{Family, MotorConfig};
    use super::*;

    #[test]
    fn the_rate_keeps_the_load_of_a_classic_bus_under_seventy_percent() {
        let bus = BusConfig {
            interface: "can0".to_owned(),
            bitrate_hz: 1_000_000,
            data_bitrate_hz: None,
            accept_no_restart: false,
        };
        let motors: Vec<_> = (0..7)
            .map(|ix| {
                let family = Family::Damiao { motor: ix + 1, feedback: 0x10 + ix };
                let joint = format!("joint{ix}");
                let config = MotorConfig {
                    joint,
                    bus_ix: 0,
                    family,
                    gear_ratio: 1.0,
                    is_reversed: false,
                    offset_rad: 0.0,
                    gains: None,
                };
                (usize::from(ix), Motor::with_limits(config, crate::wire::can::mit::Limits::of(12.5, 30.0, 10.0)))
            })
            .collect();
        // Seven motors, two frames of 135 bits at worst each: 1.89 ms a cycle.
        let cycle = Cycle::new(&bus, &motors, 500.0);
        let rate_hz = 1.0 / cycle.period.as_secs_f64();
        assert!((rate_hz - 0.7 / (14.0 * 135e-6)).abs() < 0.1, "{rate_hz}");
        assert_eq!(Cycle::new(&bus, &motors[..2], 500.0).period, Duration::from_millis(2), "two motors fit");
    }
}
