//! Setpoints on the way to a target, from any motion, limited in speed, acceleration and jerk.
//!
//! Source: Berscheid and Kröger 2021, "Jerk-limited Real-time Trajectory Generation with Arbitrary Target States"; the maths is that
//! of the crate `rsruckig`.

use super::{JointTarget, MotionLimits};
use rsruckig::prelude::{
    ControlInterface, DataArrayOrVec, InputParameter, OutputParameter, Ruckig, RuckigError, RuckigResult,
    Synchronization, ThrowErrorHandler,
};
use std::time::Duration;

/// How far outside its range a joint may be found, radians or metres: by play, by an encoder's offset, or by a motion that went on
/// without us and is too fast to stop before the end of the range.
const MAX_OUTSIDE: f64 = 0.02;

/// Shares of jerk that are tried to be done without where no way is found with all of it.
const SOFTER: [f64; 3] = [1e-6, 1e-4, 1e-2];

/// Where joints are to be at an instant, in their order; radians or metres, and seconds.
#[derive(Clone, Debug, PartialEq)]
pub struct Setpoint {
    /// Positions.
    pub position: Vec<f64>,
    /// Velocities.
    pub velocity: Vec<f64>,
    /// Accelerations.
    pub acceleration: Vec<f64>,
}

/// Makes a setpoint a cycle. All joints arrive at the same time.
pub struct Generator {
    ruckig: Ruckig<0, ThrowErrorHandler>,
    input: InputParameter<0>,
    output: OutputParameter<0>,
    limits: Vec<MotionLimits>,
    is_held: bool,
}

impl std::fmt::Debug for Generator {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Generator")
            .field("limits", &self.limits)
            .field("is_held", &self.is_held)
            .finish_non_exhaustive()
    }
}

impl Generator {
    /// At rest at `position`; a joint a little outside its range may stay there and come back.
    ///
    /// A joint far outside its range, a limit that is not above 0 and finite, and numbers of other arms are told as reasons.
    pub fn new(limits: &[MotionLimits], position: &[f64], period: Duration) -> Result<Self, String> {
        let n = limits.len();
        check(position, n)?;
        let mut limits = limits.to_vec();
        for (ix, (joint, position)) in limits.iter_mut().zip(position).enumerate() {
            let [lower, upper] = joint.position;
            if !(lower - MAX_OUTSIDE..=upper + MAX_OUTSIDE).contains(position) {
                return Err(format!(
                    "joint {} is at {position:.4}, outside its range of {lower:.4} to {upper:.4}",
                    ix + 1
                ));
            }
            if [joint.velocity, joint.acceleration, joint.jerk].iter().any(|limit| !limit.is_finite() || *limit <= 0.0)
            {
                return Err(format!("the limits of joint {} are not all above 0 and finite: {joint:?}", ix + 1));
            }
            joint.position = [lower.min(*position), upper.max(*position)];
        }
        let each = |of: fn(&MotionLimits) -> f64| list(limits.iter().map(of));
        let mut input = InputParameter::new(Some(n));
        input.current_position = list(position.iter().copied());
        input.target_position = list(position.iter().copied());
        input.max_velocity = each(|joint| joint.velocity);
        input.max_acceleration = each(|joint| joint.acceleration);
        input.max_jerk = each(|joint| joint.jerk);
        let ruckig = Ruckig::new(Some(n), period.as_secs_f64());
        Ok(Self { ruckig, input, output: OutputParameter::new(Some(n)), limits, is_held: true })
    }

    /// Heads for a target, brought into the joints' ranges, which is returned; one of another arm or not of numbers changes nothing.
    pub fn head_for(&mut self, target: &JointTarget) -> Result<JointTarget, String> {
        check(&target.position, self.limits.len())?;
        let into_range =
            |(position, joint): (&f64, &MotionLimits)| position.clamp(joint.position[0], joint.position[1]);
        let position: Vec<f64> = target.position.iter().zip(&self.limits).map(into_range).collect();
        self.input.control_interface = ControlInterface::Position;
        self.input.synchronization = Synchronization::Time;
        self.input.target_position = list(position.iter().copied());
        self.keep_in_range();
        self.is_held = false;
        Ok(JointTarget { position })
    }

    /// Each joint comes to rest as soon as its limits allow, whatever the others do.
    pub fn stop(&mut self) {
        if !self.is_held {
            self.input.control_interface = ControlInterface::Velocity;
            self.input.synchronization = Synchronization::None;
        }
    }

    /// Goes on from another motion than its own towards where it was headed for: where the arm was found to be wanted elsewhere.
    pub fn resume(&mut self, from: &Setpoint) -> Result<(), String> {
        for numbers in [&from.position, &from.velocity, &from.acceleration] {
            check(numbers, self.limits.len())?;
        }
        self.input.current_position = list(from.position.iter().copied());
        self.input.current_velocity = list(from.velocity.iter().copied());
        self.input.current_acceleration = list(from.acceleration.iter().copied());
        self.keep_in_range();
        self.is_held = false;
        Ok(())
    }

    /// The ways from here on stay in the ranges.
    fn keep_in_range(&mut self) {
        self.input.min_position = Some(list(self.limits.iter().map(|joint| joint.position[0])));
        self.input.max_position = Some(list(self.limits.iter().map(|joint| joint.position[1])));
    }

    /// Whether it is at rest where it was headed for.
    pub fn is_held(&self) -> bool {
        self.is_held
    }

    /// A step on a way with a little less jerk: `rsruckig` finds none where a joint comes to its full acceleration for no time at all,
    /// as it does for some round distances.
    fn softer(&mut self) -> Option<RuckigResult> {
        let full = self.input.max_jerk.clone();
        let result = SOFTER.iter().find_map(|less| {
            self.input.max_jerk = list(full.iter().map(|jerk| jerk * (1.0 - less)));
            self.ruckig.update(&self.input, &mut self.output).ok()
        });
        self.input.max_jerk = full;
        result
    }

    /// A step on a way that leaves the ranges a little and comes back, where none stays inside; `None` where that is no help.
    /// A stop is as short as it can be, wherever it ends.
    fn overshoot(&mut self) -> Option<RuckigResult> {
        let ends = (self.input.min_position.take(), self.input.max_position.take());
        let result = self.ruckig.update(&self.input, &mut self.output);
        let extrema = self.output.trajectory.get_position_extrema();
        let is_near = self.limits.iter().zip(extrema.iter()).all(|(joint, way)| {
            let [lower, upper] = joint.position;
            way.min >= lower - MAX_OUTSIDE && way.max <= upper + MAX_OUTSIDE
        });
        let is_stop = self.input.control_interface == ControlInterface::Velocity;
        match result {
            Ok(result) if is_near || is_stop => Some(result),
            _ => {
                (self.input.min_position, self.input.max_position) = ends;
                None
            }
        }
    }

    /// Where the joints are to be a cycle later.
    pub fn step(&mut self) -> Result<Setpoint, String> {
        if !self.is_held {
            let result = match self.ruckig.update(&self.input, &mut self.output) {
                Err(why) => self.softer().or_else(|| self.overshoot()).ok_or_else(|| told(&why))?,
                Ok(result) => result,
            };
            self.output.pass_to_input(&mut self.input);
            if result == RuckigResult::Finished {
                self.is_held = true;
                // The end of a way is met to within a rounding error, and no motion is left.
                self.input.current_velocity = list(self.limits.iter().map(|_| 0.0));
                self.input.current_acceleration = list(self.limits.iter().map(|_| 0.0));
            }
        }
        let numbers = |list: &DataArrayOrVec<f64, 0>| list.iter().copied().collect();
        Ok(Setpoint {
            position: numbers(&self.input.current_position),
            velocity: numbers(&self.input.current_velocity),
            acceleration: numbers(&self.input.current_acceleration),
        })
    }
}

/// One number a joint, all of them numbers.
fn check(position: &[f64], n: usize) -> Result<(), String> {
    if position.len() != n {
        return Err(format!("{} positions are given for {n} joints", position.len()));
    }
    match position.iter().position(|position| !position.is_finite()) {
        Some(ix) => Err(format!("the position of joint {} is no number: {}", ix + 1, position[ix])),
        None => Ok(()),
    }
}

fn list(numbers: impl Iterator<Item = f64>) -> DataArrayOrVec<f64, 0> {
    DataArrayOrVec::Heap(numbers.collect())
}

fn told(error: &RuckigError) -> String {
    // What follows is what it was asked.
    let told = error.to_string();
    format!(
        "no way to the target was found: {}",
        told.lines().next().unwrap_or_default().trim_end_matches("input: ").trim()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Duration = Duration::from_millis(1);

    fn limits() -> Vec<MotionLimits> {
        let joint = |position, velocity| MotionLimits { position, velocity, acceleration: 2.0, jerk: 20.0 };
        vec![joint([-1.0, 1.0], 0.5), joint([f64::NEG_INFINITY, f64::INFINITY], 0.3)]
    }

    fn at_rest() -> Generator {
        Generator::new(&limits(), &[0.0, 0.2], PERIOD).unwrap()
    }

    /// Steps until it is held, and checks every limit by differences from cycle to cycle.
    fn follow(generator: &mut Generator) -> Vec<Setpoint> {
        let secs = PERIOD.as_secs_f64();
        let mut way = vec![generator.step().unwrap()];
        while !generator.is_held() {
            way.push(generator.step().unwrap());
            assert!(way.len() < 20_000, "it never arrives");
        }
        for pair in way.windows(2) {
            for (ix, joint) in limits().iter().enumerate() {
                let speed = (pair[1].position[ix] - pair[0].position[ix]) / secs;
                let acceleration = (pair[1].velocity[ix] - pair[0].velocity[ix]) / secs;
                let jerk = (pair[1].acceleration[ix] - pair[0].acceleration[ix]) / secs;
                assert!(speed.abs() <= joint.velocity * 1.0001, "{speed}");
                assert!(acceleration.abs() <= joint.acceleration * 1.0001, "{acceleration}");
                assert!(jerk.abs() <= joint.jerk * 1.0001, "{jerk}");
                assert!((joint.position[0]..=joint.position[1]).contains(&pair[1].position[ix]));
            }
        }
        way
    }

    #[test]
    fn all_joints_arrive_together_within_their_limits() {
        let mut generator = at_rest();
        let target = JointTarget { position: vec![0.9, -0.1] };
        assert_eq!(generator.head_for(&target).unwrap(), target);
        let way = follow(&mut generator);
        let last = way.last().unwrap();
        assert!(last.position.iter().zip(&target.position).all(|(got, wanted)| (got - wanted).abs() < 1e-9));
        assert_eq!(last.velocity, [0.0, 0.0]);
        let before = &way[way.len() - 20];
        assert!(
            (0..2).all(|ix| (before.position[ix] - target.position[ix]).abs() > 1e-9),
            "both are still on their way"
        );
    }

    #[test]
    fn a_target_on_the_way_and_a_stop_keep_the_limits() {
        let mut generator = at_rest();
        generator.head_for(&JointTarget { position: vec![0.9, -5.0] }).unwrap();
        for _ in 0..300 {
            generator.step().unwrap();
        }
        generator.head_for(&JointTarget { position: vec![-0.9, 5.0] }).unwrap();
        for _ in 0..400 {
            generator.step().unwrap();
        }
        generator.stop();
        let way = follow(&mut generator);
        let last = way.last().unwrap();
        assert_eq!(last.velocity, [0.0, 0.0]);
        assert!(last.position[0] > -0.9, "it did not go on to its target");
        assert_eq!(generator.step().unwrap(), *last, "it stays");
    }

    #[test]
    fn a_joint_that_is_soon_at_rest_does_not_wait_for_the_others_when_it_stops() {
        let joint = |jerk| MotionLimits { position: [-1.0, 1.0], velocity: 0.5, acceleration: 2.0, jerk };
        let mut generator = Generator::new(&[joint(20.0), joint(2.0)], &[0.0, 0.0], PERIOD).unwrap();
        generator.head_for(&JointTarget { position: vec![0.3, 0.9] }).unwrap();
        for _ in 0..1000 {
            generator.step().unwrap();
        }
        generator.stop();
        let mut n_moving = [0, 0];
        while !generator.is_held() {
            let velocity = generator.step().unwrap().velocity;
            n_moving = std::array::from_fn(|ix| n_moving[ix] + u32::from(velocity[ix].abs() > 1e-9));
        }
        assert!(n_moving[0] > 10 && 2 * n_moving[0] < n_moving[1], "{n_moving:?}");
    }

    #[test]
    fn it_goes_on_from_where_the_arm_was_found_within_the_limits() {
        let mut generator = at_rest();
        let target = JointTarget { position: vec![0.9, -0.1] };
        generator.head_for(&target).unwrap();
        for _ in 0..300 {
            generator.step().unwrap();
        }
        let found = Setpoint { position: vec![0.2, 0.1], velocity: vec![0.3, -0.2], acceleration: vec![1.0, 0.5] };
        generator.resume(&found).unwrap();
        let way = follow(&mut generator);
        assert!((way[0].position[0] - 0.2003).abs() < 1e-5, "{:?}", way[0]);
        assert!((way[way.len() - 1].position[0] - 0.9).abs() < 1e-9, "it heads for its target as before");
        let few = Setpoint { velocity: vec![0.0], ..found };
        assert!(generator.resume(&few).unwrap_err().contains("1 "));
    }

    #[test]
    fn a_joint_too_fast_for_the_end_of_its_range_brakes_and_comes_back() {
        let mut generator = at_rest();
        generator.head_for(&JointTarget { position: vec![2.0, 0.2] }).unwrap();
        let moving = |position| Setpoint {
            position: vec![position, 0.2],
            velocity: vec![0.4, 0.0],
            acceleration: vec![-2.0, 0.0],
        };
        // From 0.4 rad/s it takes 0.045 rad to stop.
        generator.resume(&moving(0.965)).unwrap();
        let mut way = vec![moving(0.965)];
        while !generator.is_held() {
            way.push(generator.step().unwrap());
        }
        let farthest = way.iter().map(|setpoint| setpoint.position[0]).fold(0.0, f64::max);
        assert!(farthest > 1.005 && farthest < 1.015, "{farthest}");
        assert!((way[way.len() - 1].position[0] - 1.0).abs() < 1e-9);
        assert!(way.iter().all(|setpoint| setpoint.acceleration[0].abs() < 2.0001));
        generator.resume(&moving(0.999)).unwrap();
        assert!(generator.step().unwrap_err().contains("no way"), "it would go too far");
        generator.stop();
        while !generator.is_held() {
            generator.step().unwrap();
        }
    }

    #[test]
    fn distances_at_which_full_acceleration_is_reached_for_no_time_are_gone_as_others_are() {
        for (velocity, start) in [(0.5, -1.3), (0.2, 0.07), (0.1, 0.0), (1.0, 0.4)] {
            let (acceleration, jerk) = (velocity / 0.5, velocity / 0.5 / 0.1);
            let joint = MotionLimits { position: [-2.0, 2.0], velocity, acceleration, jerk };
            for sign in [1.0, -1.0] {
                let target = start + sign * 2.0 * acceleration.powi(3) / jerk.powi(2);
                let mut generator = Generator::new(&[joint, joint], &[start, 0.3], PERIOD).unwrap();
                generator.head_for(&JointTarget { position: vec![target, 0.3] }).unwrap();
                let mut way = vec![generator.step().unwrap()];
                while !generator.is_held() {
                    way.push(generator.step().unwrap());
                    let [.., before, now] = &way[..] else { continue };
                    let jerk_now = (now.acceleration[0] - before.acceleration[0]) / PERIOD.as_secs_f64();
                    assert!(jerk_now.abs() <= jerk * 1.0001 && now.acceleration[0].abs() <= acceleration * 1.0001);
                }
                // Four times as long as it takes to come to full acceleration.
                assert!((way.len() as f64 - 400.0).abs() < 3.0, "{}", way.len());
                assert!((way[way.len() - 1].position[0] - target).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn targets_outside_the_range_are_brought_into_it_and_others_are_refused() {
        let mut generator = at_rest();
        let taken = generator.head_for(&JointTarget { position: vec![3.0, 7.0] }).unwrap();
        assert_eq!(taken.position, [1.0, 7.0]);
        let before = generator.step().unwrap();
        assert!(generator.head_for(&JointTarget { position: vec![0.0] }).unwrap_err().contains("1 positions"));
        assert!(generator.head_for(&JointTarget { position: vec![f64::NAN, 0.0] }).unwrap_err().contains("joint 1"));
        assert!(generator.step().unwrap().position[1] > before.position[1], "it is on its way as before");
    }

    #[test]
    fn a_joint_may_begin_a_little_outside_its_range_but_not_far() {
        let mut generator = Generator::new(&limits(), &[1.01, 0.0], PERIOD).unwrap();
        generator.head_for(&JointTarget { position: vec![0.5, 0.0] }).unwrap();
        while !generator.is_held() {
            generator.step().unwrap();
        }
        assert!(Generator::new(&limits(), &[1.5, 0.0], PERIOD).unwrap_err().contains("joint 1 is at 1.5"));
    }
}
