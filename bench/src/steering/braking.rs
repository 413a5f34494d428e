//! When an arm begins to brake, and when it is at rest, from the motion of its joints.

use super::trace::Sample;
use drivers::motion::MotionLimits;
use kinematics::Stamp;

/// Speed below which an arm is at rest. A controller that reports positions as numbers with double
/// precision has differences of up to 1e-12 between them.
const REST_SPEED: f64 = 1e-6;
/// Growth of the speed in a cycle that is only rounding.
const ROUNDING: f64 = 1e-9;

/// How an arm came to rest after an event. Times are since the event.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Braking {
    /// From here on, the arm only becomes slower.
    pub(super) begins_secs: f64,
    /// From here on, the arm is at rest.
    pub(super) rests_secs: f64,
    /// When the arm would be at rest if it braked with its limits from the beginning of the brake
    /// on; `None` if other rules count.
    pub(super) predicted_secs: Option<f64>,
}

#[cfg(all(feature = "sim", target_os = "linux"))]
impl Braking {
    /// A brake by other rules than the limits.
    pub(super) fn without_prediction(self) -> Self {
        Self {
            predicted_secs: None,
            ..self
        }
    }
}

/// Why there is no brake to measure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NoBrake {
    /// The arm was at rest already at the event.
    AtRest,
    /// The arm still moves at the end.
    Moving,
}

/// The brake after an event.
///
/// A brake begins with the first cycle from which the speed only falls. If the arm speeds up before
/// the event, the brake first ends this, which counts as time before the brake.
///
/// * `samples`: from before the event until after rest.
/// * `ended_at`: when the arm reported the end of its motion. An arm that slows down because it
///   arrives at its goal does not brake, so the brake begins no earlier than this.
pub(super) fn braking(
    samples: &[Sample],
    event_at: Stamp,
    ended_at: Option<Stamp>,
    brake_limits: &[MotionLimits],
) -> Result<Braking, NoBrake> {
    let is_moving = |sample: &Sample| sample.speed() > REST_SPEED;
    let last_moving_ix = samples.iter().rposition(is_moving);
    let event_ix = samples.partition_point(|sample| sample.at <= event_at);
    let last_moving_ix = last_moving_ix
        .filter(|ix| *ix >= event_ix)
        .ok_or(NoBrake::AtRest)?;
    let rest = samples.get(last_moving_ix + 1).ok_or(NoBrake::Moving)?;
    let slows = |ix: &usize| samples[*ix].speed() < samples[ix - 1].speed() - ROUNDING;
    let falling_ix = (event_ix.max(1)..=last_moving_ix)
        .rev()
        .take_while(slows)
        .last()
        .unwrap_or(last_moving_ix);
    let ended_ix = ended_at.map_or(0, |at| samples.partition_point(|sample| sample.at < at));
    let begin_ix = falling_ix.max(ended_ix).min(last_moving_ix + 1);
    let begins_at = samples[begin_ix].at;
    // The state of motion from which the first cycle of the brake starts.
    let from = &samples[begin_ix.saturating_sub(1)];
    let predicted_at = from.at.plus_secs(stop_secs_of(from, brake_limits));
    Ok(Braking {
        begins_secs: begins_at.secs_since(event_at),
        rests_secs: rest.at.secs_since(event_at),
        predicted_secs: Some(predicted_at.secs_since(event_at)),
    })
}

/// Time in which all joints come to rest. Each joint brakes on its own.
fn stop_secs_of(sample: &Sample, brake_limits: &[MotionLimits]) -> f64 {
    let setpoint = &sample.setpoint;
    let joints = brake_limits.iter().enumerate();
    joints
        .map(|(ix, limits)| {
            let motion = [setpoint.velocity[ix], setpoint.acceleration[ix]];
            stop_secs(motion, limits.acceleration, limits.jerk)
        })
        .fold(0.0, f64::max)
}

/// Shortest time in which a joint comes to rest.
///
/// The acceleration falls to a peak, stays there if the peak is the maximum, and returns to zero,
/// each with the maximum jerk. The areas below the acceleration give the peak: with velocity `v`,
/// acceleration `a` and jerk `j`, it is `sqrt(j v + a²/2)`. This is computed here from the limits
/// alone, so that the prediction does not depend on the generator that is measured.
///
/// * `motion`: velocity and acceleration.
pub(super) fn stop_secs(motion: [f64; 2], max_acceleration: f64, max_jerk: f64) -> f64 {
    let [velocity, acceleration] = motion;
    if max_jerk.is_infinite() {
        return velocity.abs() / max_acceleration;
    }
    // The velocity that is left if the acceleration is first reduced to zero. Its sign is the
    // direction in which the joint must brake.
    let coasting = velocity + acceleration * acceleration.abs() / (2.0 * max_jerk);
    let direction = if coasting < 0.0 { -1.0 } else { 1.0 };
    let [velocity, acceleration] = [direction * velocity, direction * acceleration];
    let peak = (max_jerk * velocity + 0.5 * acceleration.powi(2))
        .max(0.0)
        .sqrt();
    if peak <= max_acceleration {
        return ((acceleration + 2.0 * peak) / max_jerk).max(0.0);
    }
    let ramps_secs = (acceleration + 2.0 * max_acceleration) / max_jerk;
    let slowed_by_ramps = (max_acceleration.powi(2) - 0.5 * acceleration.powi(2)) / max_jerk;
    (ramps_secs + (velocity - slowed_by_ramps) / max_acceleration).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::super::trace::tests::{PERIOD, braked_motion, limits};
    use super::*;
    use drivers::motion::{Setpoint, TrajectoryGenerator, brake_limits};
    use numbers::random::Random;

    /// Cycles of a motion before its brake: at full velocity, after the acceleration.
    const N_MOVING: i64 = 1000;
    const PERIOD_NANOS: i64 = 1_000_000;
    /// Two cycles: the beginning and the end of a brake are both rounded to cycles.
    const TWO_CYCLES_SECS: f64 = 2e-3;

    fn after_cycles(n: i64) -> Stamp {
        Stamp(n * PERIOD_NANOS)
    }

    #[test]
    fn brake_is_measured_from_the_event_and_ends_as_predicted() {
        let brake_limits = brake_limits(&limits(), 2.0);
        let samples = braked_motion(N_MOVING, &brake_limits);
        // The event is 30 cycles before the brake, and the arm moves evenly in between.
        let event_at = after_cycles(N_MOVING - 30);
        let braking = braking(&samples, event_at, None, &brake_limits).expect("it brakes");
        assert!(
            (braking.begins_secs - 0.030).abs() < TWO_CYCLES_SECS,
            "{braking:?}"
        );
        assert!(
            (braking.rests_secs - braking.predicted_secs.expect("predicted")).abs()
                < 2.0 * TWO_CYCLES_SECS,
            "{braking:?}"
        );
    }

    #[test]
    fn slow_brake_is_reported_as_later_than_predicted() {
        let samples = braked_motion(N_MOVING, &limits());
        let event_at = after_cycles(N_MOVING - 1);
        let harder = brake_limits(&limits(), 2.0);
        let braking = braking(&samples, event_at, None, &harder).expect("it brakes");
        let late_secs = braking.rests_secs - braking.predicted_secs.expect("predicted");
        assert!(late_secs > 0.1, "{braking:?}");
    }

    #[test]
    fn brake_does_not_begin_before_the_arm_reports_the_end_of_its_motion() {
        let samples = braked_motion(N_MOVING, &limits());
        let event_at = after_cycles(N_MOVING - 30);
        let ended_at = after_cycles(N_MOVING + 100);
        let braking = braking(&samples, event_at, Some(ended_at), &limits()).expect("it brakes");
        assert!(
            (braking.begins_secs - 0.130).abs() < TWO_CYCLES_SECS,
            "{braking:?}"
        );
    }

    #[test]
    fn an_arm_that_rests_or_does_not_stop_is_an_error() {
        let samples = braked_motion(N_MOVING, &limits());
        let end = samples.last().expect("samples").at;
        assert_eq!(
            braking(&samples, end, None, &limits()),
            Err(NoBrake::AtRest)
        );
        let moving = &samples[..800];
        let event_at = after_cycles(700);
        assert_eq!(
            braking(moving, event_at, None, &limits()),
            Err(NoBrake::Moving)
        );
    }

    #[test]
    fn predicted_time_is_that_of_a_stop_of_the_generator() {
        let mut random = Random::new(1);
        let joint = MotionLimits {
            position: [f64::NEG_INFINITY, f64::INFINITY],
            ..limits()[0]
        };
        for _ in 0..300 {
            let motion = [random.uniform(-0.5, 0.5), random.uniform(-2.0, 2.0)];
            let start = Setpoint {
                position: vec![0.0],
                velocity: vec![motion[0]],
                acceleration: vec![motion[1]],
            };
            let mut generator = TrajectoryGenerator::new(&[joint], &[0.0], PERIOD).expect("valid");
            generator.resume(&start).expect("finite");
            generator.stop();
            let mut n_cycles = 0;
            while !generator.is_at_rest() {
                generator.step().expect("a stop");
                n_cycles += 1;
            }
            let expected_secs = f64::from(n_cycles) * PERIOD.as_secs_f64();
            let secs = stop_secs(motion, joint.acceleration, joint.jerk);
            assert!(
                (secs - expected_secs).abs() < 2.0 * TWO_CYCLES_SECS,
                "{motion:?}: {secs} s, not {expected_secs}"
            );
        }
    }
}
