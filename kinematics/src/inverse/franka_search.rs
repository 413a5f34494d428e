//! Search over the last joint of a Franka arm for the solution within the ranges that is closest to
//! a configuration.

use super::bounds::Bounds;
use super::comfort::Comfort;
use super::franka::{Branch, Forearm, FrankaArm, Wrist};
use crate::Transform;

/// Number of intervals in the range of the last joint at the first level. About 98 % of the
/// reachable poses of a Panda have a solution at one of their ends.
const N_INTERVALS: u32 = 14;
/// Number of levels. Each level halves the intervals of the previous level. At the last level,
/// values of the last joint are 0.013 rad apart. The few poses without a solution at these values
/// are left to least squares.
const N_LEVELS: u32 = 6;
/// Number of steps of the final search between two tested values. Each step shortens the interval
/// by the golden ratio. The last interval is 2 % of the first interval.
const N_GOLDEN_STEPS: usize = 8;

/// The pose and the preference of a search.
pub(super) struct FrankaSearch<'a> {
    pub(super) arm: &'a FrankaArm,
    pub(super) bounds: &'a Bounds,
    pub(super) comfort: &'a Comfort,
    /// Configuration from which the squared distance counts as cost.
    pub(super) seed: &'a [f64],
    pub(super) shoulder_from_seven: Transform,
}

/// A solution within the ranges.
#[derive(Clone, Copy)]
struct Candidate {
    branch: Branch,
    joints: [f64; 7],
    cost: f64,
}

impl FrankaSearch<'_> {
    /// Joints with the least cost. The best solution on a grid of the last joint is found first,
    /// and then refined on its branch. `None` if no tested value of the last joint has a solution
    /// within the ranges.
    pub(super) fn run(&self) -> Option<[f64; 7]> {
        let [lower, upper] = self.bounds.start_range(6, self.seed[6], 0.0);
        let mut step = (upper - lower) / f64::from(N_INTERVALS);
        let mut best = self.scan(lower..=upper, step, 1);
        for _ in 1..N_LEVELS {
            if best.is_some() {
                break;
            }
            step *= 0.5;
            // Even multiples were tested at the previous level.
            best = self.scan(lower..=upper, step, 2);
        }
        Some(self.refine(best?, lower..=upper, step).joints)
    }

    /// Tests values of the last joint at growing distance from the seed. Stops when the cost of
    /// this distance alone exceeds the cost of the best solution.
    ///
    /// * `stride`: 1 tests all multiples of `step`, and 2 tests only the odd multiples.
    fn scan(
        &self,
        range: std::ops::RangeInclusive<f64>,
        step: f64,
        stride: u32,
    ) -> Option<Candidate> {
        let center = self.bounds.clamp(6, self.seed[6]);
        let mut best: Option<Candidate> = None;
        for round in 0_u32.. {
            let multiple = stride - 1 + stride * round;
            let distance = step * f64::from(multiple);
            let is_beyond = center - distance < *range.start() && center + distance > *range.end();
            let is_worse = best.is_some_and(|best| distance * distance > best.cost);
            if is_beyond || is_worse {
                break;
            }
            let sides = if multiple == 0 { 1 } else { 2 };
            for last_rad in [center - distance, center + distance]
                .into_iter()
                .take(sides)
            {
                if range.contains(&last_rad) {
                    self.test(last_rad, &mut best);
                }
            }
            // A range of a single value has one candidate.
            if step == 0.0 {
                break;
            }
        }
        best
    }

    /// Compares all solutions for a value of the last joint with the best solution so far.
    fn test(&self, last_rad: f64, best: &mut Option<Candidate>) {
        let Some(wrist) = self.arm.wrist(&self.shoulder_from_seven, last_rad) else {
            return;
        };
        // Two consecutive branches have the same elbow and wrist, and differ only in the shoulder.
        for branches in Branch::ALL.chunks(2) {
            let most = best.map_or(f64::INFINITY, |best| best.cost);
            for candidate in self.on_branches(&wrist, last_rad, branches, most) {
                keep_better(best, candidate);
            }
        }
    }

    /// The solutions within the ranges on branches that differ at most in the shoulder.
    ///
    /// * `most`: cost above which solutions are not needed.
    fn on_branches(
        &self,
        wrist: &Wrist,
        last_rad: f64,
        branches: &[Branch],
        most: f64,
    ) -> impl Iterator<Item = Candidate> {
        let outer = self.outer_joints(wrist, last_rad, branches[0], most);
        outer.into_iter().flat_map(move |(forearm, outer, cost)| {
            branches.iter().filter_map(move |branch| {
                let mut joints = outer;
                let mut cost = cost;
                for (joint_ix, value) in forearm.shoulder(*branch).into_iter().enumerate() {
                    joints[joint_ix] = self.place(joint_ix, value, &mut cost)?;
                }
                Some(Candidate {
                    branch: *branch,
                    joints,
                    cost,
                })
            })
        })
    }

    /// The values of the joints from the elbow to the last joint, and their cost. Each joint is
    /// checked before the next joint is computed, because most combinations of joint values leave a
    /// range.
    fn outer_joints(
        &self,
        wrist: &Wrist,
        last_rad: f64,
        branch: Branch,
        most: f64,
    ) -> Option<(Forearm, [f64; 7], f64)> {
        let mut joints = [0.0; 7];
        let mut cost = 0.0;
        joints[6] = self.place(6, last_rad, &mut cost)?;
        let q4 = self.arm.q4(wrist, branch);
        joints[3] = self.place(3, q4, &mut cost)?;
        if cost > most {
            return None;
        }
        let elbow = self.arm.elbow(wrist, q4)?;
        let forearm = elbow.forearm(wrist, branch)?;
        joints[5] = self.place(5, forearm.q6, &mut cost)?;
        joints[4] = self.place(4, forearm.q5, &mut cost)?;
        (cost <= most).then_some((forearm, joints, cost))
    }

    /// Adds the cost of a joint, and returns its value within the range that is closest to the
    /// seed.
    fn place(&self, joint_ix: usize, value: f64, cost: &mut f64) -> Option<f64> {
        let seed = self.seed[joint_ix];
        let value = self.bounds.nearest_turn(joint_ix, value, seed)?;
        *cost += (value - seed).powi(2) + self.comfort.cost_of(self.bounds, joint_ix, value);
        Some(value)
    }

    /// Moves the last joint on one branch to the least cost between the neighbors of a tested value
    /// (golden section, Kiefer 1953).
    fn refine(
        &self,
        start: Candidate,
        range: std::ops::RangeInclusive<f64>,
        step: f64,
    ) -> Candidate {
        const RATIO: f64 = 0.618_033_988_749_894_8;
        let at = |last_rad: f64| -> Option<Candidate> {
            let wrist = self.arm.wrist(&self.shoulder_from_seven, last_rad)?;
            let branches = std::slice::from_ref(&start.branch);
            self.on_branches(&wrist, last_rad, branches, f64::INFINITY)
                .next()
        };
        let cost_of = |candidate: &Option<Candidate>| candidate.map_or(f64::INFINITY, |it| it.cost);
        let mut low = (start.joints[6] - step).max(*range.start());
        let mut high = (start.joints[6] + step).min(*range.end());
        let mut best = Some(start);
        let mut inner = [high - RATIO * (high - low), low + RATIO * (high - low)];
        let mut found = inner.map(at);
        for _ in 0..N_GOLDEN_STEPS {
            // Values without a solution have an infinite cost. If neither neighbor has a solution,
            // the solutions are around the start.
            let [lower_cost, upper_cost] = [cost_of(&found[0]), cost_of(&found[1])];
            let is_start_below = start.joints[6] < 0.5 * (low + high);
            if lower_cost < upper_cost || (lower_cost == upper_cost && is_start_below) {
                high = inner[1];
                inner = [high - RATIO * (high - low), inner[0]];
                found = [at(inner[0]), found[0]];
            } else {
                low = inner[0];
                inner = [inner[1], low + RATIO * (high - low)];
                found = [found[1], at(inner[1])];
            }
            // The better of the two inner values is kept in every step, so no better candidate is
            // missed.
            for candidate in found.into_iter().flatten() {
                keep_better(&mut best, candidate);
            }
        }
        best.expect("it starts with a candidate")
    }
}

fn keep_better(best: &mut Option<Candidate>, candidate: Candidate) {
    if best.is_none_or(|best| candidate.cost < best.cost) {
        *best = Some(candidate);
    }
}
