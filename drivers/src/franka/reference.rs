//! Tracks the robot's commanded joint state from the positions that we sent and the states that it
//! reported.

use super::N_JOINTS;
use crate::motion::Setpoint;
use franka::{RobotState, rate_limiting};

/// Seconds between commands.
const STEP_SECS: f64 = rate_limiting::DELTA_T;
/// Maximum position difference between our reference and the robot's, in rad. Smaller differences
/// come from the rounding of FCI 10. Close to 8 rad, its floats are 4.8e-7 apart, so rounding
/// changes them by at most 2.4e-7. A larger tolerance would hide missed commands. With a smaller
/// tolerance, rounding would look like a displaced reference.
const POSITION_TOLERANCE_RAD: f64 = 4e-7;
/// Maximum velocity difference between our reference and the robot's, for velocities up to 8 rad/s.
/// Rounding accounts for a quarter of this tolerance. A missed command with a jerk of 10 rad/s³
/// changes the velocity by 1e-5 rad/s, which is ten times this tolerance.
const VELOCITY_TOLERANCE_RAD_S: f64 = 1e-6;
/// Maximum number of steps by which a reported reference may be behind. `franka-sim` needs this
/// number, because it reports the reference that its joint thread has processed. A larger value
/// would accept wrong references: at 1 rad/s, each step is a milliradian.
const MAX_BEHIND: f64 = 3.0;
/// Number of consecutive missing commands after which the robot stops. Source: FCI documentation,
/// "Real-time control commands".
const MAX_MISSED: u64 = 20;
/// Number of most recent commands over which the robot computes its success rate.
pub(super) const N_SUCCESS_WINDOW: u64 = 100;
/// Number of missed commands that the success rate may not include yet, because the rate and the
/// reference may come from different cycles of the robot. With a larger number, a mistake is
/// corrected later. With a smaller number, commands that were really missed could count as
/// received.
const MAX_UNREPORTED: f64 = 3.0;

/// Commanded joint positions, rad, with velocities and accelerations as differences per
/// millisecond, as the robot computes them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Reference {
    pub(super) position_rad: [f64; N_JOINTS],
    pub(super) velocity_rad_s: [f64; N_JOINTS],
    pub(super) acceleration_rad_s2: [f64; N_JOINTS],
}

/// Outcome of a command, according to the states after it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum CommandFate {
    /// The robot followed the command.
    Followed,
    /// The robot extrapolated over this many missing commands.
    Missed(u64),
    /// The robot's reference matches neither case.
    Unknown,
}

impl CommandFate {
    pub(super) fn n_missed(self) -> u64 {
        match self {
            Self::Missed(n) => n,
            Self::Followed | Self::Unknown => 0,
        }
    }
}

/// Tracks the robot's reference during one motion.
#[derive(Debug)]
pub(super) struct ReferenceTracker {
    reference: Reference,
    /// The reference if the robot received all commands that were sent since it last followed a
    /// command.
    if_all_received: Reference,
    /// Number of commands that the robot seems to have missed since it last followed a command.
    n_doubtful: u64,
}

impl ReferenceTracker {
    pub(super) fn new(reference: Reference) -> Self {
        Self {
            reference,
            if_all_received: reference,
            n_doubtful: 0,
        }
    }

    pub(super) fn reference(&self) -> &Reference {
        &self.reference
    }

    /// Advances over `n_states` new states. `sent` is the answer to the state before them.
    ///
    /// If a received command is mistaken for a missed command, our reference is off by the effect
    /// of that command. The next command is then exactly where the robot would have extrapolated
    /// to, so it looks missed as well. The mistake repeats, and the robot keeps its acceleration
    /// for as long as the commanded jerk is constant. The reported success rate reveals the
    /// mistake, because it limits how many commands can have been missed. In the first
    /// [`N_SUCCESS_WINDOW`] states of a motion, the rate may start at 0, and then reveals the
    /// mistake later.
    pub(super) fn advance(
        &mut self,
        sent: Option<[f64; N_JOINTS]>,
        n_states: u64,
        state: &RobotState,
    ) -> CommandFate {
        let (reference, fate) = self.reference.advance(sent, n_states, state);
        self.reference = reference;
        if fate != CommandFate::Missed(n_states) {
            // The robot has followed a command, or its reference matches no prediction. In both
            // cases, earlier commands are no longer in doubt.
            self.if_all_received = reference;
            self.n_doubtful = 0;
            return fate;
        }
        // Two explanations are tracked in parallel. Either the robot missed all commands since the
        // last certain command, or it received all of them.
        self.if_all_received = self.if_all_received.after(sent, n_states);
        // If a state was not answered, the robot has certainly missed a command, so this state
        // raises no doubt.
        self.n_doubtful += u64::from(sent.is_some());
        let is_contradicted = self.n_doubtful as f64 > n_reported_missed(state) + MAX_UNREPORTED;
        // The success rate alone does not decide. If several states were lost, the other
        // explanation may be wrong as well. It must therefore also match the reported position.
        if !is_contradicted || !self.if_all_received.is_near(state) {
            return fate;
        }
        self.reference = self.if_all_received;
        self.n_doubtful = 0;
        CommandFate::Unknown
    }
}

/// Number of commands in the success window that the robot missed, according to its success rate.
/// NaN if it reports NaN.
fn n_reported_missed(state: &RobotState) -> f64 {
    // The rate is a multiple of 1 %, but it is sent as a float, so the product is rounded to a
    // whole number.
    ((1.0 - state.control_command_success_rate.clamp(0.0, 1.0)) * N_SUCCESS_WINDOW as f64).round()
}

impl Reference {
    /// A reference at rest, at the commanded position that the robot reports.
    pub(super) fn at_rest(state: &RobotState) -> Self {
        // Before the first command, the reported velocities and accelerations may still be those of
        // joints that sag or are guided by hand. They are therefore set to zero.
        Self {
            position_rad: state.q_d,
            velocity_rad_s: [0.0; N_JOINTS],
            acceleration_rad_s2: [0.0; N_JOINTS],
        }
    }

    fn reported(state: &RobotState) -> Self {
        Self {
            position_rad: state.q_d,
            velocity_rad_s: state.dq_d,
            acceleration_rad_s2: state.ddq_d,
        }
    }

    /// The reference a millisecond later, after a position was sent.
    pub(super) fn sent(&self, position_rad: [f64; N_JOINTS]) -> Self {
        // The robot differentiates the positions that it receives. Only the same differences give
        // the velocity, acceleration and jerk that it checks.
        let velocity_rad_s: [f64; N_JOINTS] =
            std::array::from_fn(|ix| (position_rad[ix] - self.position_rad[ix]) / STEP_SECS);
        let acceleration_rad_s2 =
            std::array::from_fn(|ix| (velocity_rad_s[ix] - self.velocity_rad_s[ix]) / STEP_SECS);
        Self {
            position_rad,
            velocity_rad_s,
            acceleration_rad_s2,
        }
    }

    /// The reference a millisecond later without a command: the robot keeps the acceleration.
    fn missed(&self) -> Self {
        let velocity_rad_s: [f64; N_JOINTS] = std::array::from_fn(|ix| {
            self.velocity_rad_s[ix] + self.acceleration_rad_s2[ix] * STEP_SECS
        });
        Self {
            position_rad: std::array::from_fn(|ix| {
                self.position_rad[ix] + velocity_rad_s[ix] * STEP_SECS
            }),
            velocity_rad_s,
            ..*self
        }
    }

    /// The reference after `n` new states, if the robot received the command `sent` (if any) and
    /// nothing after it.
    fn after(&self, sent: Option<[f64; N_JOINTS]>, n: u64) -> Self {
        let first = sent.map_or_else(|| self.missed(), |position_rad| self.sent(position_rad));
        (1..n).fold(first, |reference, _| reference.missed())
    }

    /// Advances the reference over `n_states` new states, and returns the outcome of `sent`, the
    /// answer to the state before them.
    ///
    /// Keeps our own numbers if they match the robot's up to rounding, because differences of
    /// rounded numbers are inaccurate. If the effect of a missing command on the position is within
    /// that rounding, the reported velocities decide. The effect on velocities is a thousand times
    /// larger. Velocities that still match the earlier reference prove nothing: `franka-sim`
    /// reports the velocities of its joints, which start to move some time after their target.
    pub(super) fn advance(
        &self,
        sent: Option<[f64; N_JOINTS]>,
        n_states: u64,
        state: &RobotState,
    ) -> (Self, CommandFate) {
        let reported = Self::reported(state);
        // After so many states, the robot has stopped extrapolating, so the predictions below no
        // longer apply.
        if n_states > MAX_MISSED {
            return (reported, CommandFate::Unknown);
        }
        // Only the first new state can have followed `sent`. No command was sent in answer to the
        // other states, because they arrived together with the newest state, or not at all.
        let n_after = n_states - 1;
        let if_sent_received = sent.map(|position_rad| self.after(Some(position_rad), n_states));
        let if_received = if_sent_received.filter(|reference| reference.is_near(state));
        let if_missed = self.after(None, n_states);
        match if_received {
            Some(if_received)
                // Both predictions are within the rounding of the position, and the velocities
                // match only the one without the command.
                if !if_received.has_velocities_of(&reported)
                    && if_missed.has_velocities_of(&reported)
                    && !self.has_velocities_of(&reported) =>
            {
                (if_missed, CommandFate::Missed(n_states))
            }
            Some(if_received) if n_after == 0 => (if_received, CommandFate::Followed),
            Some(if_received) => (if_received, CommandFate::Missed(n_after)),
            // The position does not match the prediction with the command, or there was no command.
            None => match if_sent_received {
                _ if if_missed.is_near(state) => (if_missed, CommandFate::Missed(n_states)),
                // A robot that reports late seems to be behind our reference. Our reference is
                // kept, because the robot will reach it.
                Some(if_received) if n_after == 0 && if_received.is_shortly_after(&reported) => {
                    (if_received, CommandFate::Followed)
                }
                _ => (reported, CommandFate::Unknown),
            },
        }
    }

    /// Whether all velocities match the reported ones up to rounding.
    fn has_velocities_of(&self, reported: &Self) -> bool {
        self.velocity_rad_s
            .into_iter()
            .zip(reported.velocity_rad_s)
            .all(|(own, robot)| (own - robot).abs() <= VELOCITY_TOLERANCE_RAD_S)
    }

    /// Whether all positions match the reported ones up to rounding.
    fn is_near(&self, state: &RobotState) -> bool {
        let joints = self.position_rad.into_iter().zip(state.q_d);
        joints
            .into_iter()
            .all(|(own, robot)| (own - robot).abs() <= POSITION_TOLERANCE_RAD)
    }

    /// Whether each joint may have been at the reported position a few steps ago.
    fn is_shortly_after(&self, reported: &Self) -> bool {
        let joints = self
            .position_rad
            .into_iter()
            .zip(self.velocity_rad_s)
            .zip(reported.position_rad);
        joints.into_iter().all(|((own, velocity), robot)| {
            (own - robot).abs() <= POSITION_TOLERANCE_RAD + MAX_BEHIND * STEP_SECS * velocity.abs()
        })
    }

    /// Converts the reference to a continuous motion. The difference of two positions is the
    /// velocity half a millisecond earlier.
    pub(super) fn setpoint(&self) -> Setpoint {
        let velocity = self.velocity_rad_s.iter().zip(self.acceleration_rad_s2);
        Setpoint {
            position: self.position_rad.to_vec(),
            velocity: velocity
                .map(|(velocity, acceleration)| velocity + 0.5 * STEP_SECS * acceleration)
                .collect(),
            acceleration: self.acceleration_rad_s2.to_vec(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Reference {
        /// The position a millisecond later with a constant jerk.
        fn next_position(&self, jerk_rad_s3: f64) -> [f64; N_JOINTS] {
            self.missed()
                .position_rad
                .map(|position| position + jerk_rad_s3 * STEP_SECS.powi(3) / 6.0)
        }
    }

    /// State of an FCI 10 robot with this reference, rounded to floats.
    #[expect(clippy::cast_possible_truncation, reason = "FCI 10 sends floats")]
    fn state(reference: &Reference) -> RobotState {
        let rounded = |numbers: [f64; N_JOINTS]| numbers.map(|number| f64::from(number as f32));
        let mut state = RobotState::from_wire(&franka::wire::robot::RobotState::default());
        state.q_d = rounded(reference.position_rad);
        state.dq_d = rounded(reference.velocity_rad_s);
        state.ddq_d = rounded(reference.acceleration_rad_s2);
        state
    }

    fn with_rate(mut state: RobotState, rate: f64) -> RobotState {
        state.control_command_success_rate = rate;
        state
    }

    /// A moving reference, and its next position with the given jerk.
    fn moving(jerk_rad_s3: f64) -> (Reference, [f64; N_JOINTS]) {
        let reference = Reference {
            position_rad: [1.9; N_JOINTS],
            velocity_rad_s: [0.3; N_JOINTS],
            acceleration_rad_s2: [0.7; N_JOINTS],
        };
        let next = reference.position_rad.map(|position| {
            position + STEP_SECS * (0.3 + STEP_SECS * (0.7 + STEP_SECS * jerk_rad_s3))
        });
        (reference, next)
    }

    #[test]
    fn followed_and_missed_commands_are_distinguished() {
        let (reference, next) = moving(600.0);
        let followed = reference.sent(next);
        assert!(
            (followed.acceleration_rad_s2[0] - 1.3).abs() < 1e-6,
            "{followed:?}"
        );
        assert_eq!(
            reference.advance(Some(next), 1, &state(&followed)),
            (followed, CommandFate::Followed)
        );
        let missed = reference.missed();
        assert_eq!(
            reference.advance(Some(next), 1, &state(&missed)),
            (missed, CommandFate::Missed(1))
        );
        assert_eq!(
            reference.advance(None, 1, &state(&missed)),
            (missed, CommandFate::Missed(1))
        );
        let two_later = followed.missed().missed();
        assert_eq!(
            reference.advance(Some(next), 3, &state(&two_later)),
            (two_later, CommandFate::Missed(2))
        );
        let three_later = missed.missed().missed();
        assert_eq!(
            reference.advance(Some(next), 3, &state(&three_later)),
            (three_later, CommandFate::Missed(3))
        );
    }

    #[test]
    fn missed_commands_are_detected_from_velocities() {
        let (reference, next) = moving(20.0);
        let (missed, followed) = (reference.missed(), reference.sent(next));
        assert!((followed.position_rad[0] - missed.position_rad[0]).abs() < POSITION_TOLERANCE_RAD);
        assert_eq!(
            reference.advance(Some(next), 1, &state(&missed)),
            (missed, CommandFate::Missed(1))
        );
        assert_eq!(
            reference.advance(Some(next), 1, &state(&followed)),
            (followed, CommandFate::Followed)
        );
        // If the velocities of a robot match neither prediction, its position decides, and it
        // counts as following.
        let mut smoothed = followed;
        smoothed.velocity_rad_s = [0.29; N_JOINTS];
        assert_eq!(
            reference.advance(Some(next), 1, &state(&smoothed)),
            (followed, CommandFate::Followed)
        );
    }

    #[test]
    fn command_mistaken_for_missed_displaces_reference_only_briefly() {
        const JERK_RAD_S3: f64 = -10.0;
        const RATE: f64 = 0.97;
        let next = |reference: &Reference| reference.next_position(JERK_RAD_S3);
        // The robot followed the last command, but our reference counts it as missed.
        let (earlier, _) = moving(JERK_RAD_S3);
        let mut robot = earlier.sent(next(&earlier));
        let mut tracker = ReferenceTracker::new(earlier.missed());
        let fates: Vec<CommandFate> = std::iter::repeat_with(|| {
            let sent = next(tracker.reference());
            robot = robot.sent(sent);
            tracker.advance(Some(sent), 1, &with_rate(state(&robot), RATE))
        })
        .take(60)
        .collect();
        // The success rate reports three missed commands, and may not include three more yet.
        let n_displaced = fates
            .iter()
            .take_while(|fate| **fate != CommandFate::Followed)
            .count();
        assert_eq!(n_displaced, 7, "{fates:?}");
        assert!(
            fates[n_displaced..]
                .iter()
                .all(|fate| *fate == CommandFate::Followed),
            "{fates:?}"
        );
        let expected = 0.7 + (60 - n_displaced) as f64 * JERK_RAD_S3 * STEP_SECS / 6.0;
        assert!(
            (robot.acceleration_rad_s2[0] - expected).abs() < 5e-3,
            "{robot:?}, expected {expected}"
        );
        assert!(
            (robot.position_rad[0] - tracker.reference().position_rad[0]).abs() < 1e-12,
            "{tracker:?}"
        );
    }

    #[test]
    fn missed_commands_stay_missed() {
        let (start, _) = moving(0.0);
        for (n_states, rate) in [(1, 0.9), (1, f64::NAN), (6, 0.94), (6, 1.0)] {
            let (mut robot, mut tracker) = (start, ReferenceTracker::new(start));
            for _ in 0..10 {
                robot = robot.after(None, n_states);
                let sent = tracker.reference().next_position(600.0);
                let fate = tracker.advance(Some(sent), n_states, &with_rate(state(&robot), rate));
                assert_eq!(
                    (fate, *tracker.reference()),
                    (CommandFate::Missed(n_states), robot),
                    "{n_states}, {rate}"
                );
            }
        }
    }

    #[test]
    fn joints_at_rest_do_not_imply_missed_command() {
        let rest = Reference {
            position_rad: [1.9; N_JOINTS],
            velocity_rad_s: [0.0; N_JOINTS],
            acceleration_rad_s2: [0.0; N_JOINTS],
        };
        let first = rest.sent([1.9 + 20.0 * STEP_SECS.powi(3) / 6.0; N_JOINTS]);
        let reported = state(&Reference {
            position_rad: first.position_rad,
            ..rest
        });
        assert_eq!(
            rest.advance(Some(first.position_rad), 1, &reported),
            (first, CommandFate::Followed)
        );
    }

    #[test]
    fn delayed_reports_count_as_followed() {
        let (reference, next) = moving(20.0);
        let followed = reference.sent(next);
        assert_eq!(
            reference.advance(Some(next), 1, &state(&reference)),
            (followed, CommandFate::Followed)
        );
    }

    #[test]
    fn reported_reference_overrides_ours() {
        let (reference, next) = moving(20.0);
        let mut displaced = reference.sent(next);
        displaced.position_rad[3] += 1e-2;
        let reported = state(&displaced);
        assert_eq!(
            reference.advance(Some(next), 1, &reported),
            (Reference::reported(&reported), CommandFate::Unknown)
        );
        let followed = state(&reference.sent(next));
        assert_eq!(
            reference.advance(Some(next), 30, &followed).1,
            CommandFate::Unknown,
            "after a long silence"
        );
    }
}
