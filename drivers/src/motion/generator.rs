//! Generates setpoints towards a target from any state of motion, with limited velocity,
//! acceleration and jerk.
//!
//! Source: Berscheid and Kröger 2021, "Jerk-limited Real-time Trajectory Generation with Arbitrary
//! Target States", as implemented in the crate `rsruckig`.

use super::{JointTarget, MotionLimits};
use rsruckig::prelude::{
    ControlInterface, DataArrayOrVec, InputParameter, OutputParameter, Ruckig, RuckigError,
    RuckigResult, Synchronization, ThrowErrorHandler,
};
use std::time::Duration;

/// Maximum distance by which a joint may be outside its range, radians or meters. Causes are
/// backlash, an encoder offset, or a motion that continued without commands and is too fast to stop
/// before the end of the range.
///
/// With a smaller value, an arm with such a joint could not be enabled, or would stop with an
/// error. A larger value permits motions closer to the mechanical stops beyond the range.
const MAX_OVERSHOOT: f64 = 0.02;

/// Fractions by which the jerk is reduced if no trajectory is found with the full jerk. The
/// smallest reduction comes first, because it changes the motion least. A reduction is sufficient
/// if it exceeds the rounding errors that prevent the trajectory from being found.
const JERK_REDUCTIONS: [f64; 3] = [1e-6, 1e-4, 1e-2];

/// Setpoint of all joints at an instant, in the order of the joints. Units are radians or meters,
/// and seconds.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Setpoint {
    /// Positions.
    pub position: Vec<f64>,
    /// Velocities.
    pub velocity: Vec<f64>,
    /// Accelerations.
    pub acceleration: Vec<f64>,
}

impl Setpoint {
    /// Rest at a position.
    pub fn at_rest(position: Vec<f64>) -> Self {
        let zero = vec![0.0; position.len()];
        Self {
            position,
            velocity: zero.clone(),
            acceleration: zero,
        }
    }
}

/// Generates one setpoint per cycle. All joints arrive at the same time.
pub struct TrajectoryGenerator {
    ruckig: Ruckig<0, ThrowErrorHandler>,
    input: InputParameter<0>,
    output: OutputParameter<0>,
    limits: Vec<MotionLimits>,
    is_at_rest: bool,
}

impl std::fmt::Debug for TrajectoryGenerator {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TrajectoryGenerator")
            .field("limits", &self.limits)
            .field("is_at_rest", &self.is_at_rest)
            .finish_non_exhaustive()
    }
}

impl TrajectoryGenerator {
    /// Creates a generator at rest at `position`. A joint slightly outside its range may stay there
    /// and come back.
    ///
    /// # Errors
    /// If a joint is far outside its range, a limit is not positive and finite, or the number of
    /// positions is wrong.
    pub fn new(
        limits: &[MotionLimits],
        position: &[f64],
        period: Duration,
    ) -> Result<Self, String> {
        let n = limits.len();
        check(position, n)?;
        // The library checks limits only when it plans. Checking them here names the joint, before
        // the motors are enabled.
        let mut limits = limits.to_vec();
        for (ix, (joint, position)) in limits.iter_mut().zip(position).enumerate() {
            let [lower, upper] = joint.position;
            if !(lower - MAX_OVERSHOOT..=upper + MAX_OVERSHOOT).contains(position) {
                return Err(format!(
                    "joint {} is at {position:.4}, outside its range of {lower:.4} to {upper:.4}",
                    ix + 1
                ));
            }
            // The comparison is written so that NaN fails.
            if [joint.velocity, joint.acceleration, joint.jerk]
                .iter()
                .any(|limit| !limit.is_finite() || *limit <= 0.0)
            {
                return Err(format!(
                    "the limits of joint {} must be positive and finite: {joint:?}",
                    ix + 1
                ));
            }
            // A joint that starts outside its range may stay there, so the range is widened to the
            // joint's position. The range is never widened further.
            joint.position = [lower.min(*position), upper.max(*position)];
        }
        let each = |of: fn(&MotionLimits) -> f64| data_array(limits.iter().map(of));
        let mut input = InputParameter::new(Some(n));
        input.current_position = data_array(position.iter().copied());
        // Without a target, the first setpoints hold this position.
        input.target_position = data_array(position.iter().copied());
        input.max_velocity = each(|joint| joint.velocity);
        input.max_acceleration = each(|joint| joint.acceleration);
        input.max_jerk = each(|joint| joint.jerk);
        let ruckig = Ruckig::new(Some(n), period.as_secs_f64());
        Ok(Self {
            ruckig,
            input,
            output: OutputParameter::new(Some(n)),
            limits,
            is_at_rest: true,
        })
    }

    /// Sets a target, clamped to the joints' ranges, and returns the clamped target. A target that
    /// is not finite or has the wrong number of joints is an error and changes nothing.
    pub fn set_target(&mut self, target: &JointTarget) -> Result<JointTarget, String> {
        check(&target.position, self.limits.len())?;
        let clamp_to_range = |(position, joint): (&f64, &MotionLimits)| {
            position.clamp(joint.position[0], joint.position[1])
        };
        let position: Vec<f64> = target
            .position
            .iter()
            .zip(&self.limits)
            .map(clamp_to_range)
            .collect();
        // An earlier stop may have changed the control interface and the synchronization.
        self.input.control_interface = ControlInterface::Position;
        self.input.synchronization = Synchronization::Time;
        self.input.target_position = data_array(position.iter().copied());
        // An earlier trajectory may have been allowed to overshoot. The new one must stay
        // inside the ranges again, if possible.
        self.keep_in_range();
        self.is_at_rest = false;
        Ok(JointTarget { position })
    }

    /// Stops each joint as soon as its limits allow, independently of the others.
    pub fn stop(&mut self) {
        if !self.is_at_rest {
            // In velocity control, the target is velocity 0 at any position. Without
            // synchronization, no joint waits for the slowest one, so each moves as little as
            // possible.
            self.input.control_interface = ControlInterface::Velocity;
            self.input.synchronization = Synchronization::None;
            self.forget_ranges();
        }
    }

    /// Continues towards the target from a different state of motion. Use it if the reference of
    /// the arm differs from the last setpoint.
    pub fn resume(&mut self, from: &Setpoint) -> Result<(), String> {
        for values in [&from.position, &from.velocity, &from.acceleration] {
            check(values, self.limits.len())?;
        }
        self.input.current_position = data_array(from.position.iter().copied());
        self.input.current_velocity = data_array(from.velocity.iter().copied());
        self.input.current_acceleration = data_array(from.acceleration.iter().copied());
        // An earlier trajectory may have been allowed to overshoot. The new one must stay
        // inside the ranges again, if possible. A stop needs no ranges.
        if self.input.control_interface == ControlInterface::Position {
            self.keep_in_range();
        }
        self.is_at_rest = false;
        Ok(())
    }

    /// Plans stops without ranges. A stop is the shortest way to rest, wherever it ends.
    ///
    /// With ranges, `rsruckig` 3.0.1 also checks the target position of an earlier trajectory in
    /// velocity control. It is 0 in a new generator. For a joint whose range does not contain 0,
    /// such as joint 4 of a Panda, it then replaces the plan with one of unlimited jerk
    /// (`repair_profile_step2`, and `time_none` of `velocity_third_step2.rs`).
    fn forget_ranges(&mut self) {
        self.input.min_position = None;
        self.input.max_position = None;
    }

    /// Keeps future trajectories within the ranges.
    fn keep_in_range(&mut self) {
        self.input.min_position = Some(data_array(
            self.limits.iter().map(|joint| joint.position[0]),
        ));
        self.input.max_position = Some(data_array(
            self.limits.iter().map(|joint| joint.position[1]),
        ));
    }

    /// Whether the joints are at rest at the end of their trajectory.
    pub fn is_at_rest(&self) -> bool {
        self.is_at_rest
    }

    /// Tries a step with slightly reduced jerk. `rsruckig` finds no trajectory if a joint reaches
    /// its full acceleration for zero time, which happens for some round distances.
    fn update_with_less_jerk(&mut self) -> Option<RuckigResult> {
        // Restoring the full jerk makes the next step plan again with it, so the reduction lasts
        // only as long as it is needed.
        let full = self.input.max_jerk.clone();
        let result = JERK_REDUCTIONS.iter().find_map(|reduction| {
            self.input.max_jerk = data_array(full.iter().map(|jerk| jerk * (1.0 - reduction)));
            self.ruckig.update(&self.input, &mut self.output).ok()
        });
        self.input.max_jerk = full;
        result
    }

    /// Tries a trajectory that leaves the ranges slightly and comes back. This function is called
    /// if no trajectory stays inside the ranges. Returns `None` if no such trajectory exists
    /// either. A stop is as short as possible, wherever it ends.
    fn update_with_overshoot(&mut self) -> Option<RuckigResult> {
        let position_bounds = (
            self.input.min_position.take(),
            self.input.max_position.take(),
        );
        let result = self.ruckig.update(&self.input, &mut self.output);
        // Without bounds, the trajectory may go anywhere, so its extrema are checked before it is
        // used.
        let extrema = self.output.trajectory.get_position_extrema();
        let is_within_tolerance =
            self.limits
                .iter()
                .zip(extrema.iter())
                .all(|(joint, trajectory)| {
                    let [lower, upper] = joint.position;
                    trajectory.min >= lower - MAX_OVERSHOOT
                        && trajectory.max <= upper + MAX_OVERSHOOT
                });
        // A stop is accepted wherever it ends, because it is the shortest way to rest. An error
        // here would end the control of a moving arm.
        let is_stop = self.input.control_interface == ControlInterface::Velocity;
        match result {
            Ok(result) if is_within_tolerance || is_stop => Some(result),
            // The bounds are restored, so that the next target is planned with them.
            _ => {
                (self.input.min_position, self.input.max_position) = position_bounds;
                None
            }
        }
    }

    /// Describes why no trajectory was found. `rsruckig` names only the number of the joint and
    /// repeats the input.
    fn describe(&self, error: &RuckigError) -> String {
        let message = error.to_string();
        let number = message
            .split("dof: ")
            .nth(1)
            .and_then(|rest| rest.split_whitespace().next()?.parse::<usize>().ok());
        let Some((ix, joint)) = number.and_then(|ix| Some((ix, self.limits.get(ix)?))) else {
            return format!(
                "found no trajectory to the target: {}",
                message.lines().next().unwrap_or_default()
            );
        };
        let [lower, upper] = joint.position;
        let input = &self.input;
        let [position, velocity, target] = [
            &input.current_position,
            &input.current_velocity,
            &input.target_position,
        ]
        .map(|joints| joints[ix]);
        format!(
            "found no trajectory to the target: joint {} is at {position:.4} with a velocity of {velocity:.4} per second; it must \
             reach {target:.4} and stay within {lower:.4} to {upper:.4}",
            ix + 1
        )
    }

    /// Returns the setpoint of the next cycle.
    pub fn step(&mut self) -> Result<Setpoint, String> {
        if !self.is_at_rest {
            let result = match self.ruckig.update(&self.input, &mut self.output) {
                // The first attempt uses the full limits. The second attempt uses a slightly
                // reduced jerk. The third attempt may leave the range for a moment.
                Err(error) => self
                    .update_with_less_jerk()
                    .or_else(|| self.update_with_overshoot())
                    .ok_or_else(|| self.describe(&error))?,
                Ok(result) => result,
            };
            // The setpoint is the start of the next step. The trajectory is planned again only if
            // the input has changed.
            self.output.pass_to_input(&mut self.input);
            if result == RuckigResult::Finished {
                self.is_at_rest = true;
                // The end is reached except for a rounding error, so the remaining motion is set to
                // zero.
                self.input.current_velocity = data_array(self.limits.iter().map(|_| 0.0));
                self.input.current_acceleration = data_array(self.limits.iter().map(|_| 0.0));
            }
        }
        let values = |data_array: &DataArrayOrVec<f64, 0>| data_array.iter().copied().collect();
        Ok(Setpoint {
            position: values(&self.input.current_position),
            velocity: values(&self.input.current_velocity),
            acceleration: values(&self.input.current_acceleration),
        })
    }
}

/// Checks that there is one finite number per joint.
fn check(position: &[f64], n: usize) -> Result<(), String> {
    if position.len() != n {
        return Err(format!(
            "{} positions are given for {n} joints",
            position.len()
        ));
    }
    match position.iter().position(|position| !position.is_finite()) {
        Some(ix) => Err(format!(
            "the position of joint {} is not a finite number: {}",
            ix + 1,
            position[ix]
        )),
        None => Ok(()),
    }
}

fn data_array(values: impl Iterator<Item = f64>) -> DataArrayOrVec<f64, 0> {
    DataArrayOrVec::Heap(values.collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use numbers::random::Random;

    const PERIOD: Duration = Duration::from_millis(1);

    fn limits() -> Vec<MotionLimits> {
        let joint = |position, velocity| MotionLimits {
            position,
            velocity,
            acceleration: 2.0,
            jerk: 20.0,
        };
        vec![
            joint([-1.0, 1.0], 0.5),
            joint([f64::NEG_INFINITY, f64::INFINITY], 0.3),
        ]
    }

    fn generator_at_rest() -> TrajectoryGenerator {
        TrajectoryGenerator::new(&limits(), &[0.0, 0.2], PERIOD).unwrap()
    }

    /// Steps until the joints are at rest, and checks every limit by differences between cycles.
    fn run_until_at_rest(generator: &mut TrajectoryGenerator) -> Vec<Setpoint> {
        let secs = PERIOD.as_secs_f64();
        let mut trajectory = vec![generator.step().unwrap()];
        while !generator.is_at_rest() {
            trajectory.push(generator.step().unwrap());
            assert!(trajectory.len() < 20_000, "it does not arrive");
        }
        for pair in trajectory.windows(2) {
            for (ix, joint) in limits().iter().enumerate() {
                let speed = (pair[1].position[ix] - pair[0].position[ix]) / secs;
                let acceleration = (pair[1].velocity[ix] - pair[0].velocity[ix]) / secs;
                let jerk = (pair[1].acceleration[ix] - pair[0].acceleration[ix]) / secs;
                assert!(speed.abs() <= joint.velocity * 1.0001, "{speed}");
                assert!(
                    acceleration.abs() <= joint.acceleration * 1.0001,
                    "{acceleration}"
                );
                assert!(jerk.abs() <= joint.jerk * 1.0001, "{jerk}");
                assert!((joint.position[0]..=joint.position[1]).contains(&pair[1].position[ix]));
            }
        }
        trajectory
    }

    #[test]
    fn all_joints_arrive_together_within_their_limits() {
        let mut generator = generator_at_rest();
        let target = JointTarget {
            position: vec![0.9, -0.1],
        };
        assert_eq!(generator.set_target(&target).unwrap(), target);
        let trajectory = run_until_at_rest(&mut generator);
        let last = trajectory.last().unwrap();
        assert!(
            last.position
                .iter()
                .zip(&target.position)
                .all(|(got, expected)| (got - expected).abs() < 1e-9)
        );
        assert_eq!(last.velocity, [0.0, 0.0]);
        let before = &trajectory[trajectory.len() - 20];
        assert!(
            (0..2).all(|ix| (before.position[ix] - target.position[ix]).abs() > 1e-9),
            "both joints are still moving"
        );
    }

    #[test]
    fn new_target_while_moving_and_stop_respect_limits() {
        let mut generator = generator_at_rest();
        generator
            .set_target(&JointTarget {
                position: vec![0.9, -5.0],
            })
            .unwrap();
        for _ in 0..300 {
            generator.step().unwrap();
        }
        generator
            .set_target(&JointTarget {
                position: vec![-0.9, 5.0],
            })
            .unwrap();
        for _ in 0..400 {
            generator.step().unwrap();
        }
        generator.stop();
        let trajectory = run_until_at_rest(&mut generator);
        let last = trajectory.last().unwrap();
        assert_eq!(last.velocity, [0.0, 0.0]);
        assert!(last.position[0] > -0.9, "it stopped before its target");
        assert_eq!(generator.step().unwrap(), *last, "it stays at rest");
    }

    #[test]
    fn joints_stop_independently() {
        let joint = |jerk| MotionLimits {
            position: [-1.0, 1.0],
            velocity: 0.5,
            acceleration: 2.0,
            jerk,
        };
        let mut generator =
            TrajectoryGenerator::new(&[joint(20.0), joint(2.0)], &[0.0, 0.0], PERIOD).unwrap();
        generator
            .set_target(&JointTarget {
                position: vec![0.3, 0.9],
            })
            .unwrap();
        for _ in 0..1000 {
            generator.step().unwrap();
        }
        generator.stop();
        let mut n_moving = [0, 0];
        while !generator.is_at_rest() {
            let velocity = generator.step().unwrap().velocity;
            n_moving =
                std::array::from_fn(|ix| n_moving[ix] + u32::from(velocity[ix].abs() > 1e-9));
        }
        assert!(
            n_moving[0] > 10 && 2 * n_moving[0] < n_moving[1],
            "{n_moving:?}"
        );
    }

    #[test]
    fn resume_from_measured_state_respects_limits() {
        let mut generator = generator_at_rest();
        let target = JointTarget {
            position: vec![0.9, -0.1],
        };
        generator.set_target(&target).unwrap();
        for _ in 0..300 {
            generator.step().unwrap();
        }
        let measured = Setpoint {
            position: vec![0.2, 0.1],
            velocity: vec![0.3, -0.2],
            acceleration: vec![1.0, 0.5],
        };
        generator.resume(&measured).unwrap();
        let trajectory = run_until_at_rest(&mut generator);
        assert!(
            (trajectory[0].position[0] - 0.2003).abs() < 1e-5,
            "{:?}",
            trajectory[0]
        );
        assert!(
            (trajectory[trajectory.len() - 1].position[0] - 0.9).abs() < 1e-9,
            "it still moves to its target"
        );
        let too_short = Setpoint {
            velocity: vec![0.0],
            ..measured
        };
        assert!(generator.resume(&too_short).unwrap_err().contains("1 "));
    }

    #[test]
    fn too_fast_joint_overshoots_range_and_returns() {
        let mut generator = generator_at_rest();
        generator
            .set_target(&JointTarget {
                position: vec![2.0, 0.2],
            })
            .unwrap();
        let setpoint_at = |position| Setpoint {
            position: vec![position, 0.2],
            velocity: vec![0.4, 0.0],
            acceleration: vec![-2.0, 0.0],
        };
        // From 0.4 rad/s it takes 0.045 rad to stop.
        generator.resume(&setpoint_at(0.965)).unwrap();
        let mut trajectory = vec![setpoint_at(0.965)];
        while !generator.is_at_rest() {
            trajectory.push(generator.step().unwrap());
        }
        let farthest = trajectory
            .iter()
            .map(|setpoint| setpoint.position[0])
            .fold(0.0, f64::max);
        assert!(farthest > 1.005 && farthest < 1.015, "{farthest}");
        assert!((trajectory[trajectory.len() - 1].position[0] - 1.0).abs() < 1e-9);
        assert!(
            trajectory
                .iter()
                .all(|setpoint| setpoint.acceleration[0].abs() < 2.0001)
        );
        generator.resume(&setpoint_at(0.999)).unwrap();
        let error = generator.step().unwrap_err();
        assert!(
            error.contains("no trajectory")
                && error.contains("joint 1 is at 0.9990 with a velocity of 0.4000"),
            "it would overshoot too far: {error}"
        );
        generator.stop();
        while !generator.is_at_rest() {
            generator.step().unwrap();
        }
    }

    #[test]
    fn degenerate_acceleration_phase_is_planned() {
        for (velocity, start) in [(0.5, -1.3), (0.2, 0.07), (0.1, 0.0), (1.0, 0.4)] {
            let (acceleration, jerk) = (velocity / 0.5, velocity / 0.5 / 0.1);
            let joint = MotionLimits {
                position: [-2.0, 2.0],
                velocity,
                acceleration,
                jerk,
            };
            for sign in [1.0, -1.0] {
                let target = start + sign * 2.0 * acceleration.powi(3) / jerk.powi(2);
                let mut generator =
                    TrajectoryGenerator::new(&[joint, joint], &[start, 0.3], PERIOD).unwrap();
                generator
                    .set_target(&JointTarget {
                        position: vec![target, 0.3],
                    })
                    .unwrap();
                let mut trajectory = vec![generator.step().unwrap()];
                while !generator.is_at_rest() {
                    trajectory.push(generator.step().unwrap());
                    let [.., before, now] = &trajectory[..] else {
                        continue;
                    };
                    let jerk_now =
                        (now.acceleration[0] - before.acceleration[0]) / PERIOD.as_secs_f64();
                    assert!(
                        jerk_now.abs() <= jerk * 1.0001
                            && now.acceleration[0].abs() <= acceleration * 1.0001
                    );
                }
                // The limit is four times the time to reach full acceleration.
                assert!(
                    (trajectory.len() as f64 - 400.0).abs() < 3.0,
                    "{}",
                    trajectory.len()
                );
                assert!((trajectory[trajectory.len() - 1].position[0] - target).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn targets_are_clamped_and_invalid_ones_rejected() {
        let mut generator = generator_at_rest();
        let accepted = generator
            .set_target(&JointTarget {
                position: vec![3.0, 7.0],
            })
            .unwrap();
        assert_eq!(accepted.position, [1.0, 7.0]);
        let before = generator.step().unwrap();
        assert!(
            generator
                .set_target(&JointTarget {
                    position: vec![0.0]
                })
                .unwrap_err()
                .contains("1 positions")
        );
        assert!(
            generator
                .set_target(&JointTarget {
                    position: vec![f64::NAN, 0.0]
                })
                .unwrap_err()
                .contains("joint 1")
        );
        assert!(
            generator.step().unwrap().position[1] > before.position[1],
            "it still moves to its previous target"
        );
    }

    #[test]
    fn start_slightly_outside_range_is_allowed() {
        let mut generator = TrajectoryGenerator::new(&limits(), &[1.01, 0.0], PERIOD).unwrap();
        generator
            .set_target(&JointTarget {
                position: vec![0.5, 0.0],
            })
            .unwrap();
        while !generator.is_at_rest() {
            generator.step().unwrap();
        }
        assert!(
            TrajectoryGenerator::new(&limits(), &[1.5, 0.0], PERIOD)
                .unwrap_err()
                .contains("joint 1 is at 1.5")
        );
    }
    /// Joint 4 of a Panda, whose range does not contain 0.
    fn panda_joint_4() -> MotionLimits {
        MotionLimits {
            position: [-3.0718, -0.0698],
            velocity: 1.0,
            acceleration: 2.0,
            jerk: 20.0,
        }
    }

    /// Invariant: acceleration and jerk change within the limits of `joint` in one cycle.
    fn check_cycle(before: &Setpoint, after: &Setpoint, joint: &MotionLimits, period: Duration) {
        let secs = period.as_secs_f64();
        let jerk = (after.acceleration[0] - before.acceleration[0]) / secs;
        let acceleration = (after.velocity[0] - before.velocity[0]) / secs;
        assert!(
            jerk.abs() <= joint.jerk * 1.0001 && acceleration.abs() <= joint.acceleration * 1.0001,
            "{jerk} {acceleration}: {before:?} {after:?}"
        );
    }

    /// Stops a joint whose range does not contain 0 in many states of motion.
    ///
    /// * `replan`: changes the generator before the stop.
    fn check_stops(replan: impl Fn(&mut TrajectoryGenerator, &Setpoint)) {
        const N_STOPS: u32 = 2000;
        let joint = panda_joint_4();
        // The states of the steering tests, in which a brake once had more than twice its jerk.
        for period in [Duration::from_millis(10), PERIOD] {
            let mut random = Random::new(5);
            let mut generator = TrajectoryGenerator::new(&[joint], &[-2.2], period).unwrap();
            let mut last = generator.step().unwrap();
            for _ in 0..N_STOPS {
                let position = vec![random.uniform(-3.0, -0.1)];
                generator.set_target(&JointTarget { position }).unwrap();
                for _ in 0..5 + random.below(30) {
                    let next = generator.step().unwrap();
                    check_cycle(&last, &next, &joint, period);
                    last = next;
                }
                replan(&mut generator, &last);
                generator.stop();
                let n_cycles = random.below(40);
                for _ in 0..n_cycles {
                    let next = generator.step().unwrap();
                    check_cycle(&last, &next, &joint, period);
                    last = next;
                }
                // A stop continues from the state that the arm reports.
                replan(&mut generator, &last);
                while !generator.is_at_rest() {
                    let next = generator.step().unwrap();
                    check_cycle(&last, &next, &joint, period);
                    last = next;
                }
            }
        }
    }

    #[test]
    fn stop_of_a_joint_whose_range_does_not_contain_zero_respects_limits() {
        check_stops(|_, _| {});
    }

    #[test]
    fn resumed_stop_of_a_joint_whose_range_does_not_contain_zero_respects_limits() {
        check_stops(|generator, last| generator.resume(last).unwrap());
    }

    #[test]
    fn first_motion_of_a_generator_that_is_a_stop_respects_limits() {
        let joint = panda_joint_4();
        let mut random = Random::new(6);
        for _ in 0..2000 {
            let start = Setpoint {
                position: vec![random.uniform(-2.8, -0.3)],
                velocity: vec![random.uniform(-0.5, 0.5)],
                acceleration: vec![random.uniform(-2.0, 2.0)],
            };
            let mut generator =
                TrajectoryGenerator::new(&[joint], &start.position, PERIOD).unwrap();
            generator.resume(&start).unwrap();
            generator.stop();
            let mut last = start;
            while !generator.is_at_rest() {
                let next = generator.step().unwrap();
                check_cycle(&last, &next, &joint, PERIOD);
                last = next;
            }
        }
    }
}
