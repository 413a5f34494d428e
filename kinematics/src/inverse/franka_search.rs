//! Search over the last joint of a Franka arm for the solution within the ranges that is closest to
//! a configuration.

use super::bounds::Bounds;
use super::comfort::Comfort;
use super::franka::{Branch, Forearm, FrankaArm, SevenFrame, opposite};

/// Number of intervals in the range of the last joint at the first level. About 98 % of the
/// reachable poses of a Panda have a solution at one of their ends.
const N_INTERVALS: u32 = 16;
/// Number of levels. Each level halves the intervals of the previous level. At the last level,
/// values of the last joint are 0.011 rad apart. The few poses without a solution at these values
/// are left to least squares.
const N_LEVELS: u32 = 6;
/// Number of values of the last joint that are tested to refine the best one. The cost is nearly a
/// parabola there.
const N_REFINEMENTS: usize = 5;

/// The pose and the preference of a search.
pub(super) struct FrankaSearch<'a> {
    pub(super) arm: &'a FrankaArm,
    pub(super) bounds: &'a Bounds,
    pub(super) comfort: &'a Comfort,
    /// Configuration from which the squared distance counts as cost.
    pub(super) seed: &'a [f64],
    pub(super) seven: SevenFrame,
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
        self.compare(last_rad, &BOTH, best);
    }

    /// Compares the solutions on some branches with the best solution so far.
    ///
    /// Each joint is checked before the next one is computed, because most combinations of joint
    /// values leave a range, or already cost more than the best solution.
    fn compare(&self, last_rad: f64, sides: &Sides<'_>, best: &mut Option<Candidate>) {
        let mut joints = [0.0; 7];
        let Some(last_cost) = self.place(6, last_rad, &mut joints) else {
            return;
        };
        let Some(wrist) = self.arm.wrist(&self.seven, last_rad) else {
            return;
        };
        for is_elbow_bent in sides.elbow.iter().copied() {
            let elbow = self.arm.elbow(&wrist, is_elbow_bent);
            let Some(cost) = self.place(3, elbow.q4, &mut joints) else {
                continue;
            };
            let elbow_cost = last_cost + cost;
            if is_worse(elbow_cost, best.as_ref()) {
                continue;
            }
            let Some(bend) = elbow.bend(&wrist) else {
                continue;
            };
            for is_wrist_outward in sides.wrist.iter().copied() {
                let Some(cost) = self.place(5, bend.q6(is_wrist_outward), &mut joints) else {
                    continue;
                };
                if is_worse(elbow_cost + cost, best.as_ref()) {
                    continue;
                }
                let forearm = elbow.forearm(&wrist, &bend, is_wrist_outward);
                let wrist_cost = elbow_cost + cost;
                let Some(cost) = self.place(4, forearm.q5, &mut joints) else {
                    continue;
                };
                let outer = Outer {
                    is_elbow_bent,
                    is_wrist_outward,
                    joints,
                    cost: wrist_cost + cost,
                };
                if !is_worse(outer.cost, best.as_ref()) {
                    self.compare_shoulders(&outer, &forearm, sides.shoulder, best);
                }
            }
        }
    }

    /// Compares the solutions that differ only in the shoulder.
    fn compare_shoulders(
        &self,
        outer: &Outer,
        forearm: &Forearm,
        sides: &[bool],
        best: &mut Option<Candidate>,
    ) {
        let forward_q2 = forearm.q2();
        let mut others = None;
        for is_shoulder_forward in sides.iter().copied() {
            let sign = if is_shoulder_forward { 1.0 } else { -1.0 };
            let mut joints = outer.joints;
            let Some(added) = self.place(1, sign * forward_q2, &mut joints) else {
                continue;
            };
            let mut cost = outer.cost + added;
            if is_worse(cost, best.as_ref()) {
                continue;
            }
            let mut values = *others.get_or_insert_with(|| forearm.q1_and_q3());
            if !is_shoulder_forward {
                values = values.map(opposite);
            }
            let is_within = [0, 2].into_iter().zip(values).all(|(joint_ix, value)| {
                let added = self.place(joint_ix, value, &mut joints);
                cost += added.unwrap_or_default();
                added.is_some()
            });
            if is_within && !is_worse(cost, best.as_ref()) {
                *best = Some(Candidate {
                    branch: Branch {
                        is_elbow_bent: outer.is_elbow_bent,
                        is_wrist_outward: outer.is_wrist_outward,
                        is_shoulder_forward,
                    },
                    joints,
                    cost,
                });
            }
        }
    }

    /// Sets a joint to its value within the range that is closest to the seed, and returns the cost
    /// of this value. `None` if no value is within the range.
    #[inline]
    fn place(&self, joint_ix: usize, value: f64, joints: &mut [f64; 7]) -> Option<f64> {
        let seed = self.seed[joint_ix];
        let value = self.bounds.nearest_turn(joint_ix, value, seed)?;
        joints[joint_ix] = value;
        let off = value - seed;
        Some(off * off + self.comfort.cost_of(self.bounds, joint_ix, value))
    }

    /// Moves the last joint on one branch to the least cost between the neighbors of a tested value.
    fn refine(
        &self,
        start: Candidate,
        range: std::ops::RangeInclusive<f64>,
        step: f64,
    ) -> Candidate {
        let branch = start.branch;
        let sides = Sides {
            elbow: &[branch.is_elbow_bent],
            wrist: &[branch.is_wrist_outward],
            shoulder: &[branch.is_shoulder_forward],
        };
        let mut bracket = Bracket {
            low: [(start.joints[6] - step).max(*range.start()), f64::INFINITY],
            best: [start.joints[6], start.cost],
            high: [(start.joints[6] + step).min(*range.end()), f64::INFINITY],
        };
        let mut best = start;
        for _ in 0..N_REFINEMENTS {
            let last_rad = bracket.next();
            let mut found = None;
            self.compare(last_rad, &sides, &mut found);
            // Values without a solution have an infinite cost.
            bracket.narrow([last_rad, found.map_or(f64::INFINITY, |found| found.cost)]);
            if let Some(found) = found
                && found.cost < best.cost
            {
                best = found;
            }
        }
        best
    }
}

/// Whether a cost is not less than the cost of the best solution so far.
fn is_worse(cost: f64, best: Option<&Candidate>) -> bool {
    best.is_some_and(|best| cost >= best.cost)
}

/// Sides that are compared.
struct Sides<'a> {
    elbow: &'a [bool],
    wrist: &'a [bool],
    shoulder: &'a [bool],
}

const BOTH: Sides<'static> = Sides {
    elbow: &[true, false],
    wrist: &[true, false],
    shoulder: &[true, false],
};

/// The joints from the elbow to the last joint, and their cost. The other joints are not set yet.
struct Outer {
    is_elbow_bent: bool,
    is_wrist_outward: bool,
    joints: [f64; 7],
    cost: f64,
}

/// Three values of the last joint in ascending order, each with its cost. The one in the middle has
/// the least cost.
struct Bracket {
    low: [f64; 2],
    best: [f64; 2],
    high: [f64; 2],
}

impl Bracket {
    /// The value to test next: the vertex of the parabola through the three costs, or a value in
    /// the wider interval if a cost is infinite (Brent 1973, chapter 5).
    fn next(&self) -> f64 {
        /// Part of an interval at which golden section search divides it.
        const GOLDEN: f64 = 0.381_966_011_250_105_1;
        let [low, best, high] = [self.low[0], self.best[0], self.high[0]];
        let [to_low, to_high] = [best - low, high - best];
        let [rise_low, rise_high] = [self.low[1] - self.best[1], self.high[1] - self.best[1]];
        let numerator = to_low * to_low * rise_high - to_high * to_high * rise_low;
        let denominator = to_low * rise_high + to_high * rise_low;
        let vertex = best - 0.5 * numerator / denominator;
        if low < vertex && vertex < high && vertex != best {
            return vertex;
        }
        if to_high > to_low {
            best + GOLDEN * to_high
        } else {
            best - GOLDEN * to_low
        }
    }

    /// Takes the cost of a value between the outer ones.
    fn narrow(&mut self, tested: [f64; 2]) {
        let outer = if tested[1] < self.best[1] {
            std::mem::replace(&mut self.best, tested)
        } else {
            tested
        };
        if outer[0] > self.best[0] {
            self.high = outer;
        } else {
            self.low = outer;
        }
    }
}
