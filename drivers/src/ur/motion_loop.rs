//! The part of an arm's thread that moves the arm: for each state that arrives, it sends a
//! setpoint.

use super::N_JOINTS;
use super::connection::{Connection, Setpoint};
use super::mailbox::MotionMailbox;
use super::program::{
    ENDED_AS_REQUESTED, ENDED_BY_DISTANCE, ENDED_BY_SILENCE, ENDED_WITHOUT_SETPOINTS,
};
use super::state::RobotState;
use super::words;
use crate::motion::{self, Motion, MotionCommand, MotionLimits, Mover, idle_cycle, reason_of};
use crate::{Error, clock};
use std::sync::Arc;
use std::time::Duration;

/// Time at rest after which a motion ends. After the end, a person may guide the arm by hand.
/// Starting a motion takes a fraction of a second, so a caller that sends several targets in a row
/// should not have to start a motion for each target.
const MAX_AT_REST_SECS: f64 = 1.0;
/// Time within which a program starts, or ends.
const MAX_PROGRAM_SECS: f64 = 3.0;
/// Time without a setpoint after which the arm has almost come to rest at the last one. The next
/// trajectory then starts at rest.
const MAX_PAUSE: Duration = Duration::from_millis(50);
/// Maximum number of steps of the trajectory per setpoint. States may arrive in pairs, or be
/// skipped. With more steps, setpoints would jump after a pause.
const MAX_STEPS: u64 = 4;

/// Moves an arm in response to its states.
#[derive(Debug)]
pub(super) struct MotionLoop {
    device: String,
    mailbox: Arc<MotionMailbox>,
    limits: Vec<MotionLimits>,
    rate_hz: f64,
    mover: Mover,
    motion_state: MotionState,
    /// Number of the newest setpoint. The program detects silence by it.
    number: i32,
}

/// The newest state, with what happened since the one before.
pub(super) struct Cycle<'a> {
    pub(super) state: &'a RobotState,
    /// Number of cycles of the controller since the previous state.
    pub(super) n_cycles: u64,
    /// Time since the previous state was received.
    pub(super) pause: Duration,
}

#[derive(Debug)]
enum MotionState {
    Idle,
    /// The program of a motion is being started. Setpoints at the current position are sent.
    Beginning {
        session: i32,
        n_waited: u64,
    },
    ActiveMotion(Box<ActiveMotion>),
    /// The program was asked to end, or has been stopped.
    Ending {
        session: i32,
        n_waited: u64,
        reason: Option<String>,
    },
}

#[derive(Debug)]
struct ActiveMotion {
    session: i32,
    /// The last setpoint.
    sent_rad: [f64; N_JOINTS],
    n_at_rest: u64,
}

impl MotionLoop {
    pub(super) fn new(
        device: String,
        mailbox: Arc<MotionMailbox>,
        limits: Vec<MotionLimits>,
        rate_hz: f64,
    ) -> Self {
        Self {
            device,
            mailbox,
            limits,
            rate_hz,
            mover: Mover::default(),
            motion_state: MotionState::Idle,
            number: 0,
        }
    }

    /// Processes the newest state.
    ///
    /// # Errors
    /// If the setpoint cannot be sent.
    pub(super) fn cycle(
        &mut self,
        cycle: &Cycle<'_>,
        connection: &mut Connection,
    ) -> Result<(), String> {
        self.take_mode(cycle.state);
        // Each state of the loop is consumed and replaced, so that a finished motion cannot be
        // continued by mistake.
        let (next, setpoint) = match std::mem::replace(&mut self.motion_state, MotionState::Idle) {
            MotionState::Idle => (self.start_request(), None),
            MotionState::Beginning { session, n_waited } => self.begin(session, n_waited, cycle),
            MotionState::ActiveMotion(active) => self.run(active, cycle),
            MotionState::Ending {
                session,
                n_waited,
                reason,
            } => self.end(session, n_waited, reason, cycle),
        };
        self.motion_state = next;
        // The state of a motion is reported with its setpoint.
        if !matches!(self.motion_state, MotionState::ActiveMotion(_)) {
            let position = &cycle.state.target_rad;
            idle_cycle(&self.mailbox, &mut self.mover, clock::now(), position);
        }
        let Some((session, position_rad)) = setpoint else {
            return Ok(());
        };
        self.number = self.number.wrapping_add(1);
        connection.send_setpoint(&Setpoint {
            position_rad,
            number: self.number,
            session,
        })
    }

    /// Handles the loss of the connection. In this case, the program brakes the arm.
    pub(super) fn handle_disconnect(&mut self, reason: &str) {
        self.motion_state = MotionState::Idle;
        self.mailbox
            .update(|mailbox_state| mailbox_state.control.is_lost = true);
        let reason = format!("connection lost: {reason}");
        // No state follows, so a steered arm reports the stop here.
        self.mover.report_stopped(clock::now(), &reason);
        self.stop_because(reason);
    }

    /// Records whether the robot is ready. Outside of a motion, also reports a stop of the safety
    /// system. During a motion, the end of the program is reported with its reason.
    pub(super) fn take_mode(&mut self, state: &RobotState) {
        let blocking_reason = words::blocking_reason(state).or_else(|| self.other_program(state));
        if self.mailbox.lock().robot.blocking_reason == blocking_reason {
            return;
        }
        self.mailbox.update(|mailbox_state| {
            mailbox_state
                .robot
                .blocking_reason
                .clone_from(&blocking_reason);
            mailbox_state.robot.is_protective_stop = words::is_protective_stop(state);
        });
        if let (MotionState::Idle, true, Some(reason)) = (
            &self.motion_state,
            words::is_stopped(state),
            blocking_reason,
        ) {
            self.stop_because(reason);
        }
    }

    /// The reason to start no motion while another program runs, which our program would replace.
    fn other_program(&self, state: &RobotState) -> Option<String> {
        let is_idle = matches!(self.motion_state, MotionState::Idle);
        (is_idle && state.runtime_state == words::PLAYING)
            .then(|| "another program runs: stop it at the pendant".to_owned())
    }

    fn start_request(&self) -> MotionState {
        match self.mailbox.lock().robot.requested_session.take() {
            Some(session) => MotionState::Beginning {
                session,
                n_waited: 0,
            },
            None => MotionState::Idle,
        }
    }

    /// Waits for the program of a motion.
    fn begin(&mut self, session: i32, n_waited: u64, cycle: &Cycle<'_>) -> Step {
        let state = cycle.state;
        let failure = self.mailbox.lock().robot.start_error.clone();
        let failure = failure.or_else(|| words::blocking_reason(state));
        if let Some(reason) = failure {
            return self.fail_to_start(reason);
        }
        if state.program[0] == session && state.runtime_state == words::PLAYING {
            return self.start_motion(session, cycle);
        }
        let waited_secs = n_waited as f64 / self.rate_hz;
        if waited_secs > MAX_PROGRAM_SECS {
            return self.fail_to_start(match state.program[1] {
                ENDED_WITHOUT_SETPOINTS => "its program received no setpoints: another program may write the same RTDE registers".to_owned(),
                ENDED_BY_DISTANCE => "its program refuses the first setpoint: another program may write the same RTDE registers".to_owned(),
                _ => "it does not run the program that was sent: on an e-Series or later robot, select Remote Control at the pendant, and enable the secondary client interface (Settings, Security, Services)".to_owned(),
            });
        }
        let waiting = MotionState::Beginning {
            session,
            n_waited: n_waited + cycle.n_cycles,
        };
        (waiting, Some((session, state.target_rad)))
    }

    fn start_motion(&mut self, session: i32, cycle: &Cycle<'_>) -> Step {
        // The trajectory starts at the position that the controller commands, not at the measured
        // one. The two differ by the sag under load, so the measured position would cause a jump.
        let start_rad = cycle.state.target_rad;
        let period = Duration::from_secs_f64(1.0 / self.rate_hz);
        let limits = self.limits.clone();
        if let Err(error) = self.mover.hold_at(limits, start_rad.to_vec(), period) {
            return self.halt(session, start_rad, Some(reason_of(&error)));
        }
        self.mailbox.update(|mailbox_state| {
            mailbox_state.robot.is_running = true;
            mailbox_state.robot.statistics.n_motions += 1;
        });
        let active = ActiveMotion {
            session,
            sent_rad: start_rad,
            n_at_rest: 0,
        };
        self.run(Box::new(active), cycle)
    }

    /// Computes one setpoint of a motion.
    fn run(&mut self, mut active: Box<ActiveMotion>, cycle: &Cycle<'_>) -> Step {
        let ActiveMotion {
            session, sent_rad, ..
        } = *active;
        if has_ended(cycle.state, session) {
            self.mailbox
                .update(|mailbox_state| mailbox_state.control.accepts_commands = false);
            let reason = self.end_reason(cycle.state);
            return self.halt(session, sent_rad, Some(reason));
        }
        let command = match self.take_command(&mut active, cycle) {
            NextAction::Command(command) => command,
            NextAction::End => return self.halt(session, sent_rad, None),
        };
        match next_position(&mut self.mover, sent_rad, command.as_ref(), cycle) {
            Ok(position_rad) => {
                active.sent_rad = position_rad;
                let setpoint = Some((session, position_rad));
                (MotionState::ActiveMotion(active), setpoint)
            }
            Err(error) => self.halt(session, sent_rad, Some(reason_of(&error))),
        }
    }

    /// Takes the pending command, and decides whether the motion ends.
    fn take_command(&mut self, active: &mut ActiveMotion, cycle: &Cycle<'_>) -> NextAction {
        let mut mailbox_state = self.mailbox.lock();
        mailbox_state.robot.statistics.n_setpoints += 1;
        mailbox_state.robot.statistics.n_pauses += u64::from(cycle.pause > MAX_PAUSE);
        let command = mailbox_state.control.command.take();
        if mailbox_state.control.is_shutting_down {
            // Targets that still arrive at the port must not keep the motion alive.
            self.mover.come_to_rest();
        }
        // A command that has just arrived keeps the motion alive. Otherwise, it would be lost with
        // the end of the motion.
        let is_resting = self.mover.is_resting() && command.is_none();
        active.n_at_rest = if is_resting {
            active.n_at_rest + cycle.n_cycles
        } else {
            0
        };
        let at_rest_secs = active.n_at_rest as f64 / self.rate_hz;
        if is_resting && (at_rest_secs > MAX_AT_REST_SECS || mailbox_state.control.is_ending()) {
            // The flag is set under the same lock under which the command was taken above. A motion
            // that ends can therefore not accept a command that arrives in between.
            mailbox_state.control.accepts_commands = false;
            return NextAction::End;
        }
        let motion = if command.is_some() {
            Motion::Moving
        } else {
            self.mover.motion()
        };
        if mailbox_state.control.motion != motion {
            mailbox_state.control.motion = motion;
        }
        NextAction::Command(command)
    }

    /// Asks the program to end.
    fn halt(&self, session: i32, at_rad: [f64; N_JOINTS], reason: Option<String>) -> Step {
        self.mailbox
            .update(|mailbox_state| mailbox_state.control.accepts_commands = false);
        let ending = MotionState::Ending {
            session,
            n_waited: 0,
            reason,
        };
        (ending, Some((NO_SESSION, at_rad)))
    }

    /// Waits for the end of the program.
    fn end(&self, session: i32, n_waited: u64, reason: Option<String>, cycle: &Cycle<'_>) -> Step {
        // The registers show the end of the program shortly before the controller does. Until then,
        // the program would look like one of another client.
        if cycle.state.runtime_state != words::PLAYING {
            // A stop of the safety system may arrive after our request to end.
            let stop =
                words::blocking_reason(cycle.state).filter(|_| words::is_stopped(cycle.state));
            return (self.finish(reason.or(stop)), None);
        }
        if n_waited as f64 / self.rate_hz > MAX_PROGRAM_SECS {
            let late = "its program does not end: stop it at the pendant".to_owned();
            return (self.finish(Some(reason.unwrap_or(late))), None);
        }
        let waiting = MotionState::Ending {
            session,
            n_waited: n_waited + cycle.n_cycles,
            reason,
        };
        (waiting, Some((NO_SESSION, cycle.state.target_rad)))
    }

    /// The reason why a program ended without a request.
    fn end_reason(&self, state: &RobotState) -> String {
        if let Some(reason) = words::blocking_reason(state) {
            return reason;
        }
        match state.program[1] {
            ENDED_BY_SILENCE => "setpoints arrived too late: its program braked the arm".to_owned(),
            ENDED_AS_REQUESTED => {
                "its program ended: another program may write the same RTDE registers".to_owned()
            }
            _ => "its program was stopped, at the pendant or by another program".to_owned(),
        }
    }

    /// Gives up a motion that has not moved the arm.
    fn fail_to_start(&self, reason: String) -> Step {
        self.mailbox.update(|mailbox_state| {
            mailbox_state.robot.start_error = Some(reason);
            mailbox_state.control.command = None;
            mailbox_state.control.is_idle = true;
            mailbox_state.control.accepts_commands = false;
            if mailbox_state.control.motion == Motion::Moving {
                mailbox_state.control.motion = Motion::Holding;
            }
        });
        // The program may still start. Without this setpoint, it would wait for the next motion.
        (MotionState::Idle, Some((NO_SESSION, [0.0; N_JOINTS])))
    }

    /// Ends the motion. A `reason` means that it stopped because of a problem.
    fn finish(&self, reason: Option<String>) -> MotionState {
        match reason {
            Some(reason) => self.stop_because(reason),
            None => self.mailbox.update(|mailbox_state| {
                mailbox_state.robot.is_running = false;
                mailbox_state.control.rest();
            }),
        }
        MotionState::Idle
    }

    fn stop_because(&self, reason: String) {
        log::warn!("{}: {reason}", self.device);
        self.mailbox.update(|mailbox_state| {
            mailbox_state.robot.is_running = false;
            mailbox_state.control.stop_because(reason);
        });
    }
}

impl Drop for MotionLoop {
    /// Reports a panic of the thread to the owner of the arm. `mover` reports it through a steering
    /// port.
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.mailbox
                .update(|mailbox_state| mailbox_state.control.end_after_panic());
        }
    }
}

/// The next state of the loop, and the session and position of the setpoint to send.
type Step = (MotionState, Option<(i32, [f64; N_JOINTS])>);

/// Session of a setpoint that asks a program to end.
const NO_SESSION: i32 = 0;

enum NextAction {
    Command(Option<MotionCommand>),
    End,
}

/// Whether the program of a motion no longer runs.
fn has_ended(state: &RobotState, session: i32) -> bool {
    state.program[0] != session || state.runtime_state != words::PLAYING
}

/// Computes the next joint positions, after those that were sent last.
fn next_position(
    mover: &mut Mover,
    sent_rad: [f64; N_JOINTS],
    command: Option<&MotionCommand>,
    cycle: &Cycle<'_>,
) -> Result<[f64; N_JOINTS], Error> {
    if cycle.pause > MAX_PAUSE && !mover.is_at_rest() {
        mover.resume(&motion::Setpoint::at_rest(sent_rad.to_vec()))?;
    }
    if let Some(command) = command {
        command.apply(mover)?;
    }
    let now = clock::now();
    let mut position = mover.step(now)?.position;
    if cycle.pause <= MAX_PAUSE {
        for _ in 1..cycle.n_cycles.min(MAX_STEPS) {
            position = mover.step(now)?.position;
        }
    }
    position.try_into().map_err(|_| Error::Motion {
        reason: "the setpoint has the wrong number of joints".to_owned(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::{JointTarget, SteeringPort};
    use std::iter::repeat_n;

    const CYCLE: Duration = Duration::from_millis(2);
    const LIMITS: MotionLimits = MotionLimits {
        position: [-6.0, 6.0],
        velocity: 0.5,
        acceleration: 2.0,
        jerk: 20.0,
    };

    /// A motion that has just begun, and its last setpoint.
    struct Moving {
        mover: Mover,
        sent_rad: [f64; N_JOINTS],
    }

    impl Moving {
        /// From zero to one radian.
        fn begin() -> Self {
            let mut mover = Mover::default();
            let at_zero = vec![0.0; N_JOINTS];
            let held = mover.hold_at(vec![LIMITS; N_JOINTS], at_zero, CYCLE);
            held.expect("valid limits");
            let target = JointTarget {
                position: vec![1.0; N_JOINTS],
            };
            mover.set_target(&target).expect("a valid target");
            Self {
                mover,
                sent_rad: [0.0; N_JOINTS],
            }
        }

        /// The first joint of the next setpoint.
        fn advance(&mut self, n_cycles: u64, pause: Duration) -> f64 {
            let state = RobotState::default();
            let cycle = Cycle {
                state: &state,
                n_cycles,
                pause,
            };
            let next = next_position(&mut self.mover, self.sent_rad, None, &cycle);
            self.sent_rad = next.expect("a setpoint");
            self.sent_rad[0]
        }
    }

    #[test]
    fn a_panic_of_the_thread_stops_the_arm_with_a_reason() {
        let limits = vec![LIMITS; N_JOINTS];
        let mailbox = Arc::<MotionMailbox>::default();
        let port = SteeringPort::new(&limits, 2.0, || Ok(())).expect("valid limits");
        let device = "arm".to_owned();
        let mut motion_loop = MotionLoop::new(device, Arc::clone(&mailbox), limits, 500.0);
        motion_loop.mover.steer_later(port.clone());
        idle_cycle(&mailbox, &mut motion_loop.mover, clock::now(), &[0.1; 6]);
        assert_eq!(port.state().and_then(|state| state.stopped), None);
        let thread = std::thread::spawn(move || {
            let _moved_here = motion_loop;
            panic!("as a bug in the thread of an arm would do");
        });
        thread.join().expect_err("it panicked");
        let state = port.state().expect("a report");
        let reason = state.stopped.expect("the arm is not moved any more");
        assert!(reason.contains("panicked"), "{reason}");
        assert_eq!(state.position, [0.1; 6], "where it was last");
        let control = &mailbox.lock().control;
        assert!(control.is_lost);
        assert_eq!(control.motion, Motion::Stopped { reason });
    }

    #[test]
    fn a_setpoint_covers_the_cycles_since_the_last_one() {
        let mut in_time = Moving::begin();
        let each: Vec<f64> = (0..1000).map(|_| in_time.advance(1, CYCLE)).collect();
        let mut delayed = Moving::begin();
        let mut n_steps = 0;
        // More than four cycles are not caught up: the setpoint would jump.
        for (n_cycles, n_expected) in [(1, 1), (2, 2), (3, 3), (4, 4), (5, 4), (24, 4)]
            .into_iter()
            .flat_map(|steps| repeat_n(steps, 30))
        {
            let position = delayed.advance(n_cycles, CYCLE);
            n_steps += n_expected;
            assert_eq!(position, each[n_steps - 1], "after {n_steps} cycles");
        }
    }

    #[test]
    fn a_motion_continues_from_rest_after_a_pause() {
        let mut delayed = Moving::begin();
        let moving: Vec<f64> = (0..300).map(|_| delayed.advance(1, CYCLE)).collect();
        assert!(moving[299] - moving[298] > 0.9e-3, "it moves at 0.5 rad/s");
        let resumed = delayed.advance(100, MAX_PAUSE + CYCLE);
        // One cycle of the maximum jerk.
        let max_step = 20.0 * CYCLE.as_secs_f64().powi(3);
        let step = resumed - moving[299];
        assert!((0.0..=max_step).contains(&step), "{step}");
    }
}
