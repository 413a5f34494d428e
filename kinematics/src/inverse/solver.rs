//! The solver: joint values for one pose.

use super::bounds::Bounds;
use super::comfort::Comfort;
use super::descent::{Descent, Effort, Problem, TOLERANCE};
use super::failure::{JointBeyond, Nearest, Unsolved};
use super::franka::FrankaArm;
use super::franka_search::FrankaSearch;
use super::least_squares::damped_change;
use super::target::Target;
use crate::{Chain, Error};
use nalgebra::Vector6;
use numbers::random::Random;

/// Maximum number of configurations from which a pose is searched. For the robots in `rigs/robots`,
/// all random reachable poses are found with fewer starts. For a pose that is out of reach, all
/// starts are used.
const MAX_STARTS: usize = 60;
/// Number of starts without joint ranges, after which a pose is considered out of reach.
const MAX_UNLIMITED_STARTS: usize = 12;
/// Seed of the starts. It is the same for each pose, so that the same pose has the same solution.
const START_SEED: u64 = 42;
/// Number of steps toward the preferred joint values of arms with redundant joints.
const MAX_COMFORT_STEPS: usize = 20;
/// Largest step of a joint toward the preferred values, radians or meters. The pose is corrected
/// after each step.
const MAX_COMFORT_CHANGE: f64 = 0.3;
/// Steps toward the preferred values end below this change of the cost.
const MIN_COMFORT_GAIN: f64 = 1e-4;
/// Damping of the projection to motions that keep the pose. It is above rounding errors.
const PROJECTION_DAMPING: f64 = 1e-9;

/// Inverse kinematics of one chain. Buffers are kept, so that solving allocates only the result.
#[derive(Clone, Debug)]
pub struct InverseSolver {
    pub(super) chain: Chain,
    pub(super) bounds: Bounds,
    pub(super) comfort: Comfort,
    pub(super) meters_per_rad: f64,
    franka: Option<FrankaArm>,
    unlimited: Bounds,
    descent: Descent,
    joints: Vec<f64>,
    best: Vec<f64>,
    /// Buffers of servo steps and of steps toward preferred values.
    pub(super) columns: Vec<Vector6<f64>>,
    pub(super) change: Vec<f64>,
    pub(super) is_held: Vec<bool>,
}

impl InverseSolver {
    /// A solver within the joint ranges of the URDF.
    ///
    /// # Errors
    /// Fails if a range contains no value.
    pub fn new(chain: Chain) -> Result<Self, Error> {
        let limits = chain.limits().iter();
        let ranges = limits.map(|limit| [limit.lower, limit.upper]).collect();
        Self::within(chain, ranges)
    }

    /// A solver within other ranges.
    ///
    /// * `ranges`: lower and upper end for each joint. The ends may be infinite.
    ///
    /// # Errors
    /// Fails if there is not one range per joint, or if a range contains no value.
    pub fn within(chain: Chain, ranges: Vec<[f64; 2]>) -> Result<Self, Error> {
        let n_joints = chain.n_joints();
        let bounds = Bounds::new(&chain, ranges)?;
        // The tip moves by about half the arm's length if a joint moves by one radian.
        let half_length_m = 0.5 * chain.length_m();
        Ok(Self {
            franka: FrankaArm::of(&chain),
            unlimited: bounds.unlimited(),
            bounds,
            comfort: Comfort::default(),
            meters_per_rad: if half_length_m > 0.0 {
                half_length_m
            } else {
                1.0
            },
            descent: Descent::new(n_joints),
            joints: vec![0.0; n_joints],
            best: vec![0.0; n_joints],
            columns: vec![Vector6::zeros(); n_joints],
            change: vec![0.0; n_joints],
            is_held: vec![false; n_joints],
            chain,
        })
    }

    /// Sets preferred joint values. Joints that a pose leaves free are moved toward them.
    ///
    /// # Errors
    /// Fails if there is not one finite value per joint.
    pub fn with_posture(mut self, posture: &[f64]) -> Result<Self, Error> {
        self.chain.check(posture)?;
        self.comfort.posture = posture.to_vec();
        Ok(self)
    }

    /// The chain.
    pub fn chain(&self) -> &Chain {
        &self.chain
    }

    /// The geometry for the closed form, if the chain is a Franka arm.
    pub fn franka_arm(&self) -> Option<&FrankaArm> {
        self.franka.as_ref()
    }

    /// Joint values within the ranges for which the tip has the pose of the target.
    ///
    /// For a Franka arm, the closed form gives a solution close to the seed. A search over the last
    /// joint minimizes a cost, which is the sum of the squared distance from the seed, the squared
    /// distance from the posture, and a cost near the ends of the ranges. Other arms are solved by
    /// descents, and so is a Franka arm if only a part of the orientation counts. The descents
    /// start from the seed, then from the posture, then from random configurations, and the first
    /// solution is used. Joints of this solution are moved by full turns toward the seed. Redundant
    /// joints are moved toward the posture and away from the ends of their ranges.
    ///
    /// # Errors
    /// [`Unsolved::Invalid`] if the seed does not have one finite value per joint, or the target is
    /// not finite. The other errors contain the nearest configuration that was found.
    pub fn solve(&mut self, target: &Target, seed: &[f64]) -> Result<Vec<f64>, Unsolved> {
        self.check(target, seed)?;
        if self.solve_in_closed_form(target, seed) {
            return Ok(self.joints.clone());
        }
        let mut random = Random::new(START_SEED);
        let mut least_error = f64::INFINITY;
        for start in 0..MAX_STARTS {
            self.place_start(start, seed, &mut random);
            let error = self.descend(target, Effort::SEARCH);
            if error < TOLERANCE {
                return Ok(self.finish(target, seed));
            }
            if error < least_error {
                least_error = error;
                self.best.copy_from_slice(&self.joints);
            }
        }
        // Descents end early if they are slow, so the best configuration may still improve.
        self.joints.copy_from_slice(&self.best);
        if self.descend(target, Effort::THOROUGH) < TOLERANCE {
            return Ok(self.finish(target, seed));
        }
        self.give_up(target, MAX_UNLIMITED_STARTS)
    }

    /// Joint values near the seed. The descent takes short steps from the seed, without other
    /// starts and without changes of branch. Poses that are reachable only by a detour are not
    /// found.
    ///
    /// # Errors
    /// The errors are the errors of [`InverseSolver::solve`]. The nearest configuration is the
    /// configuration at which the steps end.
    pub fn solve_near(&mut self, target: &Target, seed: &[f64]) -> Result<Vec<f64>, Unsolved> {
        self.check(target, seed)?;
        self.place_at(seed);
        if self.descend(target, Effort::NEAR) < TOLERANCE {
            return Ok(self.joints.clone());
        }
        self.give_up(target, 1)
    }

    fn check(&self, target: &Target, seed: &[f64]) -> Result<(), Error> {
        self.chain.check(seed)?;
        target.check()
    }

    /// Solves the pose in closed form, if this is possible, and stores the solution in `joints`.
    /// Returns whether there is a solution.
    fn solve_in_closed_form(&mut self, target: &Target, seed: &[f64]) -> bool {
        let Some(arm) = self.franka.as_ref().filter(|_| target.n_constraints() == 6) else {
            return false;
        };
        let search = FrankaSearch {
            arm,
            bounds: &self.bounds,
            comfort: &self.comfort,
            seed,
            seven: arm.frame_of_seven(&target.base_from_tip),
        };
        let Some(joints) = search.run() else {
            return false;
        };
        self.joints.copy_from_slice(&joints);
        // The descent ends at once if the pose is exact. A calibrated arm deviates from the ideal
        // geometry and needs two more steps.
        self.descend(target, Effort::NEAR) < TOLERANCE
    }

    /// Moves `joints` toward the target. Returns the remaining error.
    fn descend(&mut self, target: &Target, effort: Effort) -> f64 {
        let problem = Problem {
            chain: &self.chain,
            bounds: &self.bounds,
            target,
            meters_per_rad: self.meters_per_rad,
        };
        self.descent.run(problem, effort, &mut self.joints)
    }

    /// Sets `joints` to a start of the search.
    fn place_start(&mut self, start: usize, seed: &[f64], random: &mut Random) {
        match start {
            0 => self.place_at(seed),
            1 if !self.comfort.posture.is_empty() => {
                for (joint_ix, posture) in self.comfort.posture.iter().enumerate() {
                    self.joints[joint_ix] = self.bounds.clamp(joint_ix, *posture);
                }
            }
            _ => {
                for (joint_ix, value) in seed.iter().enumerate() {
                    let span_m = self.meters_per_rad;
                    let [lower, upper] = self.bounds.start_range(joint_ix, *value, span_m);
                    self.joints[joint_ix] = random.uniform(lower, upper);
                }
            }
        }
    }

    fn place_at(&mut self, seed: &[f64]) {
        for (joint_ix, value) in seed.iter().enumerate() {
            self.joints[joint_ix] = self.bounds.clamp(joint_ix, *value);
        }
    }

    /// Decreases the cost of the solution in `joints` as far as the pose allows.
    fn finish(&mut self, target: &Target, seed: &[f64]) -> Vec<f64> {
        for (joint_ix, seed) in seed.iter().enumerate() {
            let value = self.joints[joint_ix];
            let nearest = self.bounds.nearest_turn(joint_ix, value, *seed);
            self.joints[joint_ix] = nearest.unwrap_or(value);
        }
        if self.chain.n_joints() > target.n_constraints() {
            self.approach_comfort(target);
        }
        self.joints.clone()
    }

    /// Moves redundant joints toward the posture and away from the ends of their ranges. Each step
    /// is projected to motions that keep the pose, and the pose is then corrected.
    fn approach_comfort(&mut self, target: &Target) {
        let mut cost = self.comfort.cost(&self.bounds, &self.joints);
        for _ in 0..MAX_COMFORT_STEPS {
            self.best.copy_from_slice(&self.joints);
            self.step_to_comfort(target);
            let error = self.descend(target, Effort::NEAR);
            let next_cost = self.comfort.cost(&self.bounds, &self.joints);
            let is_better = error < TOLERANCE && next_cost < cost - MIN_COMFORT_GAIN;
            if !is_better {
                self.joints.copy_from_slice(&self.best);
                return;
            }
            cost = next_cost;
        }
    }

    /// One projected step: `g - J^+ J g`, where `g` are the changes that decrease the cost.
    fn step_to_comfort(&mut self, target: &Target) {
        let problem = Problem {
            chain: &self.chain,
            bounds: &self.bounds,
            target,
            meters_per_rad: self.meters_per_rad,
        };
        problem.linearize(&self.joints, &mut self.columns);
        let mut motion = Vector6::zeros();
        for (joint_ix, value) in self.joints.iter().enumerate() {
            let wanted = self.comfort.descent_of(&self.bounds, joint_ix, *value);
            let wanted = wanted.clamp(-MAX_COMFORT_CHANGE, MAX_COMFORT_CHANGE);
            motion += self.columns[joint_ix] * wanted;
        }
        damped_change(&self.columns, &motion, PROJECTION_DAMPING, &mut self.change);
        for (joint_ix, value) in self.joints.iter_mut().enumerate() {
            let wanted = self.comfort.descent_of(&self.bounds, joint_ix, *value);
            let wanted = wanted.clamp(-MAX_COMFORT_CHANGE, MAX_COMFORT_CHANGE);
            let moved = *value + wanted - self.change[joint_ix];
            *value = self.bounds.clamp(joint_ix, moved);
        }
    }

    /// The reason why the target was not reached. To distinguish a pose beyond the joint ranges
    /// from a pose that is out of reach, the target is searched again without ranges. When this
    /// function is called, `joints` contains the nearest configuration.
    ///
    /// * `n_starts`: number of configurations from which the target is searched.
    ///
    /// # Errors
    /// Returns an error unless full turns move all joints into their ranges.
    fn give_up(&mut self, target: &Target, n_starts: usize) -> Result<Vec<f64>, Unsolved> {
        let nearest = self.nearest(target);
        std::mem::swap(&mut self.bounds, &mut self.unlimited);
        let mut random = Random::new(START_SEED);
        let is_reached = (0..n_starts).any(|start| {
            self.place_start(start, &nearest.joints, &mut random);
            self.descend(target, Effort::SEARCH) < TOLERANCE
        });
        std::mem::swap(&mut self.bounds, &mut self.unlimited);
        if !is_reached {
            return Err(Unsolved::OutOfReach(nearest));
        }
        let joints = self.turn_into_ranges(&nearest.joints);
        if joints.is_empty() {
            return Ok(self.joints.clone());
        }
        Err(Unsolved::BeyondLimits { nearest, joints })
    }

    /// The configuration in `joints` and its distance from the target.
    fn nearest(&self, target: &Target) -> Nearest {
        let base_from_tip = self
            .chain
            .forward(&self.joints)
            .expect("the steps are finite and have one value per joint");
        Nearest {
            joints: self.joints.clone(),
            gap: target.gap(&base_from_tip),
        }
    }

    /// Moves `joints` by full turns into their ranges. Returns the joints that no full turn moves
    /// into their ranges.
    fn turn_into_ranges(&mut self, references: &[f64]) -> Vec<JointBeyond> {
        let mut beyond = Vec::new();
        for (joint_ix, value) in self.joints.iter_mut().enumerate() {
            match self
                .bounds
                .nearest_turn(joint_ix, *value, references[joint_ix])
            {
                Some(turned) => *value = turned,
                None => beyond.push(JointBeyond {
                    joint: self.chain.joint_names()[joint_ix].clone(),
                    value: *value,
                    range: self.bounds.range(joint_ix),
                }),
            }
        }
        beyond
    }
}
