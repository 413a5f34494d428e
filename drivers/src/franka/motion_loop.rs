//! The part of an arm's thread that moves it: in comes a state, out goes where the joints are to be a millisecond later.

use super::limits::RobotLimits;
use super::mailbox::{MotionMailbox, MotionOrder};
use super::reference::{CommandFate, Reference};
use super::request::{self, MotionResponse};
use super::session::{Session, error_text};
use super::state::NumberedState;
use crate::clock;
use crate::motion::{Motion, MotionLimits, TrajectoryGenerator};
use franka::{RobotMode, RobotState};
use kinematics::Stamp;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

const STEP: Duration = Duration::from_millis(1);
/// A motion that has been at rest for so many states ends, so that a person may guide the arm by hand.
const MAX_AT_REST: u32 = 1000;
/// States after which a motion must have begun. Source: FCI documentation.
const MAX_STATES_UNTIL_START: u32 = 1000;
/// States within which a robot says why a motion is over.
const MAX_STATES_UNTIL_RESPONSE: u32 = 100;
/// The robot tells how many of its last 100 commands came in time: not before so many states.
const N_SUCCESS_WINDOW: u64 = 100;

/// Moves an arm by its states.
#[derive(Debug)]
pub(super) struct MotionLoop {
    device: String,
    session: Arc<Session>,
    mailbox: Arc<MotionMailbox>,
    robot: RobotLimits,
    limits: Vec<MotionLimits>,
    motion_state: MotionState,
    mode: RobotMode,
}

/// A state that came in order, and when it was told by our clock.
pub(super) struct StampedState<'a> {
    pub(super) numbered: &'a NumberedState,
    pub(super) stamp: Stamp,
    pub(super) from: SocketAddr,
    /// Whether it just came; otherwise it may be from before the robot gave up on us, and is not answered.
    pub(super) is_fresh: bool,
}

#[derive(Debug)]
enum MotionState {
    Idle,
    /// The robot let a motion begin; no state says so yet.
    Beginning {
        id: u32,
        n_waited: u32,
    },
    ActiveMotion(Box<ActiveMotion>),
    /// A motion is over by the robot's states; what it says of that is still to come.
    Ending {
        id: u32,
        n_waited: u32,
        reason: Option<String>,
    },
}

#[derive(Debug)]
struct ActiveMotion {
    id: u32,
    generator: TrajectoryGenerator,
    reference: Reference,
    /// Number of the newest state.
    number: u64,
    /// What it was answered.
    sent: Option<[f64; super::N_JOINTS]>,
    n_cycles: u64,
    n_at_rest: u32,
    is_ending: bool,
}

impl MotionLoop {
    pub(super) fn new(
        device: String,
        session: Arc<Session>,
        mailbox: Arc<MotionMailbox>,
        robot: RobotLimits,
        limits: Vec<MotionLimits>,
    ) -> Self {
        Self { device, session, mailbox, robot, limits, motion_state: MotionState::Idle, mode: RobotMode::Other }
    }

    /// One state: the newest that came.
    pub(super) fn cycle(&mut self, stamped: &StampedState<'_>) {
        let state = &stamped.numbered.state;
        self.take_mode(state);
        self.motion_state = match std::mem::replace(&mut self.motion_state, MotionState::Idle) {
            MotionState::Idle => match self.mailbox.lock().started_motion.take() {
                Some(id) => MotionState::Beginning { id, n_waited: 0 },
                None => MotionState::Idle,
            },
            MotionState::Beginning { id, n_waited } => self.start_motion(id, n_waited, stamped),
            MotionState::ActiveMotion(active) if state.robot_mode != RobotMode::Move => {
                self.mailbox.update(|mailbox_state| mailbox_state.accepts_orders = false);
                MotionState::Ending { id: active.id, n_waited: 0, reason: cause(state) }
            }
            MotionState::ActiveMotion(active) => self.run(active, stamped),
            MotionState::Ending { id, n_waited, reason } => self.conclude(id, n_waited, reason),
        };
    }

    /// The robot is lost: it stops by itself.
    pub(super) fn handle_disconnect(&mut self, reason: &str) {
        self.motion_state = MotionState::Idle;
        self.mailbox.update(|mailbox_state| mailbox_state.is_lost = true);
        self.stop_because(format!("lost: {reason}"));
    }

    /// Tells a mode that stops the arm outside of any motion, once; in a motion its end tells more.
    pub(super) fn take_mode(&mut self, state: &RobotState) {
        let mode = state.robot_mode;
        if mode == self.mode {
            return;
        }
        self.mode = mode;
        self.mailbox.update(|mailbox_state| mailbox_state.mode = mode);
        if let (MotionState::Idle, RobotMode::Reflex | RobotMode::UserStopped, Some(reason)) =
            (&self.motion_state, mode, cause(state))
        {
            self.stop_because(reason);
        }
    }

    fn start_motion(&mut self, id: u32, n_waited: u32, stamped: &StampedState<'_>) -> MotionState {
        let StampedState { numbered, .. } = stamped;
        if numbered.state.robot_mode != RobotMode::Move {
            return match request::outcome(&self.session, id) {
                Ok(None) if n_waited < MAX_STATES_UNTIL_START => MotionState::Beginning { id, n_waited: n_waited + 1 },
                Ok(None) => self.halt(id, "it let a motion begin that did not".to_owned()),
                Ok(Some(MotionResponse::Rejected(why))) => self.finish(cause(&numbered.state).or(Some(why))),
                Ok(Some(_)) => self.finish(cause(&numbered.state).or(Some("it ended a motion by itself".to_owned()))),
                Err(why) => self.finish(Some(why)),
            };
        }
        let reference = Reference::at_rest(&numbered.state);
        let generator = match TrajectoryGenerator::new(&self.limits, &reference.position_rad, STEP) {
            Ok(generator) => generator,
            Err(why) => return self.halt(id, why),
        };
        self.mailbox.lock().statistics.n_motions += 1;
        let active = ActiveMotion {
            id,
            generator,
            reference,
            number: numbered.number,
            sent: None,
            n_cycles: 0,
            n_at_rest: 0,
            is_ending: false,
        };
        self.run(Box::new(active), stamped)
    }

    /// A millisecond of a motion.
    fn run(&mut self, mut active: Box<ActiveMotion>, stamped: &StampedState<'_>) -> MotionState {
        let NumberedState { number, state } = stamped.numbered;
        let n_states = number.saturating_sub(active.number);
        let (reference, fate) = match n_states {
            0 => (active.reference, CommandFate::Followed),
            n => active.reference.advance(active.sent, n, state),
        };
        (active.reference, active.number, active.sent) = (reference, *number, None);
        let order = self.take_order(&mut active, n_states, fate, stamped);
        let position_rad = match self.next_position(&mut active, order.as_ref(), fate) {
            Ok(position_rad) => position_rad,
            Err(why) => return self.halt(active.id, why),
        };
        if stamped.is_fresh {
            self.send(&mut active, stamped, position_rad);
        }
        MotionState::ActiveMotion(active)
    }

    /// Counts the state, takes the order that there is, and tells whether the arm is at rest.
    fn take_order(
        &self,
        active: &mut ActiveMotion,
        n_states: u64,
        fate: CommandFate,
        stamped: &StampedState<'_>,
    ) -> Option<MotionOrder> {
        active.n_cycles += 1;
        let mut mailbox_state = self.mailbox.lock();
        mailbox_state.statistics.n_cycles += 1;
        mailbox_state.statistics.n_lost += n_states.saturating_sub(1);
        mailbox_state.statistics.n_stale += u64::from(!stamped.is_fresh);
        if let CommandFate::Missed(n) = fate {
            mailbox_state.statistics.n_missed += n;
        }
        if active.n_cycles > N_SUCCESS_WINDOW {
            mailbox_state.statistics.count_robot_success(stamped.numbered.state.control_command_success_rate);
        }
        let order = mailbox_state.order.take();
        let is_at_rest = active.generator.is_at_rest() && order.is_none();
        active.n_at_rest = if is_at_rest { active.n_at_rest + 1 } else { 0 };
        if is_at_rest && (active.n_at_rest > MAX_AT_REST || mailbox_state.is_shutting_down) {
            (active.is_ending, mailbox_state.accepts_orders) = (true, false);
        }
        let motion = if is_at_rest { Motion::Holding } else { Motion::Moving };
        if mailbox_state.motion != motion {
            mailbox_state.motion = motion;
        }
        order
    }

    /// Where the joints are to be next.
    fn next_position(
        &self,
        active: &mut ActiveMotion,
        order: Option<&MotionOrder>,
        fate: CommandFate,
    ) -> Result<[f64; super::N_JOINTS], String> {
        let ActiveMotion { generator, reference, .. } = active;
        match order {
            Some(MotionOrder::SetTarget(target)) => drop(generator.set_target(target)?),
            Some(MotionOrder::Stop) => generator.stop(),
            None => {}
        }
        // At rest the robot stays where it is, whatever was lost.
        if fate != CommandFate::Followed && !generator.is_at_rest() {
            generator.resume(&reference.setpoint())?;
        }
        let desired = generator.step()?.position;
        let desired = desired.try_into().map_err(|_| "the setpoint is of another arm".to_owned())?;
        let (position_rad, is_limited) = self.robot.limited(desired, reference)?;
        if is_limited {
            generator.resume(&reference.sent(position_rad).setpoint())?;
            self.mailbox.lock().statistics.n_limited += 1;
        }
        Ok(position_rad)
    }

    fn send(&self, active: &mut ActiveMotion, stamped: &StampedState<'_>, position_rad: [f64; super::N_JOINTS]) {
        let Session { network, version } = &*self.session;
        let datagram = request::command(*version, active.number, &position_rad, active.is_ending);
        match network.udp.send(stamped.from, &datagram) {
            Ok(()) => {
                active.sent = Some(position_rad);
                self.mailbox.lock().statistics.count(clock::now().duration_since(stamped.stamp));
            }
            // As good as lost on the way: the robot goes on without.
            Err(error) => log::debug!("{}: a command did not go out: {}", self.device, error_text(&error)),
        }
    }

    /// Has the robot brake.
    fn halt(&self, id: u32, reason: String) -> MotionState {
        let reason = match request::halt(&self.session) {
            Ok(()) => reason,
            Err(why) => format!("{reason}; {why}"),
        };
        self.mailbox.update(|mailbox_state| mailbox_state.accepts_orders = false);
        MotionState::Ending { id, n_waited: 0, reason: Some(reason) }
    }

    /// Takes what the robot says of a motion that is over.
    fn conclude(&self, id: u32, n_waited: u32, reason: Option<String>) -> MotionState {
        let reason = match request::outcome(&self.session, id) {
            Ok(None) if n_waited < MAX_STATES_UNTIL_RESPONSE => {
                return MotionState::Ending { id, n_waited: n_waited + 1, reason };
            }
            Ok(Some(MotionResponse::Finished)) => reason,
            Ok(Some(MotionResponse::Rejected(why))) => {
                Some(reason.map_or(why.clone(), |reason| format!("{reason} ({why})")))
            }
            Ok(None | Some(MotionResponse::Started)) => {
                Some(reason.unwrap_or_else(|| "it ended a motion and does not say why".to_owned()))
            }
            Err(why) => Some(reason.unwrap_or(why)),
        };
        self.finish(reason)
    }

    /// No motion runs any more; with a reason it stopped by itself.
    fn finish(&self, reason: Option<String>) -> MotionState {
        match reason {
            Some(reason) => self.stop_because(reason),
            None => self.mailbox.update(|mailbox_state| {
                (mailbox_state.is_idle, mailbox_state.accepts_orders, mailbox_state.order, mailbox_state.motion) =
                    (true, false, None, Motion::Holding);
            }),
        }
        MotionState::Idle
    }

    fn stop_because(&self, reason: String) {
        log::warn!("{}: {reason}", self.device);
        self.mailbox.update(|mailbox_state| {
            // An order from before is not for an arm that was recovered.
            (mailbox_state.is_idle, mailbox_state.accepts_orders, mailbox_state.order) = (true, false, None);
            mailbox_state.motion = Motion::Stopped { reason };
        });
    }
}

/// Why a robot does not move as it was told, by its state; `None` where it is ready.
fn cause(state: &RobotState) -> Option<String> {
    match state.robot_mode {
        RobotMode::Reflex => {
            let (errors, last) = (state.current_errors.names(), state.last_motion_errors.names());
            let names = if errors.is_empty() { last } else { errors };
            Some(format!("stopped by a reflex: {}", names.join(", ")))
        }
        RobotMode::Idle | RobotMode::Move | RobotMode::AutomaticErrorRecovery => None,
        mode => request::blocking_reason(mode).map(str::to_owned),
    }
}
