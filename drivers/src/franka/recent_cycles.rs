//! The last cycles of a motion, to explain why a robot stopped it.

use super::N_JOINTS;
use super::reference::{CommandFate, Reference};
use super::state::NumberedState;
use franka::rate_limiting;
use std::collections::VecDeque;
use std::fmt::Write;

/// What one state reported, and how it was answered.
#[derive(Debug)]
struct Cycle {
    number: u64,
    /// Outcome of the previous command.
    fate: CommandFate,
    /// Positions of the robot's reference according to our tracker, rad.
    assumed_rad: [f64; N_JOINTS],
    reported_rad: [f64; N_JOINTS],
    reported_rad_s: [f64; N_JOINTS],
    success_rate: f64,
    /// The answer, rad.
    sent_rad: Option<[f64; N_JOINTS]>,
}

/// The last cycles of a motion.
#[derive(Debug)]
pub(super) struct RecentCycles(VecDeque<Cycle>);

impl RecentCycles {
    const MAX: usize = 60;

    pub(super) fn new() -> Self {
        Self(VecDeque::with_capacity(Self::MAX))
    }

    /// Adds the cycle of this state. `fate` is the outcome of the command before it, `sent_rad` the answer to it.
    pub(super) fn push(
        &mut self,
        NumberedState { number, state }: &NumberedState,
        fate: CommandFate,
        assumed: &Reference,
        sent_rad: Option<[f64; N_JOINTS]>,
    ) {
        if self.0.len() == Self::MAX {
            self.0.pop_front();
        }
        self.0.push_back(Cycle {
            number: *number,
            fate,
            assumed_rad: assumed.position_rad,
            reported_rad: state.q_d,
            reported_rad_s: state.dq_d,
            success_rate: state.control_command_success_rate,
            sent_rad,
        });
    }

    /// Missed and unsent commands, and the largest commanded acceleration of a joint.
    pub(super) fn summary(&self) -> String {
        let n_missed: u64 = self.0.iter().map(|cycle| cycle.fate.n_missed()).sum();
        let n_unsent = self.0.iter().filter(|cycle| cycle.sent_rad.is_none()).count();
        let mut text = format!(
            "in the last {} cycles, the robot missed {n_missed} commands, and {n_unsent} were not sent in time",
            self.0.len()
        );
        let pairs = self.0.iter().zip(self.0.iter().skip(1)).filter(|(before, after)| after.number > before.number);
        let accelerations = pairs.flat_map(|(before, after)| {
            let secs = (after.number - before.number) as f64 * rate_limiting::DELTA_T;
            let change = move |joint: usize| after.reported_rad_s[joint] - before.reported_rad_s[joint];
            (0..N_JOINTS).map(move |joint| (joint, change(joint).abs() / secs))
        });
        if let Some((joint, acceleration)) = accelerations.max_by(|a, b| a.1.total_cmp(&b.1)) {
            let _ = write!(text, "; joint {} was commanded up to {acceleration:.2} rad/s²", joint + 1);
        }
        text
    }

    /// One line per cycle.
    pub(super) fn table(&self) -> String {
        const HEADER: &str = "number, outcome of the previous command, success rate; \
            joint positions, rad: reported, assumed, sent; reported velocities, rad/s";
        let mut text = HEADER.to_owned();
        for cycle in &self.0 {
            let Cycle { number, fate, success_rate, reported_rad, assumed_rad, sent_rad, reported_rad_s } = cycle;
            let _ = write!(text, "\n{number} {fate:?} {success_rate:.2}; {reported_rad:.7?} {assumed_rad:.7?} ");
            let _ = write!(text, "{sent_rad:.7?}; {reported_rad_s:.6?}");
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use franka::RobotState;

    #[test]
    fn summary_counts_missed_commands_and_names_the_fastest_change() {
        let mut recent = RecentCycles::new();
        // The number 104 arrives twice, and 102 is lost.
        let numbers = [100, 101, 103, 104, 104];
        let fates = [CommandFate::Followed, CommandFate::Missed(1), CommandFate::Missed(2), CommandFate::Followed];
        for (ix, number) in numbers.into_iter().enumerate() {
            let mut state = RobotState::default();
            state.dq_d[4] = if number >= 103 { 0.006 } else { 0.0 };
            let fate = fates.get(ix).copied().unwrap_or(CommandFate::Followed);
            let sent = (number != 104).then_some([0.1; N_JOINTS]);
            recent.push(&NumberedState { number, state }, fate, &Reference::at_rest(&RobotState::default()), sent);
        }
        let expected = "in the last 5 cycles, the robot missed 3 commands, and 2 were not sent in time; \
                        joint 5 was commanded up to 3.00 rad/s²";
        assert_eq!(recent.summary(), expected);
        assert_eq!(recent.table().lines().count(), 1 + numbers.len());
        for number in 105..300 {
            let numbered = NumberedState { number, state: RobotState::default() };
            recent.push(&numbered, CommandFate::Followed, &Reference::at_rest(&numbered.state), None);
        }
        assert!(recent.summary().starts_with("in the last 60 cycles, the robot missed 0 commands"));
    }
}
