//! The thread that moves an arm: it makes the motors ready, switches them on, sends setpoints, and stops for good where anything is
//! not as it must be.
//!
//! What stops it: a motor that is silent or tells that it stopped, a bus that is lost, and this computer itself, when it stood still for
//! so long that the motors have stopped by themselves or are about to. No setpoint of before is sent then, and none before somebody
//! asks for [`Request::Recover`].

use super::bus::{Arrived, Bus, WireErrors};
use super::config::Family;
use super::joints::Told;
use super::motor::Reading;
use super::movable::MovableArmConfig;
use super::mover::{Health, Mover};
use super::pace::affordable_hz;
use super::watchdog::Plan;
use crate::motion::{Generator, JointTarget, Motion, MotionLimits, OnLoss};
use crate::wire::can::Frame;
use crate::wire::can::canopen::{self, NodeState};
use crate::{Error, clock};
use kinematics::Stamp;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Share of the motors' timeout after which we stop by ourselves: before they do, so that none is commanded that others have left.
const PATIENCE_FRAC: f64 = 0.8;
/// The timeout must leave room for so many cycles.
const MIN_CYCLES: u32 = 4;
/// A motor is silent only after so many cycles: where we were late ourselves, its answer is still to come.
const MIN_UNHEARD: u64 = 3;
/// How long motors may take to say where they are, and that they are switched on.
const MAX_STARTING: Duration = Duration::from_secs(2);
/// A queue of ten frames, as interfaces have it, is half empty after so long.
const MAX_QUEUED: Duration = Duration::from_micros(800);
/// Last words may wait so long for room in the queue; one that stays full has nobody who listens.
const MAX_LAST_QUEUED: Duration = Duration::from_millis(5);
/// How soon a thread with nothing to do looks whether it is asked for something.
const POLL: Duration = Duration::from_millis(20);
/// Beyond the time that its limits need, an arm that ends may take so long to come to rest.
const MAX_LONGER: Duration = Duration::from_secs(1);

type Answer<T> = SyncSender<Result<T, Error>>;

/// What the arm's owner wants.
#[derive(Debug)]
pub(super) enum Request {
    /// To go somewhere; the answer is where it goes.
    HeadFor(JointTarget, Answer<JointTarget>),
    /// To come to rest.
    Stop(Answer<()>),
    /// To be made ready and switched on; the answer comes when it is.
    Recover(Answer<()>),
}

/// What is being done.
#[derive(Debug)]
enum Phase {
    /// Nothing is commanded since; what the motors were told to do is told again as long as some may not have heard it.
    Stopped { since: Stamp, reason: String, told: Option<OnLoss> },
    /// All motors are ready and off, and are asked where they are.
    Measuring { since: Stamp, asked: Answer<()> },
    /// They are commanded to stay there, and switched on.
    Enabling { since: Stamp, is_ordered: bool, generator: Box<Generator>, asked: Answer<()> },
    /// They follow.
    Moving { generator: Box<Generator> },
}

/// Buses and motors that were made ready.
#[derive(Debug)]
struct Ready {
    buses: Vec<Bus>,
    /// A motor a joint.
    movers: Vec<Mover>,
    /// When each was heard last, and in which cycle.
    heard: Vec<(Stamp, u64)>,
    newest: Vec<Option<Reading>>,
    /// Where each was sent last.
    sent_rad: Vec<f64>,
    cycle_ix: u64,
    errors: WireErrors,
}

/// The thread's state.
#[derive(Debug)]
pub(super) struct Moving {
    config: MovableArmConfig,
    plan: Plan,
    requests: Receiver<Request>,
    readings: SyncSender<Result<Told, Error>>,
    motion: Arc<Mutex<Motion>>,
    is_ending: Arc<AtomicBool>,
    ready: Option<Ready>,
    phase: Phase,
    /// When the last cycle began, on a clock that counts while the computer sleeps.
    last_cycle: Stamp,
    /// Cycles that began so late that they were put off.
    n_late: u64,
    latest: Duration,
}

impl Moving {
    /// Fails where the arm cannot be moved as planned; nothing is sent.
    pub(super) fn new(
        config: &MovableArmConfig,
        requests: Receiver<Request>,
        readings: SyncSender<Result<Told, Error>>,
        motion: Arc<Mutex<Motion>>,
        is_ending: Arc<AtomicBool>,
    ) -> Result<Self, Error> {
        let plan = Plan::new(config)?;
        let phase = Phase::stopped(clock::now(), None);
        Ok(Self {
            config: config.clone(),
            plan,
            requests,
            readings,
            motion,
            is_ending,
            ready: None,
            phase,
            last_cycle: clock::now_with_sleep(),
            n_late: 0,
            latest: Duration::ZERO,
        })
    }

    /// Works until the arm's owner drops it.
    pub(super) fn run(mut self) {
        let mut next_cycle = clock::now();
        let mut must_end_by = None;
        loop {
            if self.is_ending.load(Ordering::Relaxed) {
                let by = *must_end_by.get_or_insert_with(|| clock::now() + self.longest_stop());
                if self.is_at_rest() || clock::now() > by {
                    break;
                }
            }
            while let Ok(request) = self.requests.try_recv() {
                self.obey(request);
            }
            let now = clock::now();
            if now >= next_cycle {
                if let Err(error) = self.cycle(now) {
                    self.give_up(&reason_of(&error));
                }
                // Cycles that were missed are not made up for, and no two come at once.
                next_cycle += self.plan.period;
                if next_cycle < now {
                    next_cycle = now + self.plan.period;
                }
            }
            let heard = self.listen(next_cycle.duration_since(clock::now()).min(POLL));
            if let Err(error) = heard {
                self.give_up(&reason_of(&error));
            }
        }
        self.end();
    }

    fn obey(&mut self, request: Request) {
        // Whoever asked may have gone.
        match (request, &mut self.phase) {
            (Request::HeadFor(target, answer), Phase::Moving { generator }) => {
                let taken = generator.head_for(&target).map_err(|reason| Error::Motion { reason });
                if taken.is_ok() {
                    // Whoever hears that a target is taken may wait for its end at once.
                    *self.motion.lock().unwrap_or_else(PoisonError::into_inner) = Motion::Moving;
                }
                let _ = answer.try_send(taken);
            }
            (Request::Stop(answer), Phase::Moving { generator }) => {
                generator.stop();
                let _ = answer.try_send(Ok(()));
            }
            (Request::HeadFor(_, answer), phase) => drop(answer.try_send(Err(phase.refusal()))),
            // What does not move is at rest.
            (Request::Stop(answer), _) => drop(answer.try_send(Ok(()))),
            (Request::Recover(answer), Phase::Stopped { .. }) => match self.make_ready() {
                Ok(ready) => {
                    self.ready = Some(ready);
                    self.last_cycle = clock::now_with_sleep();
                    self.phase = Phase::Measuring { since: clock::now(), asked: answer };
                }
                Err(error) => {
                    self.ready = None;
                    self.stopped(&reason_of(&error), None);
                    let _ = answer.try_send(Err(error));
                }
            },
            // It is switched on, or is being so.
            (Request::Recover(answer), _) => drop(answer.try_send(Ok(()))),
        }
    }

    /// Opens all buses anew and makes every motor ready; none is switched on.
    fn make_ready(&self) -> Result<Ready, Error> {
        let arm = &self.config.arm;
        let buses = arm.buses.iter().map(Bus::open).collect::<Result<Vec<_>, _>>()?;
        let movers = arm.motors.iter().map(|motor| Mover::make_ready(&buses[motor.bus_ix], motor, &self.plan));
        let movers = movers.collect::<Result<Vec<_>, _>>()?;
        let n = movers.len();
        Ok(Ready {
            buses,
            movers,
            heard: vec![(clock::now(), 0); n],
            newest: vec![None; n],
            sent_rad: vec![0.0; n],
            cycle_ix: 0,
            errors: WireErrors::default(),
        })
    }

    /// One cycle of whatever is being done.
    fn cycle(&mut self, now: Stamp) -> Result<(), Error> {
        let awake = clock::now_with_sleep();
        let stood_still = awake.duration_since(self.last_cycle);
        self.last_cycle = awake;
        let Some(ready) = &mut self.ready else { return Ok(()) };
        ready.cycle_ix += 1;
        if stood_still > 2 * self.plan.period {
            self.n_late += 1;
            self.latest = self.latest.max(stood_still);
        }
        let patience = self.plan.timeout.mul_f64(PATIENCE_FRAC);
        let is_late = stood_still > patience;
        let late = || motion(format!("this computer stood still for {:.0} ms", 1e3 * stood_still.as_secs_f64()));
        match &mut self.phase {
            Phase::Stopped { since, .. } => {
                // Questions, too, may keep a watchdog quiet: they wait until it has done its work.
                if now.duration_since(*since) > 2 * self.plan.timeout {
                    // A lost bus has been told.
                    let _ = ready.ask_stopped();
                }
                self.insist(now);
                return Ok(());
            }
            Phase::Measuring { since, .. } => {
                if let Some(positions) = ready.positions(*since) {
                    let limits = ready.limits(&self.config.motion.limits);
                    let generator = Generator::new(&limits, &positions, self.plan.period).map_err(motion)?;
                    ready.movers.iter_mut().for_each(Mover::forget);
                    let Phase::Measuring { asked, .. } = std::mem::replace(&mut self.phase, Phase::stopped(now, None))
                    else {
                        return Ok(());
                    };
                    let generator = Box::new(generator);
                    self.phase = Phase::Enabling { since: now, is_ordered: false, generator, asked };
                    return Ok(());
                }
                if now.duration_since(*since) > MAX_STARTING {
                    return Err(ready.silent_before_start());
                }
                ready.ask_unmoved()?;
                return ready.beat(self.plan.host);
            }
            Phase::Enabling { since, is_ordered, generator, .. } => {
                if is_late {
                    return Err(late());
                }
                ready.command(generator)?;
                if !*is_ordered {
                    *is_ordered = true;
                    ready.enable()?;
                    ready.command(generator)?;
                }
                ready.beat(self.plan.host)?;
                if now.duration_since(*since) > MAX_STARTING {
                    return Err(ready.not_enabled());
                }
                if !ready.do_all_obey() {
                    return Ok(());
                }
            }
            Phase::Moving { generator } => {
                if is_late {
                    return Err(late());
                }
                ready.check(now, patience)?;
                ready.command(generator)?;
                ready.beat(self.plan.host)?;
                let doing = if generator.is_held() { Motion::Held } else { Motion::Moving };
                *self.motion.lock().unwrap_or_else(PoisonError::into_inner) = doing;
                return Ok(());
            }
        }
        // All obey.
        if let Phase::Enabling { generator, asked, .. } = std::mem::replace(&mut self.phase, Phase::stopped(now, None))
        {
            self.phase = Phase::Moving { generator };
            *self.motion.lock().unwrap_or_else(PoisonError::into_inner) = Motion::Held;
            log::info!("the arm is switched on and held");
            let _ = asked.try_send(Ok(()));
        }
        Ok(())
    }

    /// Takes what comes until the time is over.
    fn listen(&mut self, timeout: Duration) -> Result<(), Error> {
        let Some(ready) = &mut self.ready else {
            std::thread::sleep(timeout);
            return Ok(());
        };
        Bus::wait_for_any(&ready.buses, timeout);
        let is_stopped = matches!(self.phase, Phase::Stopped { .. });
        for bus_ix in 0..ready.buses.len() {
            loop {
                let arrived = match ready.buses[bus_ix].receive(Duration::ZERO) {
                    Ok(Some(arrived)) => arrived,
                    Ok(None) => break,
                    Err(_) if is_stopped => {
                        // It has been told; one that stays lost must not keep this thread busy.
                        std::thread::sleep(timeout);
                        break;
                    }
                    Err(error) => return Err(error),
                };
                match arrived {
                    (stamp, Arrived::Frame(frame)) => {
                        if let Some(told) = ready.hear(bus_ix, stamp, &frame) {
                            // A slow reader loses the newest.
                            let _ = self.readings.try_send(Ok(told));
                        }
                    }
                    (_, Arrived::Errors(more)) => {
                        ready.errors.add(&more);
                        let interface = &ready.buses[bus_ix].config().interface;
                        log::debug!("{interface}: errors on the wire so far: {:?}", ready.errors);
                        if more.n_bus_off > 0 && !is_stopped {
                            return Err(motion(format!("{interface} went off the bus")));
                        }
                    }
                }
            }
        }
        Ok(())
    }

    /// Stops commanding: each motor is told what it would do by itself soon, and what is wrong is told.
    fn give_up(&mut self, reason: &str) {
        if let Phase::Stopped { .. } = self.phase {
            return;
        }
        let words = self.last_words();
        if let Some(ready) = &self.ready {
            ready.leave(words, |_| true);
        }
        self.stopped(reason, Some(words));
    }

    /// An arm that was not switched on as a whole is switched off as a whole.
    fn last_words(&self) -> OnLoss {
        if matches!(self.phase, Phase::Moving { .. }) { self.plan.on_loss } else { OnLoss::Release }
    }

    fn stopped(&mut self, reason: &str, told: Option<OnLoss>) {
        log::warn!("the arm stopped: {reason}");
        let stopped = Phase::Stopped { since: clock::now(), reason: reason.to_owned(), told };
        let before = std::mem::replace(&mut self.phase, stopped);
        *self.motion.lock().unwrap_or_else(PoisonError::into_inner) = Motion::Stopped { reason: reason.to_owned() };
        if let Phase::Measuring { asked, .. } | Phase::Enabling { asked, .. } = before {
            let _ = asked.try_send(Err(motion(reason.to_owned())));
        }
    }

    /// Whether nothing moves any more; one that moves is brought to rest.
    fn is_at_rest(&mut self) -> bool {
        match &mut self.phase {
            Phase::Moving { generator } => {
                generator.stop();
                generator.is_held()
            }
            _ => true,
        }
    }

    /// As long as coming to rest may take.
    fn longest_stop(&self) -> Duration {
        let secs = |joint: &MotionLimits| joint.velocity / joint.acceleration + 2.0 * joint.acceleration / joint.jerk;
        let longest = self.config.motion.limits.iter().map(secs).fold(0.0, f64::max);
        Duration::try_from_secs_f64(longest).unwrap_or(Duration::ZERO) + MAX_LONGER
    }

    /// The last words.
    fn end(mut self) {
        let words = self.last_words();
        if let Some(ready) = &self.ready
            && !matches!(self.phase, Phase::Stopped { .. })
        {
            ready.leave(words, |_| true);
            log::info!(
                "the arm is left with on_loss = {:?}; {} cycles, {} of them late, {:.1} ms at most",
                words.word(),
                ready.cycle_ix,
                self.n_late,
                1e3 * self.latest.as_secs_f64()
            );
            self.phase = Phase::stopped(clock::now(), Some(words));
        }
        while let Phase::Stopped { told: Some(_), .. } = self.phase {
            std::thread::sleep(self.plan.period);
            // A bus that is lost has been told.
            let _ = self.listen(Duration::ZERO);
            self.insist(clock::now());
        }
    }

    /// Motors without a watchdog would go on for ever where they did not hear the last words: they are told again, once a cycle, for as
    /// long as the others take to notice that nothing comes any more, and until they say something.
    fn insist(&mut self, now: Stamp) {
        let Phase::Stopped { since, told, .. } = &mut self.phase else { return };
        let (Some(ready), Some(words)) = (&self.ready, *told) else {
            *told = None;
            return;
        };
        let is_deaf = |mover: &Mover| !self.plan.has_watchdog(&mover.config().family);
        ready.leave(words, is_deaf);
        let enough = *since + self.plan.timeout;
        let all = ready.movers.iter().zip(&ready.heard);
        let silent: Vec<_> = all.filter(|(mover, heard)| is_deaf(mover) && heard.0 < enough).collect();
        if now < enough + MAX_STARTING && !silent.is_empty() {
            return;
        }
        for (mover, _) in silent {
            log::error!(
                "joint {:?}: its motor has no watchdog and says nothing since it was told to {}; it may still obey its last command: \
                 cut its power",
                mover.config().joint,
                words.word()
            );
        }
        *told = None;
    }
}

impl Plan {
    /// Checks all that can be checked before anything is sent.
    pub(super) fn new(config: &MovableArmConfig) -> Result<Self, Error> {
        let (arm, wanted) = (&config.arm, &config.motion);
        if wanted.limits.len() != arm.motors.len() {
            let reason = format!("there are limits for {} joints of {}", wanted.limits.len(), arm.motors.len());
            return Err(Error::Motion { reason });
        }
        let host = free_node(config)?;
        let plan = Self {
            on_loss: wanted.on_loss,
            timeout: wanted.timeout,
            accept_no_watchdog: wanted.accept_no_watchdog,
            endpoints: config.odrive_endpoints.clone(),
            period: period(config, host),
            host,
        };
        for motor in &arm.motors {
            plan.check(motor, &arm.buses[motor.bus_ix].interface)?;
        }
        if plan.timeout < MIN_CYCLES * plan.period {
            let reason = format!(
                "arm.motion.timeout_millis must leave room for {MIN_CYCLES} cycles of {:.1} ms",
                1e3 * plan.period.as_secs_f64()
            );
            return Err(Error::Motion { reason });
        }
        Ok(plan)
    }
}

impl Phase {
    fn stopped(since: Stamp, told: Option<OnLoss>) -> Self {
        Self::Stopped { since, reason: String::new(), told }
    }

    /// Why no target is taken.
    fn refusal(&self) -> Error {
        motion(match self {
            Self::Stopped { reason, .. } => format!("it stopped, and was not recovered: {reason}"),
            Self::Measuring { .. } | Self::Enabling { .. } => "it is being switched on".to_owned(),
            Self::Moving { .. } => "it moves".to_owned(),
        })
    }
}

impl Ready {
    /// What a frame tells of a joint.
    fn hear(&mut self, bus_ix: usize, stamp: Stamp, frame: &Frame) -> Option<Told> {
        for (joint_ix, mover) in self.movers.iter_mut().enumerate() {
            if mover.config().bus_ix != bus_ix {
                continue;
            }
            if let Some(reading) = mover.hear(frame) {
                self.heard[joint_ix] = (stamp, self.cycle_ix);
                self.newest[joint_ix] = Some(reading);
                return Some(Told { joint_ix, stamp, reading });
            }
        }
        None
    }

    /// Where all joints are, once every motor has told since then.
    fn positions(&self, since: Stamp) -> Option<Vec<f64>> {
        let of = |(reading, heard): (&Option<Reading>, &(Stamp, u64))| {
            reading.filter(|_| heard.0 >= since).map(|reading| reading.position_rad)
        };
        self.newest.iter().zip(&self.heard).map(of).collect()
    }

    fn limits(&self, joints: &[MotionLimits]) -> Vec<MotionLimits> {
        self.movers.iter().zip(joints).map(|(mover, joint)| mover.limits(joint)).collect()
    }

    fn bus_of(&self, mover: &Mover) -> &Bus {
        &self.buses[mover.config().bus_ix]
    }

    fn fault(&self, mover: &Mover, reason: impl Into<String>) -> Error {
        let interface = self.bus_of(mover).config().interface.clone();
        Error::Motor { joint: mover.config().joint.clone(), interface, reason: reason.into() }
    }

    /// Asks motors that are off, and stay so, where they are.
    fn ask_unmoved(&self) -> Result<(), Error> {
        self.ask(Mover::question)
    }

    /// Asks motors that do what `on_loss` says where they are, as one who only reads; without a SYNC, at which drives would take what
    /// they were told last.
    fn ask_stopped(&self) -> Result<(), Error> {
        self.ask(|mover| mover.motor().question())
    }

    fn ask(&self, question: impl Fn(&Mover) -> Option<Frame>) -> Result<(), Error> {
        for mover in &self.movers {
            if let Some(question) = question(mover) {
                self.bus_of(mover).send_within(&question, MAX_QUEUED)?;
            }
        }
        Ok(())
    }

    /// Sends all motors where they are to be in this cycle.
    fn command(&mut self, generator: &mut Generator) -> Result<(), Error> {
        let setpoint = generator.step().map_err(motion)?;
        for (ix, mover) in self.movers.iter().enumerate() {
            let command = mover.command(setpoint.position[ix], setpoint.velocity[ix]);
            let command = command.map_err(|error| self.fault(mover, error.to_string()))?;
            // A frame without room in the queue is let go: the next one is better.
            self.bus_of(mover).send_within(&command, MAX_QUEUED)?;
        }
        self.sent_rad = setpoint.position;
        Ok(())
    }

    fn enable(&self) -> Result<(), Error> {
        for mover in &self.movers {
            let frames = mover.enable().map_err(|error| self.fault(mover, error.to_string()))?;
            for frame in &frames {
                self.bus_of(mover).send(frame)?;
            }
        }
        Ok(())
    }

    /// Says that we live, and gives the beat at which drives take their targets.
    fn beat(&self, host: canopen::Node) -> Result<(), Error> {
        for bus in self.buses_with_drives() {
            bus.send_within(&canopen::encode_heartbeat(host, NodeState::Operational), MAX_QUEUED)?;
            bus.send_within(&canopen::encode_sync(), MAX_QUEUED)?;
        }
        Ok(())
    }

    fn buses_with_drives(&self) -> impl Iterator<Item = &Bus> {
        let has_drives =
            |bus_ix: usize| self.movers.iter().any(|mover| mover.wants_sync() && mover.config().bus_ix == bus_ix);
        self.buses.iter().enumerate().filter(move |(ix, _)| has_drives(*ix)).map(|(_, bus)| bus)
    }

    fn do_all_obey(&self) -> bool {
        self.movers.iter().all(|mover| mover.health() == Some(&Health::Obeys))
    }

    /// That no motor is silent, and all obey.
    fn check(&self, now: Stamp, patience: Duration) -> Result<(), Error> {
        for (mover, (stamp, cycle_ix)) in self.movers.iter().zip(&self.heard) {
            match mover.health() {
                Some(Health::Obeys) => {}
                Some(Health::Fault(reason)) => return Err(self.fault(mover, reason.clone())),
                Some(Health::Off) | None => return Err(self.fault(mover, "it is switched off, and not by us")),
            }
            let silence = now.duration_since(*stamp);
            if silence > mover.max_silence(patience) && self.cycle_ix - cycle_ix > MIN_UNHEARD {
                return Err(self.fault(mover, format!("it has said nothing for {:.0} ms", 1e3 * silence.as_secs_f64())));
            }
        }
        Ok(())
    }

    /// Says the last words to these motors, as far as there is a bus to say them on.
    fn leave(&self, words: OnLoss, whom: impl Fn(&Mover) -> bool) {
        for (mover, sent_rad) in self.movers.iter().zip(&self.sent_rad).filter(|(mover, _)| whom(mover)) {
            for frame in mover.leave(words, *sent_rad).unwrap_or_default() {
                let _ = self.bus_of(mover).send_within(&frame, MAX_LAST_QUEUED);
            }
        }
    }

    fn silent_before_start(&self) -> Error {
        let longest = self.heard.iter().enumerate().min_by_key(|(_, (stamp, _))| *stamp).map_or(0, |(ix, _)| ix);
        self.fault(&self.movers[longest], format!("it does not say where it is for {MAX_STARTING:?}"))
    }

    fn not_enabled(&self) -> Error {
        let lazy = self.movers.iter().find(|mover| mover.health() != Some(&Health::Obeys));
        match lazy {
            Some(mover) => self.fault(
                mover,
                match mover.health() {
                    Some(Health::Fault(reason)) => format!("it cannot be switched on: {reason}"),
                    _ => format!("it was switched on and does not say so for {MAX_STARTING:?}"),
                },
            ),
            None => motion("it took too long to switch the motors on".to_owned()),
        }
    }
}

fn motion(reason: String) -> Error {
    Error::Motion { reason }
}

/// What is wrong, without that the arm is not moved.
fn reason_of(error: &Error) -> String {
    match error {
        Error::Motion { reason } => reason.clone(),
        other => other.to_string(),
    }
}

/// A number among CANopen nodes that no drive has, for us.
fn free_node(config: &MovableArmConfig) -> Result<canopen::Node, Error> {
    let is_taken = |node: canopen::Node| {
        config
            .arm
            .motors
            .iter()
            .any(|motor| matches!(motor.family, Family::Cia402 { node: taken, .. } if taken == node))
    };
    let mut numbers = (1..=127).rev().filter_map(|number| canopen::Node::new(number).ok());
    let free = numbers.find(|node| !is_taken(*node));
    free.ok_or_else(|| motion("no number of a CANopen node is free for this computer".to_owned()))
}

/// From cycle to cycle: as the slowest bus allows, in whole milliseconds where there are drives, which count so.
fn period(config: &MovableArmConfig, host: canopen::Node) -> Duration {
    let mut rate_hz = config.arm.rate_hz;
    let is_drive = |family: &Family| matches!(family, Family::Cia402 { .. });
    for (bus_ix, bus) in config.arm.buses.iter().enumerate() {
        let families: Vec<_> =
            config.arm.motors.iter().filter(|motor| motor.bus_ix == bus_ix).map(|motor| motor.family).collect();
        if families.is_empty() {
            continue;
        }
        let (mut of_a_cycle, mut unasked) = (Vec::new(), Vec::new());
        for traffic in families.iter().map(Mover::traffic) {
            of_a_cycle.extend(traffic.of_a_cycle);
            unasked.extend(traffic.unasked);
        }
        if families.iter().any(is_drive) {
            of_a_cycle.extend([canopen::encode_sync(), canopen::encode_heartbeat(host, NodeState::Operational)]);
        }
        rate_hz = rate_hz.min(affordable_hz(bus, &of_a_cycle, &unasked, config.arm.rate_hz));
    }
    let period = Duration::from_secs_f64(1.0 / rate_hz);
    match config.arm.motors.iter().any(|motor| is_drive(&motor.family)) {
        true => Duration::from_millis(period.as_nanos().div_ceil(1_000_000).try_into().unwrap_or(u64::MAX)),
        false => period,
    }
}

#[cfg(test)]
mod tests {
    use super::super::config::{ArmConfig, BusConfig, MotorConfig};
    use super::*;
    use crate::motion::{MotionConfig, OnLoss};
    use crate::wire::can::cia402::Units;

    fn config(families: Vec<Family>) -> MovableArmConfig {
        let motors = families.into_iter().map(|family| MotorConfig {
            joint: "any".to_owned(),
            bus_ix: 0,
            family,
            gear_ratio: 1.0,
            is_reversed: false,
            offset_rad: 0.0,
            gains: None,
        });
        MovableArmConfig {
            arm: ArmConfig {
                buses: vec![BusConfig {
                    interface: "can0".to_owned(),
                    bitrate_hz: 1_000_000,
                    data_bitrate_hz: None,
                    accept_no_restart: false,
                }],
                motors: motors.collect(),
                rate_hz: 1000.0,
            },
            motion: MotionConfig {
                limits: Vec::new(),
                on_loss: OnLoss::Release,
                timeout: Duration::from_millis(100),
                accept_no_watchdog: false,
            },
            odrive_endpoints: None,
        }
    }

    #[test]
    fn the_cycle_keeps_the_bus_under_seventy_percent() {
        let host = canopen::Node::new(127).expect("a node");
        let damiao = |ix: u16| Family::Damiao { motor: ix, feedback: 0x10 + ix };
        assert_eq!(period(&config(vec![damiao(1), damiao(2)]), host), Duration::from_millis(1));
        // Seven motors, two frames of 135 bits at worst each.
        let seven = period(&config((1..8).map(damiao).collect()), host).as_secs_f64();
        assert!((seven - 14.0 * 135e-6 / 0.7).abs() < 1e-6, "{seven}");
    }

    #[test]
    fn drives_get_whole_milliseconds_and_a_number_that_none_of_them_has() {
        let node = |number| canopen::Node::new(number).expect("a node");
        let drive =
            |number| Family::Cia402 { node: node(number), units: Units { counts_per_turn: 1.0, rated_torque_nm: 1.0 } };
        let arm = config(vec![drive(127), drive(126), drive(1)]);
        assert_eq!(free_node(&arm).expect("125 are free"), node(125));
        // 9 x 135 bits, a SYNC of 55 and a heartbeat of 65 take 1.34 ms of 70 %: 1.91 ms.
        assert_eq!(period(&arm, node(125)), Duration::from_millis(2));
    }
}
