//! The part of an arm's thread that moves it: in comes a state, out goes where the joints are to be a millisecond later.

use super::desk::{Desk, Order};
use super::limits::RobotLimits;
use super::reference::{Fate, Reference};
use super::request::{self, Verdict};
use super::session::{Session, sentence};
use super::state::Numbered;
use crate::clock;
use crate::motion::{Generator, Motion, MotionLimits};
use franka::{RobotMode, RobotState};
use kinematics::Stamp;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

const STEP: Duration = Duration::from_millis(1);
/// A motion that has been at rest for so many states ends, so that a person may guide the arm by hand.
const MAX_HELD: u32 = 1000;
/// States after which a motion must have begun. Source: FCI documentation.
const MAX_UNTIL_BEGUN: u32 = 1000;
/// States within which a robot says why a motion is over.
const MAX_UNTIL_TOLD: u32 = 100;
/// The robot tells how many of its last 100 commands came in time: not before so many states.
const N_JUDGED: u64 = 100;

/// Moves an arm by its states.
#[derive(Debug)]
pub(super) struct Mover {
    device: String,
    session: Arc<Session>,
    desk: Arc<Desk>,
    robot: RobotLimits,
    limits: Vec<MotionLimits>,
    phase: Phase,
    mode: RobotMode,
}

/// A state that came in order, and when it was told by our clock.
pub(super) struct Timed<'a> {
    pub(super) numbered: &'a Numbered,
    pub(super) stamp: Stamp,
    pub(super) from: SocketAddr,
    /// Whether it just came; otherwise it may be from before the robot gave up on us, and is not answered.
    pub(super) is_fresh: bool,
}

#[derive(Debug)]
enum Phase {
    Idle,
    /// The robot let a motion begin; no state says so yet.
    Beginning {
        id: u32,
        n_waited: u32,
    },
    Running(Box<Running>),
    /// A motion is over by the robot's states; what it says of that is still to come.
    Over {
        id: u32,
        n_waited: u32,
        reason: Option<String>,
    },
}

#[derive(Debug)]
struct Running {
    id: u32,
    generator: Generator,
    reference: Reference,
    /// Number of the newest state.
    number: u64,
    /// What it was answered.
    sent: Option<[f64; super::N_JOINTS]>,
    n_cycles: u64,
    n_held: u32,
    is_ending: bool,
}

impl Mover {
    pub(super) fn new(
        device: String,
        session: Arc<Session>,
        desk: Arc<Desk>,
        robot: RobotLimits,
        limits: Vec<MotionLimits>,
    ) -> Self {
        Self { device, session, desk, robot, limits, phase: Phase::Idle, mode: RobotMode::Other }
    }

    /// One state: the newest that came.
    pub(super) fn turn(&mut self, timed: &Timed<'_>) {
        let state = &timed.numbered.state;
        self.take_mode(state);
        self.phase = match std::mem::replace(&mut self.phase, Phase::Idle) {
            Phase::Idle => match self.desk.lock().begun.take() {
                Some(id) => Phase::Beginning { id, n_waited: 0 },
                None => Phase::Idle,
            },
            Phase::Beginning { id, n_waited } => self.begin(id, n_waited, timed),
            Phase::Running(running) if state.robot_mode != RobotMode::Move => {
                self.desk.tell(|board| board.takes_orders = false);
                Phase::Over { id: running.id, n_waited: 0, reason: cause(state) }
            }
            Phase::Running(running) => self.run(running, timed),
            Phase::Over { id, n_waited, reason } => self.conclude(id, n_waited, reason),
        };
    }

    /// The robot is lost: it stops by itself.
    pub(super) fn lose(&mut self, reason: &str) {
        self.phase = Phase::Idle;
        self.desk.tell(|board| board.is_lost = true);
        self.stop_for(format!("lost: {reason}"));
    }

    /// Tells a mode that stops the arm outside of any motion, once; in a motion its end tells more.
    pub(super) fn take_mode(&mut self, state: &RobotState) {
        let mode = state.robot_mode;
        if mode == self.mode {
            return;
        }
        self.mode = mode;
        self.desk.tell(|board| board.mode = mode);
        if let (Phase::Idle, RobotMode::Reflex | RobotMode::UserStopped, Some(reason)) =
            (&self.phase, mode, cause(state))
        {
            self.stop_for(reason);
        }
    }

    fn begin(&mut self, id: u32, n_waited: u32, timed: &Timed<'_>) -> Phase {
        let Timed { numbered, .. } = timed;
        if numbered.state.robot_mode != RobotMode::Move {
            return match request::outcome(&self.session, id) {
                Ok(None) if n_waited < MAX_UNTIL_BEGUN => Phase::Beginning { id, n_waited: n_waited + 1 },
                Ok(None) => self.halt(id, "it let a motion begin that did not".to_owned()),
                Ok(Some(Verdict::Refused(why))) => self.over(cause(&numbered.state).or(Some(why))),
                Ok(Some(_)) => self.over(cause(&numbered.state).or(Some("it ended a motion by itself".to_owned()))),
                Err(why) => self.over(Some(why)),
            };
        }
        let reference = Reference::at_rest(&numbered.state);
        let generator = match Generator::new(&self.limits, &reference.position_rad, STEP) {
            Ok(generator) => generator,
            Err(why) => return self.halt(id, why),
        };
        self.desk.lock().statistics.n_motions += 1;
        let running = Running {
            id,
            generator,
            reference,
            number: numbered.number,
            sent: None,
            n_cycles: 0,
            n_held: 0,
            is_ending: false,
        };
        self.run(Box::new(running), timed)
    }

    /// A millisecond of a motion.
    fn run(&mut self, mut running: Box<Running>, timed: &Timed<'_>) -> Phase {
        let Numbered { number, state } = timed.numbered;
        let n_states = number.saturating_sub(running.number);
        let (reference, fate) = match n_states {
            0 => (running.reference, Fate::Followed),
            n => running.reference.later(running.sent, n, state),
        };
        (running.reference, running.number, running.sent) = (reference, *number, None);
        let order = self.consult(&mut running, n_states, fate, timed);
        let position_rad = match self.shape(&mut running, order.as_ref(), fate) {
            Ok(position_rad) => position_rad,
            Err(why) => return self.halt(running.id, why),
        };
        if timed.is_fresh {
            self.send(&mut running, timed, position_rad);
        }
        Phase::Running(running)
    }

    /// Counts the state, takes the order that there is, and tells whether the arm is at rest.
    fn consult(&self, running: &mut Running, n_states: u64, fate: Fate, timed: &Timed<'_>) -> Option<Order> {
        running.n_cycles += 1;
        let mut board = self.desk.lock();
        board.statistics.n_cycles += 1;
        board.statistics.n_lost += n_states.saturating_sub(1);
        board.statistics.n_stale += u64::from(!timed.is_fresh);
        if let Fate::Missed(n) = fate {
            board.statistics.n_missed += n;
        }
        if running.n_cycles > N_JUDGED {
            board.statistics.count_told(timed.numbered.state.control_command_success_rate);
        }
        let order = board.order.take();
        let is_held = running.generator.is_held() && order.is_none();
        running.n_held = if is_held { running.n_held + 1 } else { 0 };
        if is_held && (running.n_held > MAX_HELD || board.is_leaving) {
            (running.is_ending, board.takes_orders) = (true, false);
        }
        let motion = if is_held { Motion::Held } else { Motion::Moving };
        if board.motion != motion {
            board.motion = motion;
        }
        order
    }

    /// Where the joints are to be next.
    fn shape(
        &self,
        running: &mut Running,
        order: Option<&Order>,
        fate: Fate,
    ) -> Result<[f64; super::N_JOINTS], String> {
        let Running { generator, reference, .. } = running;
        match order {
            Some(Order::Head(target)) => drop(generator.head_for(target)?),
            Some(Order::Stop) => generator.stop(),
            None => {}
        }
        // At rest the robot stays where it is, whatever was lost.
        if fate != Fate::Followed && !generator.is_held() {
            generator.resume(&reference.setpoint())?;
        }
        let wanted = generator.step()?.position;
        let wanted = wanted.try_into().map_err(|_| "the setpoint is of another arm".to_owned())?;
        let (position_rad, is_limited) = self.robot.limited(wanted, reference)?;
        if is_limited {
            generator.resume(&reference.sent(position_rad).setpoint())?;
            self.desk.lock().statistics.n_limited += 1;
        }
        Ok(position_rad)
    }

    fn send(&self, running: &mut Running, timed: &Timed<'_>, position_rad: [f64; super::N_JOINTS]) {
        let Session { network, version } = &*self.session;
        let datagram = request::command(*version, running.number, &position_rad, running.is_ending);
        match network.udp.send(timed.from, &datagram) {
            Ok(()) => {
                running.sent = Some(position_rad);
                self.desk.lock().statistics.count(clock::now().duration_since(timed.stamp));
            }
            // As good as lost on the way: the robot goes on without.
            Err(error) => log::debug!("{}: a command did not go out: {}", self.device, sentence(&error)),
        }
    }

    /// Has the robot brake.
    fn halt(&self, id: u32, reason: String) -> Phase {
        let reason = match request::halt(&self.session) {
            Ok(()) => reason,
            Err(why) => format!("{reason}; {why}"),
        };
        self.desk.tell(|board| board.takes_orders = false);
        Phase::Over { id, n_waited: 0, reason: Some(reason) }
    }

    /// Takes what the robot says of a motion that is over.
    fn conclude(&self, id: u32, n_waited: u32, reason: Option<String>) -> Phase {
        let reason = match request::outcome(&self.session, id) {
            Ok(None) if n_waited < MAX_UNTIL_TOLD => return Phase::Over { id, n_waited: n_waited + 1, reason },
            Ok(Some(Verdict::Ended)) => reason,
            Ok(Some(Verdict::Refused(why))) => Some(reason.map_or(why.clone(), |reason| format!("{reason} ({why})"))),
            Ok(None | Some(Verdict::Begun)) => {
                Some(reason.unwrap_or_else(|| "it ended a motion and does not say why".to_owned()))
            }
            Err(why) => Some(reason.unwrap_or(why)),
        };
        self.over(reason)
    }

    /// No motion runs any more; with a reason it stopped by itself.
    fn over(&self, reason: Option<String>) -> Phase {
        match reason {
            Some(reason) => self.stop_for(reason),
            None => self.desk.tell(|board| {
                (board.is_idle, board.takes_orders, board.order, board.motion) = (true, false, None, Motion::Held);
            }),
        }
        Phase::Idle
    }

    fn stop_for(&self, reason: String) {
        log::warn!("{}: {reason}", self.device);
        self.desk.tell(|board| {
            // An order from before is not for an arm that was recovered.
            (board.is_idle, board.takes_orders, board.order) = (true, false, None);
            board.motion = Motion::Stopped { reason };
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
        mode => request::hindrance(mode).map(str::to_owned),
    }
}
