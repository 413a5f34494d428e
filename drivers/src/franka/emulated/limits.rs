//! The limits that the emulated robot enforces on motions.

use super::super::N_JOINTS;
use super::CommandedJoints;

/// Seconds between commands.
pub(super) const STEP_SECS: f64 = 1e-3;
/// Tolerance for rounding. Positions are rounded to 4e-16 rad; the third difference of eight such
/// roundings over (1 ms)³ is 3e-6 rad/s³.
const ROUNDING: f64 = 1e-5;

/// Limits of the joints of one robot.
#[derive(Clone, Debug, PartialEq)]
pub struct Limits {
    /// Minimum and maximum angle, rad.
    pub position_rad: [[f64; 2]; N_JOINTS],
    /// Maximum velocity in either direction, rad/s.
    pub velocity_rad_s: [f64; N_JOINTS],
    /// Maximum acceleration, rad/s².
    pub acceleration_rad_s2: [f64; N_JOINTS],
    /// Maximum jerk, rad/s³.
    pub jerk_rad_s3: [f64; N_JOINTS],
    /// Velocity limits near the ends of the range; `None` if the velocity limits are constant.
    pub braking: Option<[BrakingLimit; N_JOINTS]>,
}

/// Velocity limit near the end of a joint's range. The joint must be slow enough to stop with
/// `deceleration_rad_s2`: `velocity <= sqrt(2 * deceleration * remaining distance) - margin`.
///
/// Source: libfranka 0.21.2, `joint_velocity_limits.h`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BrakingLimit {
    /// Assumed deceleration, rad/s².
    pub deceleration_rad_s2: f64,
    /// Margin subtracted from the velocity, rad/s.
    pub margin_rad_s: f64,
}

/// A limit violation, with libfranka's names (`errors.rs` of franka-rs).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Violation {
    StartPose,
    Position,
    Velocity,
    Acceleration,
    Jerk,
}

impl Violation {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::StartPose => "joint_position_motion_generator_start_pose_invalid",
            Self::Position => "joint_motion_generator_position_limits_violation",
            Self::Velocity => "joint_motion_generator_velocity_limits_violation",
            Self::Acceleration => "joint_motion_generator_velocity_discontinuity",
            Self::Jerk => "joint_motion_generator_acceleration_discontinuity",
        }
    }
}

impl Limits {
    /// Limits of the Panda. Source: `franka_description` and the FCI documentation of libfranka
    /// 0.9.2.
    pub fn panda() -> Self {
        Self {
            position_rad: [
                [-2.8973, 2.8973],
                [-1.7628, 1.7628],
                [-2.8973, 2.8973],
                [-3.0718, -0.0698],
                [-2.8973, 2.8973],
                [-0.0175, 3.7525],
                [-2.8973, 2.8973],
            ],
            velocity_rad_s: [2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61],
            acceleration_rad_s2: [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0],
            jerk_rad_s3: [7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0],
            braking: None,
        }
    }

    /// Limits of the FR3. Source: `franka_description` and `rate_limiting.h` of libfranka 0.21.2.
    pub fn fr3() -> Self {
        let braking = [
            (6.0, 0.3),
            (2.585, 0.2),
            (3.5, 0.2),
            (4.0, 0.3),
            (17.0, 0.35),
            (5.5, 0.35),
            (17.0, 0.35),
        ]
        .map(braking_limit);
        Self {
            position_rad: [
                [-2.7501, 2.7501],
                [-1.7918, 1.7918],
                [-2.9065, 2.9065],
                [-3.0481, -0.1458],
                [-2.8101, 2.8101],
                [0.54092, 4.5205],
                [-3.0196, 3.0196],
            ],
            velocity_rad_s: [2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26],
            acceleration_rad_s2: [10.0; N_JOINTS],
            jerk_rad_s3: [5000.0; N_JOINTS],
            braking: Some(braking),
        }
    }

    /// Minimum and maximum velocity of a joint at an angle, rad/s.
    fn velocity_range(&self, ix: usize, position_rad: f64) -> [f64; 2] {
        let [min, max] = self.position_rad[ix];
        [
            -self.max_velocity(ix, position_rad - min),
            self.max_velocity(ix, max - position_rad),
        ]
    }

    /// Maximum velocity of a joint towards an end of its range at this distance, rad/s.
    fn max_velocity(&self, ix: usize, distance_rad: f64) -> f64 {
        let max_rate = self.velocity_rad_s[ix];
        let Some(braking) = &self.braking else {
            return max_rate;
        };
        let BrakingLimit {
            deceleration_rad_s2,
            margin_rad_s,
        } = braking[ix];
        // Within the margin, and beyond the end of the range, a joint may not move towards the end
        // at all.
        ((2.0 * deceleration_rad_s2 * distance_rad.max(0.0)).sqrt() - margin_rad_s)
            .clamp(0.0, max_rate)
    }

    /// Checks the step from the previous commanded joint states to the current ones.
    pub(super) fn check(
        &self,
        before: &CommandedJoints,
        now: &CommandedJoints,
    ) -> Result<(), Violation> {
        // All comparisons with NaN are false, so NaN would pass the second condition.
        let exceeds =
            |number: f64, max_rate: f64| number.is_nan() || number.abs() > max_rate + ROUNDING;
        for ix in 0..N_JOINTS {
            let position = now.position_rad[ix];
            let velocity = now.velocity_rad_s[ix];
            let [min, max] = self.position_rad[ix];
            if !(min..=max).contains(&position) {
                return Err(Violation::Position);
            }
            // The limits belong to the position from which the joint starts this step.
            let [min_velocity, max_velocity] = self.velocity_range(ix, before.position_rad[ix]);
            if !(min_velocity - ROUNDING..=max_velocity + ROUNDING).contains(&velocity) {
                return Err(Violation::Velocity);
            }
            if exceeds(now.acceleration_rad_s2[ix], self.acceleration_rad_s2[ix]) {
                return Err(Violation::Acceleration);
            }
            let jerk = (now.acceleration_rad_s2[ix] - before.acceleration_rad_s2[ix]) / STEP_SECS;
            if exceeds(jerk, self.jerk_rad_s3[ix]) {
                return Err(Violation::Jerk);
            }
        }
        Ok(())
    }
}

fn braking_limit((deceleration_rad_s2, margin_rad_s): (f64, f64)) -> BrakingLimit {
    BrakingLimit {
        deceleration_rad_s2,
        margin_rad_s,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Joints at rest in the middle of their ranges, where an FR3 allows full velocity, with one
    /// joint changed.
    fn commanded_with(
        limits: &Limits,
        ix: usize,
        change: impl Fn(&mut CommandedJoints, usize),
    ) -> CommandedJoints {
        let position_rad = limits.position_rad.map(|[min, max]| 0.5 * (min + max));
        let mut commanded = CommandedJoints {
            position_rad,
            is_moving: true,
            ..CommandedJoints::default()
        };
        change(&mut commanded, ix);
        commanded
    }

    #[test]
    fn joint_limits_are_enforced_in_both_directions() {
        let mut wrong = Vec::new();
        for limits in [Limits::panda(), Limits::fr3()] {
            let mut expect = |expected, before: CommandedJoints, now: CommandedJoints| {
                if limits.check(&before, &now) != expected {
                    wrong.push((expected, before, now));
                }
            };
            let rest = commanded_with(&limits, 0, |_, _| {});
            for ix in 0..N_JOINTS {
                for frac in [0.999, 1.001, -0.999, -1.001_f64] {
                    let expected_at = |violation| {
                        if frac.abs() < 1.0 {
                            Ok(())
                        } else {
                            Err(violation)
                        }
                    };
                    let of = |max_rate: [f64; N_JOINTS]| frac * max_rate[ix];
                    let fast = commanded_with(&limits, ix, |commanded, ix| {
                        commanded.velocity_rad_s[ix] = of(limits.velocity_rad_s)
                    });
                    expect(expected_at(Violation::Velocity), fast, fast);
                    let accelerating = commanded_with(&limits, ix, |commanded, ix| {
                        commanded.acceleration_rad_s2[ix] = of(limits.acceleration_rad_s2)
                    });
                    expect(
                        expected_at(Violation::Acceleration),
                        accelerating,
                        accelerating,
                    );
                    let step = of(limits.jerk_rad_s3) * STEP_SECS;
                    let [from, to] = [-0.5, 0.5].map(|share| {
                        commanded_with(&limits, ix, |commanded, ix| {
                            commanded.acceleration_rad_s2[ix] = share * step
                        })
                    });
                    expect(expected_at(Violation::Jerk), from, to);
                    let [min, max] = limits.position_rad[ix];
                    let (middle, half) = (0.5 * (min + max), 0.5 * (max - min));
                    let far = commanded_with(&limits, ix, |commanded, ix| {
                        commanded.position_rad[ix] = middle + frac * half
                    });
                    expect(expected_at(Violation::Position), rest, far);
                }
            }
            expect(
                Err(Violation::Position),
                rest,
                commanded_with(&limits, 2, |commanded, ix| {
                    commanded.position_rad[ix] = f64::NAN
                }),
            );
            expect(
                Err(Violation::Velocity),
                rest,
                commanded_with(&limits, 2, |commanded, ix| {
                    commanded.velocity_rad_s[ix] = f64::NAN
                }),
            );
            expect(
                Err(Violation::Acceleration),
                rest,
                commanded_with(&limits, 2, |commanded, ix| {
                    commanded.acceleration_rad_s2[ix] = f64::NAN
                }),
            );
        }
        assert!(wrong.is_empty(), "{wrong:#?}");
    }

    #[test]
    fn fr3_speed_limit_drops_near_range_end() {
        let limits = Limits::fr3();
        let at = |position_rad: f64, velocity_rad_s: f64| {
            let commanded = commanded_with(&limits, 1, |commanded, ix| {
                (commanded.position_rad[ix], commanded.velocity_rad_s[ix]) =
                    (position_rad, velocity_rad_s);
            });
            limits.check(&commanded, &commanded)
        };
        // sqrt(2 * 2.585 * 0.1) - 0.2 = 0.519
        assert_eq!(at(1.6918, 0.51), Ok(()));
        assert_eq!(at(1.6918, 0.53), Err(Violation::Velocity));
        assert_eq!(at(1.6918, -2.6), Ok(()), "moving away from the range end");
        assert_eq!(at(-1.6918, -0.53), Err(Violation::Velocity));
    }
}
