//! The thread that moves an arm. It prepares the motors, enables them, sends setpoints, and stops
//! permanently on any fault.
//!
//! The thread stops the arm if a motor is silent, reports that it stopped, or does not follow its
//! commands. It also stops the arm if a bus fails. Another reason is a stall of this computer, if
//! the stall is so long that the watchdogs of the motors have expired or are about to expire. After
//! a stop, the thread discards earlier setpoints and sends no new ones until it receives
//! [`Request::Recover`].
//!
//! The thread sends the fail-safe command before it ends, even if it panics.

use super::bus::Bus;
use super::config::MovableArmConfig;
use super::family::Health;
use super::frame_io::{BusEvent, WireErrors};
use super::joints::JointReading;
use super::motor::Reading;
use super::movable_motor::MovableMotor;
use super::plan::watchdog_plan;
use super::watchdog::WatchdogPlan;
use crate::motion::{
    CommandedArm, Motion, MotionLimits, Mover, OnLoss, Reply, Request, Setpoint, SharedWithOwner,
    max_stop_duration, reason_of,
};
use crate::wire::can::Frame;
use crate::wire::can::canopen::{self, NodeState};
use crate::{Error, clock};
use kinematics::Stamp;
use parking_lot::Mutex;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender};
use std::time::Duration;

/// Fraction of the watchdog timeout after which this thread stops the arm. The thread stops the arm
/// before the watchdogs of the motors expire. Otherwise, it could command some motors while others
/// have already stopped.
///
/// A larger fraction leaves less time for the fail-safe command to reach all motors. With a smaller
/// fraction, shorter stalls of this computer stop the arm.
const SILENCE_FRAC: f64 = 0.8;
/// A motor counts as silent only after this many cycles without a frame. A thread that wakes up
/// after a stall compares old stamps with the new time before it reads the waiting frames. Without
/// this limit, the motor would then count as silent although its answer is waiting.
const MIN_MISSED_CYCLES: u64 = 3;
/// Maximum time for the motors to report their positions, and to report that they are enabled.
const STARTUP_TIMEOUT: Duration = Duration::from_secs(2);
/// Maximum wait for space in the queue of an interface. In this time, the interface sends half of
/// its queue, which usually holds ten frames: five frames of up to 135 bits take 0.68 ms at 1
/// Mbit/s. A longer wait would delay the commands of the other motors of this cycle.
const MAX_QUEUED: Duration = Duration::from_micros(800);
/// Maximum wait for space in the queue when sending a fail-safe command. If the queue stays full,
/// nobody is receiving.
const MAX_FAIL_SAFE_WAIT: Duration = Duration::from_millis(5);
/// Interval at which an idle thread checks for requests. A thread with a long cycle also checks at
/// this interval whether it must shut down.
const POLL: Duration = Duration::from_millis(20);
/// Additional time in which an arm must come to rest on shutdown. It is added to the time that the
/// limits of the arm require. It covers late cycles and a target that was set just before the
/// shutdown. Without a limit, an arm that never comes to rest would keep the program from ending.
const STOP_MARGIN: Duration = Duration::from_secs(1);

/// State of the arm.
#[derive(Debug)]
enum ArmState {
    /// No setpoints are sent. The fail-safe command is resent as long as some motors may not have
    /// received it.
    Stopped {
        since: Stamp,
        reason: String,
        pending_fail_safe: Option<OnLoss>,
    },
    /// All motors are prepared and disabled, and are polled for their positions.
    Measuring { since: Stamp, reply: Reply<()> },
    /// The motors are commanded to hold their positions, and are being enabled.
    Enabling {
        since: Stamp,
        is_ordered: bool,
        reply: Reply<()>,
    },
    /// The motors follow the setpoints.
    Moving,
}

/// Buses and motors that have been prepared.
#[derive(Debug)]
struct PreparedMotors {
    buses: Vec<Bus>,
    /// One motor per joint.
    movable_motors: Vec<MovableMotor>,
    /// Time and cycle of the last frame from each motor.
    last_heard: Vec<(Stamp, u64)>,
    latest: Vec<Option<Reading>>,
    /// Last commanded position of each joint.
    sent_rad: Vec<f64>,
    cycle_ix: u64,
    errors: WireErrors,
}

/// The thread's state.
#[derive(Debug)]
pub(super) struct ArmLoop {
    config: MovableArmConfig,
    plan: WatchdogPlan,
    requests: Receiver<Request>,
    readings: SyncSender<Result<JointReading, Error>>,
    motion: Arc<Mutex<Motion>>,
    is_shutting_down: Arc<AtomicBool>,
    prepared: Option<PreparedMotors>,
    arm_state: ArmState,
    mover: Mover,
    /// Start of the last cycle, on a clock that keeps counting while the computer is suspended.
    last_cycle: Stamp,
    /// Number of cycles that started late.
    n_late: u64,
    max_stall: Duration,
}

impl ArmLoop {
    /// Creates the loop without sending anything.
    ///
    /// # Errors
    /// If the arm cannot be moved as planned.
    pub(super) fn new(
        config: &MovableArmConfig,
        shared: SharedWithOwner,
        readings: SyncSender<Result<JointReading, Error>>,
    ) -> Result<Self, Error> {
        let SharedWithOwner {
            requests,
            motion,
            is_shutting_down,
        } = shared;
        let plan = watchdog_plan(config)?;
        let arm_state = ArmState::stopped(clock::now(), None);
        Ok(Self {
            config: config.clone(),
            plan,
            requests,
            readings,
            motion,
            is_shutting_down,
            prepared: None,
            arm_state,
            mover: Mover::default(),
            last_cycle: clock::now_including_suspend(),
            n_late: 0,
            max_stall: Duration::ZERO,
        })
    }

    /// Runs until the owner drops the arm or calls
    /// [`apply_fail_safe`](crate::motion::apply_fail_safe).
    pub(super) fn run(mut self) {
        let mut next_cycle = clock::now();
        let mut shutdown_deadline = None;
        loop {
            // The program is about to exit without an orderly stop, so this comes before everything
            // else.
            if CommandedArm::is_fail_safe_due() {
                break;
            }
            if self.is_shutting_down.load(Ordering::Relaxed) {
                // The deadline is fixed at the first pass. Computing it anew in each pass would
                // move it into the future forever.
                let shutdown_by = *shutdown_deadline.get_or_insert_with(|| {
                    clock::now() + max_stop_duration(&self.config.motion.limits) + STOP_MARGIN
                });
                if self.is_at_rest() || clock::now() > shutdown_by {
                    break;
                }
            }
            // Requests come before the cycle, so that a stop acts on the next setpoint.
            while let Ok(request) = self.requests.try_recv() {
                self.handle_request(request);
            }
            let now = clock::now();
            if now >= next_cycle {
                if let Err(error) = self.cycle(now) {
                    self.abort(&reason_of(&error));
                }
                // Missed cycles are not made up for, and no two cycles run back to back.
                next_cycle += self.plan.period;
                if next_cycle < now {
                    next_cycle = now + self.plan.period;
                }
            }
            // The time until the next cycle is spent listening: the checks of that cycle need the
            // newest answers.
            let result = self.listen(next_cycle.duration_since(clock::now()).min(POLL));
            if let Err(error) = result {
                self.abort(&reason_of(&error));
            }
        }
        self.end();
    }

    fn handle_request(&mut self, request: Request) {
        match (request, &self.arm_state) {
            (
                Request::Recover(answer),
                ArmState::Stopped {
                    pending_fail_safe, ..
                },
            ) => self.recover(answer, *pending_fail_safe),
            (request, ArmState::Moving) => self.mover.handle(request, &self.motion),
            (request, arm_state) => request.refuse(arm_state.refusal()),
        }
    }

    /// Prepares a stopped arm. It is enabled in the cycles after this.
    fn recover(&mut self, answer: Reply<()>, pending_fail_safe: Option<OnLoss>) {
        // All buses and motors are prepared again. While the arm was stopped, an interface may have
        // been set up again, and motors may have been reset or replaced.
        match self.prepare() {
            Ok(prepared) => {
                self.prepared = Some(prepared);
                // The preparation takes longer than a watchdog timeout, but it is not a stall of
                // this thread.
                self.last_cycle = clock::now_including_suspend();
                self.arm_state = ArmState::Measuring {
                    since: clock::now(),
                    reply: answer,
                };
            }
            Err(error) => {
                // Motors that have not confirmed the fail-safe command may still execute their last
                // command, so it is resent through the former sockets.
                if pending_fail_safe.is_none() {
                    self.prepared = None;
                }
                self.stopped(&reason_of(&error), pending_fail_safe);
                // The requester may have gone away.
                let _ = answer.try_send(Err(error));
            }
        }
    }

    /// Reopens all buses and prepares every motor without enabling it.
    fn prepare(&self) -> Result<PreparedMotors, Error> {
        let arm = &self.config.arm;
        let buses = arm
            .buses
            .iter()
            .map(Bus::open)
            .collect::<Result<Vec<_>, _>>()?;
        let movable_motors = arm
            .motors
            .iter()
            .map(|motor| MovableMotor::prepare(&buses[motor.bus_ix], motor, &self.plan));
        let movable_motors = movable_motors.collect::<Result<Vec<_>, _>>()?;
        let n = movable_motors.len();
        Ok(PreparedMotors {
            buses,
            movable_motors,
            last_heard: vec![(clock::now(), 0); n],
            latest: vec![None; n],
            sent_rad: vec![0.0; n],
            cycle_ix: 0,
            errors: WireErrors::default(),
        })
    }

    /// Runs one cycle in the current state.
    fn cycle(&mut self, now: Stamp) -> Result<(), Error> {
        // This clock counts the time in which a laptop is suspended. The motors' watchdogs expire
        // then, but the monotonic clock stands still.
        let now_including_suspend = clock::now_including_suspend();
        let stall = now_including_suspend.duration_since(self.last_cycle);
        self.last_cycle = now_including_suspend;
        if let Some(reason) = self.arm_state.not_moving() {
            self.mover.report_stopped(now, reason);
        }
        let Some(prepared) = &mut self.prepared else {
            return Ok(());
        };
        prepared.cycle_ix += 1;
        // A single missed cycle does no harm, because a newer setpoint follows every setpoint. Late
        // cycles are therefore only counted for the summary at the end.
        if stall > 2 * self.plan.period {
            self.n_late += 1;
            self.max_stall = self.max_stall.max(stall);
        }
        match self.arm_state {
            ArmState::Stopped { since, .. } => {
                self.stopped_cycle(since, now);
                Ok(())
            }
            ArmState::Measuring { since, .. } => self.measuring_cycle(since, now),
            ArmState::Enabling { since, .. } => {
                self.check_stall(stall)?;
                self.enabling_cycle(since, now)
            }
            ArmState::Moving => {
                self.check_stall(stall)?;
                self.moving_cycle(now)
            }
        }
    }

    /// Returns an error if this thread stalled for so long that the motors have stopped or are
    /// about to. In that case, setpoints from before the stall must not be sent.
    fn check_stall(&self, stall: Duration) -> Result<(), Error> {
        if stall <= self.max_silence() {
            return Ok(());
        }
        Err(motion(format!(
            "this computer stalled for {:.0} ms",
            1e3 * stall.as_secs_f64()
        )))
    }

    /// Time without commands or answers after which this thread stops the arm.
    fn max_silence(&self) -> Duration {
        self.plan.timeout.mul_f64(SILENCE_FRAC)
    }

    /// A cycle of an arm that stopped at `since`.
    fn stopped_cycle(&mut self, since: Stamp, now: Stamp) {
        // Polls may also reset a watchdog, so the thread polls only after the watchdogs have
        // expired.
        if let Some(prepared) = &self.prepared
            && now.duration_since(since) > 2 * self.plan.timeout
        {
            // A bus failure has already been reported.
            let _ = prepared.poll_stopped();
        }
        self.resend_fail_safe(now);
    }

    /// A cycle in which the motors, prepared at `since` and disabled, are polled for their
    /// positions. Once all have answered, the arm may be enabled.
    fn measuring_cycle(&mut self, since: Stamp, now: Stamp) -> Result<(), Error> {
        let Some(prepared) = &mut self.prepared else {
            return Ok(());
        };
        let Some(positions) = prepared.positions(since) else {
            if now.duration_since(since) > STARTUP_TIMEOUT {
                return Err(prepared.silent_before_start());
            }
            prepared.poll_disabled()?;
            return prepared.send_sync(self.plan.host);
        };
        // The setpoints start where the joints are now. An older position would make them jump when
        // they are enabled.
        let limits = prepared.limits(&self.config.motion.limits);
        self.mover.hold_at(limits, positions, self.plan.period)?;
        // Frames that queued up during the preparation may report faults that the preparation has
        // cleared. Only reports from now on count.
        prepared
            .movable_motors
            .iter_mut()
            .for_each(MovableMotor::clear_health);
        let measuring = std::mem::replace(&mut self.arm_state, ArmState::stopped(now, None));
        let ArmState::Measuring { reply, .. } = measuring else {
            return Ok(());
        };
        self.arm_state = ArmState::Enabling {
            since: now,
            is_ordered: false,
            reply,
        };
        Ok(())
    }

    /// A cycle in which the motors are enabled, which began at `since`. Once all report that they
    /// are enabled, the arm may move.
    fn enabling_cycle(&mut self, since: Stamp, now: Stamp) -> Result<(), Error> {
        let (Some(prepared), ArmState::Enabling { is_ordered, .. }) =
            (&mut self.prepared, &mut self.arm_state)
        else {
            return Ok(());
        };
        let setpoint = self.mover.held();
        // Motors get their target before they are enabled, so that none moves to an old target. For
        // drives, these commands also enable them, one state per cycle.
        prepared.command(&setpoint)?;
        if !*is_ordered {
            // The order to enable is sent only once. If it were repeated, it would enable a motor
            // that has stopped because of a fault.
            *is_ordered = true;
            prepared.enable()?;
            // A motor that ignores commands while it is disabled gets its target now.
            prepared.command(&setpoint)?;
        }
        prepared.send_sync(self.plan.host)?;
        if now.duration_since(since) > STARTUP_TIMEOUT {
            return Err(prepared.not_enabled());
        }
        if !prepared.all_enabled() {
            return Ok(());
        }
        let enabling = std::mem::replace(&mut self.arm_state, ArmState::stopped(now, None));
        if let ArmState::Enabling { reply, .. } = enabling {
            self.arm_state = ArmState::Moving;
            *self.motion.lock() = Motion::Holding;
            log::info!("the arm is enabled and holds its position");
            let _ = reply.try_send(Ok(()));
        }
        Ok(())
    }

    /// A cycle of an enabled arm.
    fn moving_cycle(&mut self, now: Stamp) -> Result<(), Error> {
        let max_silence_allowed = self.max_silence();
        let Some(prepared) = &mut self.prepared else {
            return Ok(());
        };
        // The checks come first, because after a fault of one motor, the others must not get
        // another setpoint.
        prepared.check(now, max_silence_allowed)?;
        prepared.command(&self.mover.step(now)?)?;
        // The SYNC follows the targets of all drives, so that they accept them at the same instant.
        prepared.send_sync(self.plan.host)?;
        *self.motion.lock() = self.mover.motion();
        Ok(())
    }

    /// Processes incoming frames until the timeout expires.
    fn listen(&mut self, timeout: Duration) -> Result<(), Error> {
        let Some(prepared) = &mut self.prepared else {
            std::thread::sleep(timeout);
            return Ok(());
        };
        // One thread reads all buses. It waits for all of them at once and then reads each until it
        // is empty, so that no bus delays another.
        Bus::wait_for_any(&prepared.buses, timeout);
        let is_stopped = matches!(self.arm_state, ArmState::Stopped { .. });
        for bus_ix in 0..prepared.buses.len() {
            loop {
                let arrived = match prepared.buses[bus_ix].receive(Duration::ZERO) {
                    Ok(Some(arrived)) => arrived,
                    Ok(None) => break,
                    Err(_) if is_stopped => {
                        // The failure has already been reported. A bus that stays down must not
                        // keep this thread busy.
                        std::thread::sleep(timeout);
                        break;
                    }
                    Err(error) => return Err(error),
                };
                match arrived {
                    (stamp, BusEvent::Frame(frame)) => {
                        if let Some(reading) = prepared.process_frame(bus_ix, stamp, &frame) {
                            // If the reader is slow, the newest reading is dropped.
                            let _ = self.readings.try_send(Ok(reading));
                        }
                    }
                    (_, BusEvent::Errors(new_errors)) => {
                        prepared.errors.add(&new_errors);
                        let interface = &prepared.buses[bus_ix].config().interface;
                        log::debug!(
                            "{interface}: errors on the wire so far: {:?}",
                            prepared.errors
                        );
                        // In bus-off, the controller discards commands. Even if it restarts
                        // automatically, the motors may have stopped, so only a person enables the
                        // arm again.
                        if new_errors.n_bus_off > 0 && !is_stopped {
                            return Err(motion(format!("{interface} went bus-off")));
                        }
                    }
                }
            }
        }
        Ok(())
    }

    /// Stops the arm: sends each motor the fail-safe command, which has the same effect as the
    /// expiry of its watchdog, and logs the reason.
    fn abort(&mut self, reason: &str) {
        if let ArmState::Stopped { .. } = self.arm_state {
            return;
        }
        let fail_safe = self.fail_safe_command();
        if let Some(prepared) = &self.prepared {
            // Motors with a watchdog get the command, too. All joints then stop together instead of
            // each at the end of its own timeout.
            prepared.shutdown(fail_safe, |_| true);
        }
        self.stopped(reason, Some(fail_safe));
    }

    /// The fail-safe command of all motors: `on_loss`, or release if not all motors were enabled
    /// yet.
    fn fail_safe_command(&self) -> OnLoss {
        // Holding or damping needs enabled motors. If only some motors were enabled, these would
        // hold while the others fall. In this case, all motors are released.
        if matches!(self.arm_state, ArmState::Moving) {
            self.plan.on_loss
        } else {
            OnLoss::Release
        }
    }

    fn stopped(&mut self, reason: &str, pending_fail_safe: Option<OnLoss>) {
        log::warn!("the arm stopped: {reason}");
        self.mover.report_stopped(clock::now(), reason);
        let stopped = ArmState::Stopped {
            since: clock::now(),
            reason: reason.to_owned(),
            pending_fail_safe,
        };
        // A caller that waits for the arm to be enabled receives the reason. Otherwise, its request
        // would end with a timeout that names no cause.
        let before = std::mem::replace(&mut self.arm_state, stopped);
        *self.motion.lock() = Motion::Stopped {
            reason: reason.to_owned(),
        };
        if let ArmState::Measuring { reply, .. } | ArmState::Enabling { reply, .. } = before {
            let _ = reply.try_send(Err(motion(reason.to_owned())));
        }
    }

    /// Returns whether the arm is at rest. If it moves, starts to bring it to rest.
    fn is_at_rest(&mut self) -> bool {
        match self.arm_state {
            ArmState::Moving => self.mover.come_to_rest(),
            _ => true,
        }
    }

    /// Sends the fail-safe command, and resends it to motors that may not have received it.
    fn end(&mut self) {
        let fail_safe = self.fail_safe_command();
        if let Some(prepared) = &self.prepared
            && !matches!(self.arm_state, ArmState::Stopped { .. })
        {
            prepared.shutdown(fail_safe, |_| true);
            log::info!(
                "the arm was shut down with on_loss = {:?}; {} cycles, {} of them late, longest stall {:.1} ms",
                fail_safe.name(),
                prepared.cycle_ix,
                self.n_late,
                1e3 * self.max_stall.as_secs_f64()
            );
            self.arm_state = ArmState::stopped(clock::now(), Some(fail_safe));
        }
        self.mover
            .report_stopped(clock::now(), "the arm was shut down");
        self.finish_fail_safe();
    }

    /// Resends the fail-safe command to motors without a watchdog until each has answered, or a
    /// time limit expires.
    fn finish_fail_safe(&mut self) {
        while let ArmState::Stopped {
            pending_fail_safe: Some(_),
            ..
        } = self.arm_state
        {
            // The normal cycle has ended, so this loop paces itself.
            std::thread::sleep(self.plan.period);
            // A bus failure has already been reported.
            let _ = self.listen(Duration::ZERO);
            self.resend_fail_safe(clock::now());
        }
    }

    /// Resends the fail-safe command once per cycle to motors without a watchdog, because a motor
    /// that misses it would execute its last command forever. Continues until each of these motors
    /// has sent a frame after the watchdog timeout. At that time, the watchdogs of the other motors
    /// have expired, too. Ends at most [`STARTUP_TIMEOUT`] after the watchdog timeout.
    fn resend_fail_safe(&mut self, now: Stamp) {
        let ArmState::Stopped {
            since,
            pending_fail_safe,
            ..
        } = &mut self.arm_state
        else {
            return;
        };
        let (Some(prepared), Some(fail_safe)) = (&self.prepared, *pending_fail_safe) else {
            *pending_fail_safe = None;
            return;
        };
        // Motors with a watchdog are left out, because they stop in any case. A resent command
        // would reset their watchdog.
        prepared.shutdown(fail_safe, has_no_watchdog);
        // An answer soon after the stop may reply to an earlier command, so it does not prove that
        // the motor has received this one.
        let watchdog_deadline = *since + self.plan.timeout;
        let all = prepared.movable_motors.iter().zip(&prepared.last_heard);
        let silent_motors: Vec<_> = all
            .filter(|(movable_motor, last_heard)| {
                has_no_watchdog(movable_motor) && last_heard.0 < watchdog_deadline
            })
            .collect();
        if now < watchdog_deadline + STARTUP_TIMEOUT && !silent_motors.is_empty() {
            return;
        }
        for (movable_motor, _) in silent_motors {
            log::error!(
                "joint {:?}: its motor has no watchdog and has not answered since the fail-safe command {:?} was sent; it may still execute its last command: \
                 cut its power",
                movable_motor.config().joint,
                fail_safe.name()
            );
        }
        *pending_fail_safe = None;
    }
}

/// Whether a motor would execute its last command forever if commands stopped.
fn has_no_watchdog(movable_motor: &MovableMotor) -> bool {
    let watchdog = movable_motor.motor().protocol().watchdog();
    !watchdog.is_available()
}

impl Drop for ArmLoop {
    fn drop(&mut self) {
        // After an orderly end, the motors have their fail-safe command. After a panic, motors
        // without a watchdog would execute their last command forever.
        if std::thread::panicking() {
            self.abort("the thread of the arm failed; this is a bug, please report it");
            self.finish_fail_safe();
        }
    }
}

impl ArmState {
    fn stopped(since: Stamp, pending_fail_safe: Option<OnLoss>) -> Self {
        Self::Stopped {
            since,
            reason: String::new(),
            pending_fail_safe,
        }
    }

    /// The reason why a target is refused.
    fn refusal(&self) -> Error {
        motion(match self {
            Self::Stopped { reason, .. } => {
                format!("the arm stopped and has not been recovered: {reason}")
            }
            Self::Measuring { .. } | Self::Enabling { .. } => "the arm is being enabled".to_owned(),
            Self::Moving => "the arm is moving".to_owned(),
        })
    }

    /// Why the arm follows no target; `None` if it may.
    fn not_moving(&self) -> Option<&str> {
        match self {
            Self::Stopped { reason, .. } => Some(reason),
            Self::Measuring { .. } | Self::Enabling { .. } => Some("the arm is being enabled"),
            Self::Moving => None,
        }
    }
}

impl PreparedMotors {
    /// Updates the state of the motor that sent a frame, and returns its reading, if any.
    fn process_frame(
        &mut self,
        bus_ix: usize,
        stamp: Stamp,
        frame: &Frame,
    ) -> Option<JointReading> {
        for (joint_ix, movable_motor) in self.movable_motors.iter_mut().enumerate() {
            if movable_motor.config().bus_ix != bus_ix {
                continue;
            }
            // A frame without a reading, such as a statusword, still updates the health. Only a
            // frame with a reading counts against the silence of the motor, because the following
            // error is computed from positions.
            if let Some(reading) = movable_motor.process_frame(frame) {
                self.last_heard[joint_ix] = (stamp, self.cycle_ix);
                self.latest[joint_ix] = Some(reading);
                return Some(JointReading {
                    joint_ix,
                    stamp,
                    reading,
                });
            }
        }
        None
    }

    /// Positions of all joints, once every motor has reported since `since`.
    fn positions(&self, since: Stamp) -> Option<Vec<f64>> {
        let mut positions_rad = Vec::with_capacity(self.latest.len());
        for (latest, (heard, _)) in self.latest.iter().zip(&self.last_heard) {
            // Frames that queued up during the preparation are too old, because the joint may have
            // sagged since then.
            if *heard < since {
                return None;
            }
            positions_rad.push((*latest)?.position_rad);
        }
        Some(positions_rad)
    }

    fn limits(&self, joints: &[MotionLimits]) -> Vec<MotionLimits> {
        self.movable_motors
            .iter()
            .zip(joints)
            .map(|(movable_motor, joint)| movable_motor.limits(joint))
            .collect()
    }

    fn bus_of(&self, movable_motor: &MovableMotor) -> &Bus {
        &self.buses[movable_motor.config().bus_ix]
    }

    fn fault(&self, movable_motor: &MovableMotor, reason: impl Into<String>) -> Error {
        let interface = self.bus_of(movable_motor).config().interface.clone();
        Error::Motor {
            joint: movable_motor.config().joint.clone(),
            interface,
            reason: reason.into(),
        }
    }

    /// Polls the positions of disabled motors without enabling them.
    fn poll_disabled(&self) -> Result<(), Error> {
        self.poll(MovableMotor::poll_frame)
    }

    /// Polls the positions of motors that are executing `on_loss`, as a read-only arm does. Sends
    /// no SYNC, because a SYNC makes drives accept the last target that they received.
    fn poll_stopped(&self) -> Result<(), Error> {
        self.poll(|movable_motor| movable_motor.motor().protocol().poll_frame())
    }

    fn poll(&self, poll_frame: impl Fn(&MovableMotor) -> Option<Frame>) -> Result<(), Error> {
        for movable_motor in &self.movable_motors {
            if let Some(poll_frame) = poll_frame(movable_motor) {
                self.bus_of(movable_motor)
                    .send_within(&poll_frame, MAX_QUEUED)?;
            }
        }
        Ok(())
    }

    /// Sends every motor its setpoint for this cycle.
    fn command(&mut self, setpoint: &Setpoint) -> Result<(), Error> {
        for (ix, movable_motor) in self.movable_motors.iter().enumerate() {
            let command = movable_motor.command(setpoint.position[ix], setpoint.velocity[ix]);
            let command = command.map_err(|error| self.fault(movable_motor, error.to_string()))?;
            // If the queue is full, the frame is dropped, because the next frame is more recent.
            self.bus_of(movable_motor)
                .send_within(&command, MAX_QUEUED)?;
        }
        // The following error is measured against this position, and the fail-safe command "hold"
        // commands it.
        self.sent_rad.clone_from(&setpoint.position);
        Ok(())
    }

    fn enable(&self) -> Result<(), Error> {
        for movable_motor in &self.movable_motors {
            let frames = movable_motor
                .enable()
                .map_err(|error| self.fault(movable_motor, error.to_string()))?;
            // Unlike setpoints, these frames are sent once, so they wait longer for space in the
            // queue.
            for frame in &frames {
                self.bus_of(movable_motor).send(frame)?;
            }
        }
        Ok(())
    }

    /// Sends our heartbeat, and the SYNC at which drives accept their targets.
    fn send_sync(&self, host: canopen::Node) -> Result<(), Error> {
        for bus in self.buses_with_drives() {
            bus.send_within(
                &canopen::encode_heartbeat(host, NodeState::Operational),
                MAX_QUEUED,
            )?;
            bus.send_within(&canopen::encode_sync(), MAX_QUEUED)?;
        }
        Ok(())
    }

    fn buses_with_drives(&self) -> impl Iterator<Item = &Bus> {
        self.buses
            .iter()
            .enumerate()
            .filter(move |(ix, _)| self.has_drives(*ix))
            .map(|(_, bus)| bus)
    }

    /// Whether a motor on the bus is a CANopen drive.
    fn has_drives(&self, bus_ix: usize) -> bool {
        self.movable_motors
            .iter()
            .filter(|movable_motor| movable_motor.config().bus_ix == bus_ix)
            .any(|movable_motor| movable_motor.motor().protocol().canopen_node().is_some())
    }

    fn all_enabled(&self) -> bool {
        self.movable_motors
            .iter()
            .all(|movable_motor| movable_motor.health() == Some(&Health::Enabled))
    }

    /// Checks that no motor is silent, that all are enabled, and that all follow their commands.
    fn check(&self, now: Stamp, max_silence_allowed: Duration) -> Result<(), Error> {
        for ((movable_motor, latest), sent_rad) in self
            .movable_motors
            .iter()
            .zip(&self.latest)
            .zip(&self.sent_rad)
        {
            let Some(Reading {
                position_rad,
                effort_nm,
                ..
            }) = *latest
            else {
                continue;
            };
            let following = &movable_motor.config().following;
            // A joint that is loaded or fast also lags its command. The configured limit must
            // therefore exceed the following error of normal motions.
            if let Some(violation) = following.violation(*sent_rad, position_rad, effort_nm) {
                return Err(self.fault(movable_motor, violation));
            }
        }
        for (movable_motor, (stamp, cycle_ix)) in self.movable_motors.iter().zip(&self.last_heard) {
            match movable_motor.health() {
                Some(Health::Enabled) => {}
                Some(Health::Fault(reason)) => {
                    return Err(self.fault(movable_motor, reason.clone()));
                }
                // This program has not disabled the motor. Either another program did, or a loss of
                // power reset the motor.
                Some(Health::Off) | None => {
                    return Err(
                        self.fault(movable_motor, "the motor was disabled by something else")
                    );
                }
            }
            // A motor is silent only if both its time and its number of cycles exceed the limits.
            // With the time alone, a stall of this thread would count as silence of the motor. With
            // the cycles alone, a few lost frames at a high rate would stop the arm.
            let silence = now.duration_since(*stamp);
            if silence > movable_motor.max_silence(max_silence_allowed)
                && self.cycle_ix - cycle_ix > MIN_MISSED_CYCLES
            {
                return Err(self.fault(
                    movable_motor,
                    format!(
                        "no frame from the motor for {:.0} ms",
                        1e3 * silence.as_secs_f64()
                    ),
                ));
            }
        }
        Ok(())
    }

    /// Sends the fail-safe command to the selected motors. Errors of the bus are ignored.
    fn shutdown(&self, fail_safe: OnLoss, selects: impl Fn(&MovableMotor) -> bool) {
        for (movable_motor, sent_rad) in self
            .movable_motors
            .iter()
            .zip(&self.sent_rad)
            .filter(|(movable_motor, _)| selects(movable_motor))
        {
            // A motor that cannot be reached must not keep the others from their command, so errors
            // are ignored and the loop continues.
            if let Ok(frame) = movable_motor.shutdown(fail_safe, *sent_rad) {
                let _ = self
                    .bus_of(movable_motor)
                    .send_within(&frame, MAX_FAIL_SAFE_WAIT);
            }
        }
    }

    fn silent_before_start(&self) -> Error {
        // Only one motor fits into the message. The one that was heard least recently is the most
        // likely culprit.
        let most_silent = self
            .last_heard
            .iter()
            .enumerate()
            .min_by_key(|(_, (stamp, _))| *stamp)
            .map_or(0, |(ix, _)| ix);
        self.fault(
            &self.movable_motors[most_silent],
            format!("the motor reported no position within {STARTUP_TIMEOUT:?}"),
        )
    }

    fn not_enabled(&self) -> Error {
        let not_enabled_motor = self
            .movable_motors
            .iter()
            .find(|movable_motor| movable_motor.health() != Some(&Health::Enabled));
        match not_enabled_motor {
            Some(movable_motor) => self.fault(
                movable_motor,
                match movable_motor.health() {
                    Some(Health::Fault(reason)) => format!("the motor cannot be enabled: {reason}"),
                    _ => format!(
                        "the motor did not report that it is enabled within {STARTUP_TIMEOUT:?}"
                    ),
                },
            ),
            None => motion("the motors took too long to be enabled".to_owned()),
        }
    }
}

fn motion(reason: String) -> Error {
    Error::Motion { reason }
}
