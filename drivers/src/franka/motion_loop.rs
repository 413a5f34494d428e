//! The part of an arm's thread that moves the arm: for each state that arrives, it sends the joint
//! positions for the next millisecond.

use super::connection::{Connection, error_text};
use super::limits::RobotLimits;
use super::mailbox::MotionMailbox;
use super::recent_cycles::RecentCycles;
use super::reference::{CommandFate, N_SUCCESS_WINDOW, Reference, ReferenceTracker};
use super::request::{self, MotionResponse};
use super::state::NumberedState;
use crate::clock;
use crate::motion::{Motion, MotionCommand, MotionLimits, Mover, idle_cycle, reason_of};
use franka::{RobotMode, RobotState};
use kinematics::Stamp;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

const STEP: Duration = Duration::from_millis(1);
/// Number of states at rest after which a motion ends. After the end, a person may guide the arm by
/// hand. Starting a motion takes a request and its answer. A caller that sends several targets in a
/// row should not have to start a motion for each target.
const MAX_AT_REST: u32 = 1000;
/// Number of states within which a motion must start. Source: FCI documentation.
const MAX_STATES_UNTIL_START: u32 = 1000;
/// Number of states within which a robot reports why a motion ended. The report comes over TCP, and
/// may arrive after the states, which come over UDP. Without a bound, a lost connection would leave
/// the arm neither idle nor stopped.
const MAX_STATES_UNTIL_RESPONSE: u32 = 100;

/// Moves an arm in response to its states.
#[derive(Debug)]
pub(super) struct MotionLoop {
    device: String,
    connection: Arc<Connection>,
    mailbox: Arc<MotionMailbox>,
    robot: RobotLimits,
    limits: Vec<MotionLimits>,
    mover: Mover,
    motion_state: MotionState,
    mode: RobotMode,
}

/// A state that arrived in order, with its stamp on our clock.
pub(super) struct StampedState<'a> {
    pub(super) numbered: &'a NumberedState,
    pub(super) stamp: Stamp,
    pub(super) from: SocketAddr,
    /// Whether the state has just arrived. If not, the robot may already have stopped waiting for
    /// an answer, so the state is not answered.
    pub(super) is_fresh: bool,
}

#[derive(Debug)]
enum MotionState {
    Idle,
    /// The robot has accepted a motion, but no state reports the motion yet.
    Beginning {
        id: u32,
        n_waited: u32,
    },
    ActiveMotion(Box<ActiveMotion>),
    /// A motion has ended according to the states, but the robot's reply has not arrived yet.
    Ending {
        id: u32,
        n_waited: u32,
        reason: Option<String>,
        /// Summary of the last cycles before a reflex; empty if there was no reflex.
        summary: String,
    },
}

#[derive(Debug)]
struct ActiveMotion {
    id: u32,
    tracker: ReferenceTracker,
    /// Number of the newest state.
    number: u64,
    /// The position sent in answer to the newest state.
    sent: Option<[f64; super::N_JOINTS]>,
    recent: RecentCycles,
    n_cycles: u64,
    n_at_rest: u32,
    is_ending: bool,
}

impl MotionLoop {
    pub(super) fn new(
        device: String,
        connection: Arc<Connection>,
        mailbox: Arc<MotionMailbox>,
        robot: RobotLimits,
        limits: Vec<MotionLimits>,
    ) -> Self {
        Self {
            device,
            connection,
            mailbox,
            robot,
            limits,
            mover: Mover::default(),
            motion_state: MotionState::Idle,
            mode: RobotMode::Other,
        }
    }

    /// Processes the newest state.
    pub(super) fn cycle(&mut self, stamped: &StampedState<'_>) {
        let state = &stamped.numbered.state;
        self.take_mode(state);
        // Each state of the loop is consumed and replaced, so that a finished motion cannot be
        // continued by mistake.
        self.motion_state = match std::mem::replace(&mut self.motion_state, MotionState::Idle) {
            MotionState::Idle => self.start_request(),
            MotionState::Beginning { id, n_waited } => self.start_motion(id, n_waited, stamped),
            // The robot has ended the motion, either as requested or because of a reflex or the
            // user stop. A command that arrives now belongs to the next motion.
            MotionState::ActiveMotion(active) if state.robot_mode != RobotMode::Move => {
                self.mailbox
                    .update(|mailbox_state| mailbox_state.control.accepts_commands = false);
                let summary = match state.robot_mode {
                    RobotMode::Reflex => self.summary(&active.recent, stamped.numbered.number),
                    _ => String::new(),
                };
                MotionState::Ending {
                    id: active.id,
                    n_waited: 0,
                    reason: cause(state),
                    summary,
                }
            }
            MotionState::ActiveMotion(active) => self.run(active, stamped),
            MotionState::Ending {
                id,
                n_waited,
                reason,
                summary,
            } => self.conclude(id, n_waited, reason, summary),
        };
        // The state of a motion is reported with its setpoint.
        if !matches!(self.motion_state, MotionState::ActiveMotion(_)) {
            idle_cycle(&self.mailbox, &mut self.mover, clock::now(), &state.q_d);
        }
    }

    fn start_request(&self) -> MotionState {
        match self.mailbox.lock().robot.started_motion.take() {
            Some(id) => MotionState::Beginning { id, n_waited: 0 },
            None => MotionState::Idle,
        }
    }

    /// Handles the loss of the connection. In this case, the robot stops without a command.
    pub(super) fn handle_disconnect(&mut self, reason: &str) {
        self.motion_state = MotionState::Idle;
        self.mailbox
            .update(|mailbox_state| mailbox_state.control.is_lost = true);
        let reason = format!("connection lost: {reason}");
        // No state follows, so a steered arm reports the stop here.
        self.mover.report_stopped(clock::now(), &reason);
        self.stop_because(reason);
    }

    /// Records the robot's mode. Outside of a motion, also reports a mode that stops the arm.
    /// During a motion, the reply about the end of the motion gives more details.
    pub(super) fn take_mode(&mut self, state: &RobotState) {
        let mode = state.robot_mode;
        if mode == self.mode {
            return;
        }
        self.mode = mode;
        self.mailbox
            .update(|mailbox_state| mailbox_state.robot.mode = mode);
        // Between motions, no reply is pending. Without this check, a user stop would go unnoticed
        // until the next target.
        if let (MotionState::Idle, RobotMode::Reflex | RobotMode::UserStopped, Some(reason)) =
            (&self.motion_state, mode, cause(state))
        {
            self.stop_because(reason);
        }
    }

    fn start_motion(&mut self, id: u32, n_waited: u32, stamped: &StampedState<'_>) -> MotionState {
        let StampedState { numbered, .. } = stamped;
        // The answer to the request and the states come over different connections, so states from
        // before the motion may still arrive.
        if numbered.state.robot_mode != RobotMode::Move {
            return match request::outcome(&self.connection, id) {
                Ok(None) if n_waited < MAX_STATES_UNTIL_START => MotionState::Beginning {
                    id,
                    n_waited: n_waited + 1,
                },
                Ok(None) => self.halt(id, "it accepted a motion but did not start it".to_owned()),
                Ok(Some(MotionResponse::Rejected(why))) => {
                    self.finish(cause(&numbered.state).or(Some(why)))
                }
                Ok(Some(_)) => self.finish(
                    cause(&numbered.state)
                        .or(Some("it ended a motion before it started".to_owned())),
                ),
                Err(why) => self.finish(Some(why)),
            };
        }
        // The trajectory starts at the position that the robot commands, not at the measured one.
        // The two differ by the sag under load, so the measured position would cause a jump.
        let reference = Reference::at_rest(&numbered.state);
        let position = reference.position_rad.to_vec();
        if let Err(error) = self.mover.hold_at(self.limits.clone(), position, STEP) {
            return self.halt(id, reason_of(&error));
        }
        self.mailbox.lock().robot.statistics.n_motions += 1;
        let active = ActiveMotion {
            id,
            tracker: ReferenceTracker::new(reference),
            number: numbered.number,
            sent: None,
            recent: RecentCycles::new(),
            n_cycles: 0,
            n_at_rest: 0,
            is_ending: false,
        };
        self.run(Box::new(active), stamped)
    }

    /// Runs one millisecond of a motion.
    fn run(&mut self, mut active: Box<ActiveMotion>, stamped: &StampedState<'_>) -> MotionState {
        let NumberedState { number, state } = stamped.numbered;
        let n_states = number.saturating_sub(active.number);
        // What the robot did with the last command is determined first, because the next command
        // must continue from the resulting state. Otherwise, the robot would see a jump.
        let fate = match n_states {
            0 => CommandFate::Followed,
            n => active.tracker.advance(active.sent, n, state),
        };
        active.number = *number;
        active.sent = None;
        let command = self.take_command(&mut active, n_states, fate, stamped);
        let position_rad = match self.next_position(&active, command.as_ref(), fate) {
            Ok(position_rad) => position_rad,
            Err(why) => return self.halt(active.id, why),
        };
        // The trajectory advances even if nothing is sent. The next state then shows that the robot
        // has extrapolated.
        if stamped.is_fresh {
            self.send(&mut active, stamped, position_rad);
        }
        active.recent.push(
            stamped.numbered,
            fate,
            active.tracker.reference(),
            active.sent,
        );
        MotionState::ActiveMotion(active)
    }

    /// Updates the statistics, takes the pending command, and updates whether the arm is at rest.
    fn take_command(
        &mut self,
        active: &mut ActiveMotion,
        n_states: u64,
        fate: CommandFate,
        stamped: &StampedState<'_>,
    ) -> Option<MotionCommand> {
        active.n_cycles += 1;
        let mut mailbox_state = self.mailbox.lock();
        mailbox_state.robot.statistics.n_cycles += 1;
        mailbox_state.robot.statistics.n_lost += n_states.saturating_sub(1);
        mailbox_state.robot.statistics.n_stale += u64::from(!stamped.is_fresh);
        mailbox_state.robot.statistics.n_missed += fate.n_missed();
        // The window of the success rate is full only after this number of cycles.
        if active.n_cycles > N_SUCCESS_WINDOW {
            mailbox_state
                .robot
                .statistics
                .count_robot_success(stamped.numbered.state.control_command_success_rate);
        }
        let command = mailbox_state.control.command.take();
        if mailbox_state.control.is_shutting_down {
            // Targets that still arrive at the port must not keep the motion alive.
            self.mover.come_to_rest();
        }
        // A command that has just arrived keeps the motion alive. Otherwise, it would be lost with
        // the end of the motion.
        let is_resting = self.mover.is_resting() && command.is_none();
        active.n_at_rest = if is_resting { active.n_at_rest + 1 } else { 0 };
        if is_resting && (active.n_at_rest > MAX_AT_REST || mailbox_state.control.is_ending()) {
            // The lock under which the command was taken above is still held. No command can
            // therefore be accepted in between and then be lost.
            active.is_ending = true;
            mailbox_state.control.accepts_commands = false;
        }
        let motion = if command.is_some() {
            Motion::Moving
        } else {
            self.mover.motion()
        };
        if mailbox_state.control.motion != motion {
            mailbox_state.control.motion = motion;
        }
        command
    }

    /// Computes the next joint positions.
    fn next_position(
        &mut self,
        active: &ActiveMotion,
        command: Option<&MotionCommand>,
        fate: CommandFate,
    ) -> Result<[f64; super::N_JOINTS], String> {
        let reference = active.tracker.reference();
        let mover = &mut self.mover;
        if let Some(command) = command {
            command.apply(mover).map_err(|error| reason_of(&error))?;
        }
        // At rest, the robot keeps its position even if commands were lost.
        if fate != CommandFate::Followed && !mover.is_at_rest() {
            mover
                .resume(&reference.setpoint())
                .map_err(|error| reason_of(&error))?;
        }
        // The robot ends the motion with the position at which it rests. A target that arrives now
        // needs a new motion.
        let setpoint = if active.is_ending {
            mover.held()
        } else {
            mover
                .step(clock::now())
                .map_err(|error| reason_of(&error))?
        };
        let desired = setpoint.position;
        let desired = desired
            .try_into()
            .map_err(|_| "the setpoint has the wrong number of joints".to_owned())?;
        // While the robot follows the setpoints of the generator, their rates are within the
        // generator's limits. After a missed command or with a displaced reference, rates may be
        // higher. The position that is sent must always be within the limits of the robot.
        let (position_rad, is_limited) = self.robot.limited(desired, reference)?;
        if is_limited {
            // The generator continues from the position that was sent instead of its own setpoint.
            // Otherwise, its next setpoint would have to be limited, too.
            mover
                .resume(&reference.sent(position_rad).setpoint())
                .map_err(|error| reason_of(&error))?;
            self.mailbox.lock().robot.statistics.n_limited += 1;
        }
        Ok(position_rad)
    }

    fn send(
        &self,
        active: &mut ActiveMotion,
        stamped: &StampedState<'_>,
        position_rad: [f64; super::N_JOINTS],
    ) {
        let Connection { network, version } = &*self.connection;
        let datagram = request::command(*version, active.number, &position_rad, active.is_ending);
        match network.udp.send(stamped.from, &datagram) {
            Ok(()) => {
                active.sent = Some(position_rad);
                self.mailbox
                    .lock()
                    .robot
                    .statistics
                    .count(clock::now().duration_since(stamped.stamp));
            }
            // A command that cannot be sent has the same effect as a lost datagram: the robot
            // extrapolates.
            Err(error) => log::debug!(
                "{}: a command could not be sent: {}",
                self.device,
                error_text(&error)
            ),
        }
    }

    /// Summarizes and logs the last cycles of a motion. `number` is the number of the state that
    /// reported its end.
    fn summary(&self, recent: &RecentCycles, number: u64) -> String {
        log::debug!(
            "{}: the last cycles before the stop: {}",
            self.device,
            recent.table()
        );
        recent.summary(number)
    }

    /// Makes the robot brake.
    fn halt(&self, id: u32, reason: String) -> MotionState {
        // The motion is ended by a request. If commands simply ceased, the robot would stop only
        // after 20 ms, with a reflex that a person must clear.
        let reason = match request::halt(&self.connection) {
            Ok(()) => reason,
            Err(why) => format!("{reason}; {why}"),
        };
        self.mailbox
            .update(|mailbox_state| mailbox_state.control.accepts_commands = false);
        MotionState::Ending {
            id,
            n_waited: 0,
            reason: Some(reason),
            summary: String::new(),
        }
    }

    /// Waits for the robot's reply about a motion that has ended.
    fn conclude(
        &self,
        id: u32,
        n_waited: u32,
        reason: Option<String>,
        summary: String,
    ) -> MotionState {
        let reason = match request::outcome(&self.connection, id) {
            Ok(None) if n_waited < MAX_STATES_UNTIL_RESPONSE => {
                return MotionState::Ending {
                    id,
                    n_waited: n_waited + 1,
                    reason,
                    summary,
                };
            }
            Ok(Some(MotionResponse::Finished)) => reason,
            // The states describe the cause, such as the reflex, in more detail. The robot's answer
            // is added, because it may contain information that the states lack.
            Ok(Some(MotionResponse::Rejected(why))) => {
                Some(reason.map_or(why.clone(), |reason| format!("{reason} ({why})")))
            }
            Ok(None | Some(MotionResponse::Started)) => Some(
                reason.unwrap_or_else(|| "it ended a motion without giving a reason".to_owned()),
            ),
            Err(why) => Some(reason.unwrap_or(why)),
        };
        self.finish(reason.map(|reason| {
            if summary.is_empty() {
                reason
            } else {
                format!("{reason}; {summary}")
            }
        }))
    }

    /// Ends the motion. A `reason` means that it stopped because of a problem.
    fn finish(&self, reason: Option<String>) -> MotionState {
        match reason {
            Some(reason) => self.stop_because(reason),
            None => self
                .mailbox
                .update(|mailbox_state| mailbox_state.control.rest()),
        }
        MotionState::Idle
    }

    fn stop_because(&self, reason: String) {
        log::warn!("{}: {reason}", self.device);
        self.mailbox
            .update(|mailbox_state| mailbox_state.control.stop_because(reason));
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

/// The reason why a robot does not follow commands, according to its state; `None` if the robot is
/// ready.
fn cause(state: &RobotState) -> Option<String> {
    match state.robot_mode {
        RobotMode::Reflex => {
            // The current errors may already be cleared when the state is sent. In that case, the
            // errors of the last motion still name the cause.
            let errors = state.current_errors.names();
            let last = state.last_motion_errors.names();
            let names = if errors.is_empty() { last } else { errors };
            Some(format!("stopped by a reflex: {}", names.join(", ")))
        }
        RobotMode::Idle | RobotMode::Move | RobotMode::AutomaticErrorRecovery => None,
        mode => request::blocking_reason(mode).map(str::to_owned),
    }
}

#[cfg(test)]
mod tests {
    use super::super::FciVersion;
    use super::super::tests::{REST_RAD, ideal_joints, robot};
    use super::*;
    use crate::motion::SteeringPort;

    #[test]
    fn a_panic_of_the_thread_stops_the_arm_with_a_reason() {
        let robot = robot(FciVersion::V5, ideal_joints());
        let connection = Connection::open(&robot.address().to_string()).unwrap();
        let limits = MotionLimits {
            position: [-6.0, 6.0],
            velocity: 0.5,
            acceleration: 2.0,
            jerk: 20.0,
        };
        let limits = vec![limits; REST_RAD.len()];
        let mailbox = Arc::<MotionMailbox>::default();
        let port = SteeringPort::new(&limits, 2.0, || Ok(())).unwrap();
        let mut motion_loop = MotionLoop::new(
            "arm".to_owned(),
            Arc::new(connection),
            Arc::clone(&mailbox),
            RobotLimits::panda(),
            limits,
        );
        motion_loop.mover.steer_later(port.clone());
        idle_cycle(&mailbox, &mut motion_loop.mover, clock::now(), &REST_RAD);
        assert_eq!(port.state().and_then(|state| state.stopped), None);
        let thread = std::thread::spawn(move || {
            let _moved_here = motion_loop;
            panic!("as a bug in the thread of an arm would do");
        });
        thread.join().unwrap_err();
        let state = port.state().unwrap();
        let reason = state.stopped.unwrap();
        assert!(reason.contains("panicked"), "{reason}");
        assert_eq!(state.position, REST_RAD, "where it was last");
        let control = &mailbox.lock().control;
        assert!(control.is_lost);
        assert_eq!(control.motion, Motion::Stopped { reason });
    }
}
