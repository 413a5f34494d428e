//! An arm whose joints are motors on CAN buses: a thread a bus asks and listens, the caller gets states of all joints.

use super::bus::{Arrived, Bus, WireErrors};
use super::config::{ArmConfig, BusConfig};
use super::motor::{Motor, Reading};
use crate::wire::can::frame::{Bits, Stuffing, load_frac};
use crate::wire::can::{Frame, canopen};
use crate::{Arm, Error, clock};
use kinematics::{JointState, Stamp};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Most of the bus that asking and answering may take: errors are repeated, and others may speak too.
const MAX_LOAD_FRAC: f64 = 0.7;
/// How soon a bus's thread notices that it is to stop, where no cycle is due before.
const POLL: Duration = Duration::from_millis(50);
/// Readings that may wait for a slow caller: a second of seven motors at 1 kHz.
const MAX_WAITING: usize = 7000;
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

/// What a motor told.
#[derive(Debug)]
struct Told {
    joint_ix: usize,
    stamp: Stamp,
    reading: Reading,
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

/// The newest readings of all joints.
#[derive(Debug)]
struct Joints {
    newest: Vec<Option<(Stamp, Reading)>>,
}

impl Joints {
    fn new(n: usize) -> Self {
        Self { newest: vec![None; n] }
    }

    /// Takes a reading; gives a state and begins anew once every joint has one.
    fn take(&mut self, told: &Told) -> Option<JointState> {
        self.newest[told.joint_ix] = Some((told.stamp, told.reading));
        let all = self.newest.iter().copied().collect::<Option<Vec<_>>>()?;
        self.newest.fill(None);
        let stamp = all.iter().map(|(stamp, _)| *stamp).max()?;
        let at = |(then, reading): &(Stamp, Reading)| {
            reading.position_rad + reading.velocity_rad_s * stamp.secs_since(*then)
        };
        Some(JointState {
            stamp,
            position: all.iter().map(at).collect(),
            velocity: all.iter().map(|(_, reading)| reading.velocity_rad_s).collect(),
            effort: all.iter().map(|(_, reading)| reading.effort_nm).collect::<Option<_>>().unwrap_or_default(),
        })
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
        let worst = |frame: &Frame| frame.bits(Stuffing::Worst);
        let mut of_a_cycle: Vec<Bits> = questions.iter().map(worst).collect();
        let mut unasked = Vec::new();
        for (answer, own_rate_hz) in motors.iter().map(|(_, motor)| motor.usual_answer()) {
            match own_rate_hz {
                Some(own_rate_hz) => unasked.push((worst(&answer), own_rate_hz)),
                None => of_a_cycle.push(worst(&answer)),
            }
        }
        let unasked = load_frac(unasked, bus.rates());
        let per_cycle = load_frac(of_a_cycle.iter().map(|bits| (*bits, 1.0)), bus.rates());
        let most_hz = ((MAX_LOAD_FRAC - unasked) / per_cycle).max(1.0);
        let asked_hz = rate_hz.min(most_hz);
        let load = 100.0 * (unasked + per_cycle * if questions.is_empty() { 0.0 } else { asked_hz });
        let interface = &bus.interface;
        if asked_hz < rate_hz && !questions.is_empty() {
            log::warn!(
                "{interface}: {} motors at {rate_hz} Hz would take more than {:.0} % of the bus; they are asked at {asked_hz:.0} Hz \
                 ({load:.0} %): a second bus or FD makes room",
                motors.len(),
                100.0 * MAX_LOAD_FRAC
            );
        } else {
            log::info!("{interface}: {} motors take {load:.0} % of the bus at most", motors.len());
        }
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
        while !self.stop.load(Ordering::Relaxed) {
            let now = clock::now();
            if !self.cycle.questions.is_empty() && now >= next_cycle {
                for question in &self.cycle.questions {
                    n_unsent += u64::from(!self.bus.send(question)?);
                }
                // Cycles that were missed are not made up for.
                next_cycle = (next_cycle + self.cycle.period).max(now);
                self.look_for_silence(&heard, now)?;
            }
            let left = if self.cycle.questions.is_empty() { POLL } else { next_cycle.duration_since(now).min(POLL) };
            match self.bus.receive(left)? {
                Some((stamp, Arrived::Frame(frame))) => {
                    for (ix, (joint_ix, motor)) in self.motors.iter().enumerate() {
                        let Some(reading) = motor.read(&frame) else { continue };
                        heard[ix] = stamp;
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
                None => self.look_for_silence(&heard, clock::now())?,
            }
        }
        let seconds = clock::now().secs_since(began);
        let interface = &self.bus.config().interface;
        let load = 100.0 * self.bus.busy().as_secs_f64() / seconds.max(1e-9);
        log::info!(
            "{interface}: {load:.1} % of the bus was in use, stuff bits left out; {n_unsent} questions found no room, {n_dropped} readings were dropped"
        );
        Ok(())
    }

    /// The first motor that has said nothing for too long is an error: the joints' states stop with it.
    fn look_for_silence(&self, heard: &[Stamp], now: Stamp) -> Result<(), Error> {
        match self.motors.iter().zip(heard).find(|(_, heard)| now.duration_since(**heard) > MAX_SILENCE) {
            Some(((_, motor), _)) => Err(Error::Motor {
                joint: motor.config().joint.clone(),
                interface: self.bus.config().interface.clone(),
                reason: format!("it has said nothing for {MAX_SILENCE:?}"),
            }),
            None => Ok(()),
        }
    }

    /// Logs errors on the wire: every time that the bus was lost, and others each time that they have doubled.
    fn tell_errors(&self, sum: &mut WireErrors, more: &WireErrors) {
        let before = sum.n_frames.checked_ilog2();
        sum.add(more);
        if more.n_bus_off + more.n_restarts > 0 || sum.n_frames.checked_ilog2() != before {
            log::warn!("{}: errors on the wire so far: {sum:?}", self.bus.config().interface);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::config::{Family, MotorConfig};
    use super::*;

    fn told(joint_ix: usize, millis: i64, position_rad: f64) -> Told {
        let reading = Reading { position_rad, velocity_rad_s: 2.0, effort_nm: Some(0.5) };
        Told { joint_ix, stamp: Stamp(millis * 1_000_000), reading }
    }

    #[test]
    fn a_state_waits_for_all_joints_and_carries_them_on_to_the_newest() {
        let mut joints = Joints::new(3);
        assert_eq!(joints.take(&told(0, 1, 0.0)), None);
        assert_eq!(joints.take(&told(2, 2, 0.2)), None);
        assert_eq!(joints.take(&told(0, 3, 0.1)), None, "the newer one counts");
        let state = joints.take(&told(1, 5, 0.3)).unwrap();
        assert_eq!(state.stamp, Stamp(5_000_000));
        let expected = [0.1 + 2.0 * 0.002, 0.3, 0.2 + 2.0 * 0.003];
        assert!(state.position.iter().zip(expected).all(|(got, expected)| (got - expected).abs() < 1e-12));
        assert_eq!((state.velocity, state.effort), (vec![2.0; 3], vec![0.5; 3]));
        assert_eq!(joints.take(&told(1, 6, 0.3)), None, "it begins anew");
    }

    #[test]
    fn the_rate_keeps_the_load_of_a_classic_bus_under_seventy_percent() {
        let bus = BusConfig { interface: "can0".to_owned(), bitrate_hz: 1_000_000, data_bitrate_hz: None };
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
