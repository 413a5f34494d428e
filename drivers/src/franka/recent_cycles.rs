//! The last cycles of a motion, to explain why a robot stopped it.

use super::N_JOINTS;
use super::reference::{CommandFate, Reference};
use super::state::NumberedState;
use std::collections::VecDeque;
use std::fmt::Write;

/// A state and our answer.
#[derive(Debug)]
struct Cycle {
    number: u64,
    /// Outcome of the previous command.
    fate: CommandFate,
    /// The robot's reference according to our tracker.
    assumed: Reference,
    reported_rad: [f64; N_JOINTS],
    reported_rad_s: [f64; N_JOINTS],
    success_rate: f64,
    sent_rad: Option<[f64; N_JOINTS]>,
}

impl Cycle {
    /// Joint with the largest commanded acceleration, and that acceleration in rad/s².
    fn largest_acceleration(&self) -> Option<(usize, f64)> {
        // Like the robot, this computes the acceleration from differences of positions. A violated
        // limit is thus visible even if the trajectory itself was smooth.
        let sent = self.assumed.sent(self.sent_rad?);
        let accelerations = sent
            .acceleration_rad_s2
            .map(f64::abs)
            .into_iter()
            .enumerate();
        accelerations.max_by(|a, b| a.1.total_cmp(&b.1))
    }
}

/// The last cycles of a motion.
#[derive(Debug)]
pub(super) struct RecentCycles(VecDeque<Cycle>);

impl RecentCycles {
    /// Maximum number of cycles that are kept. A robot gives up after 20 missed commands, and
    /// reports the reflex some states later. The number covers all of these cycles and some cycles
    /// before them.
    const MAX: usize = 60;

    pub(super) fn new() -> Self {
        Self(VecDeque::with_capacity(Self::MAX))
    }

    /// Adds a state and our answer. `fate` is the outcome of the command before it, `assumed` our
    /// tracked reference.
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
            assumed: *assumed,
            reported_rad: state.q_d,
            reported_rad_s: state.dq_d,
            success_rate: state.control_command_success_rate,
            sent_rad,
        });
    }

    /// Reports missed and unsent commands, lost states, and the largest commanded acceleration.
    /// `last_number` is the number of the state that reported the end of the motion.
    pub(super) fn summary(&self, last_number: u64) -> String {
        let n_missed: u64 = self.0.iter().map(|cycle| cycle.fate.n_missed()).sum();
        let n_unsent = self
            .0
            .iter()
            .filter(|cycle| cycle.sent_rad.is_none())
            .count();
        // States that were lost just before the end are in the gap before the last number.
        let numbers = self.0.iter().map(|cycle| cycle.number).chain([last_number]);
        let n_lost: u64 = numbers
            .clone()
            .zip(numbers.skip(1))
            .map(|(from, to)| to.saturating_sub(from + 1))
            .sum();
        let mut text = format!(
            "in the last {} cycles, the robot missed {n_missed} commands, {n_unsent} were not sent in time, and {n_lost} \
             states were not received",
            self.0.len()
        );
        let accelerations = self.0.iter().filter_map(Cycle::largest_acceleration);
        if let Some((joint, acceleration)) = accelerations.max_by(|a, b| a.1.total_cmp(&b.1)) {
            let _ = write!(
                text,
                "; largest commanded acceleration {acceleration:.2} rad/s² (joint {})",
                joint + 1
            );
        }
        text
    }

    /// One line per cycle.
    pub(super) fn table(&self) -> String {
        const HEADER: &str = "number, outcome of the previous command, success rate; \
            joint positions, rad: reported, assumed, sent; reported velocities, rad/s";
        let mut text = HEADER.to_owned();
        for cycle in &self.0 {
            let Cycle {
                number,
                fate,
                success_rate,
                reported_rad,
                assumed,
                sent_rad,
                reported_rad_s,
            } = cycle;
            let _ = write!(
                text,
                "\n{number} {fate:?} {success_rate:.2}; {reported_rad:.7?} {:.7?} ",
                assumed.position_rad
            );
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
    fn summary_counts_losses_and_reports_the_largest_acceleration() {
        let mut recent = RecentCycles::new();
        let reference = Reference::at_rest(&RobotState::default());
        let mut push = |number: u64, fate, sent_rad| {
            recent.push(
                &NumberedState {
                    number,
                    state: RobotState::default(),
                },
                fate,
                &reference,
                sent_rad,
            );
        };
        // A jump of 3 microradians within a millisecond is an acceleration of 3 rad/s².
        let mut jump = [0.0; N_JOINTS];
        jump[4] = 3e-6;
        push(100, CommandFate::Followed, Some([0.0; N_JOINTS]));
        push(101, CommandFate::Missed(1), Some(jump));
        push(103, CommandFate::Missed(2), None);
        let expected = "in the last 3 cycles, the robot missed 3 commands, 1 were not sent in time, and 31 states were \
                        not received; largest commanded acceleration 3.00 rad/s² (joint 5)";
        assert_eq!(recent.summary(134), expected);
        assert_eq!(recent.table().lines().count(), 1 + 3);
        for number in 104..300 {
            let numbered = NumberedState {
                number,
                state: RobotState::default(),
            };
            recent.push(&numbered, CommandFate::Followed, &reference, None);
        }
        assert!(
            recent
                .summary(300)
                .starts_with("in the last 60 cycles, the robot missed 0 commands, 60 were not")
        );
    }
}
