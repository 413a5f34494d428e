//! What a motion may ask of the joints.

use super::super::N_JOINTS;
use super::Wanted;

/// Seconds from command to command.
pub(super) const STEP_SECS: f64 = 1e-3;
/// Positions are rounded to 4e-16 rad; the third difference of eight such roundings over (1 ms)³ is 3e-6 rad/s³.
const ROUNDING: f64 = 1e-5;

/// Limits of the joints of one robot.
#[derive(Clone, Debug, PartialEq)]
pub struct Limits {
    /// Least and greatest angle, rad.
    pub position_rad: [[f64; 2]; N_JOINTS],
    /// Greatest rate either way, rad/s.
    pub velocity_rad_s: [f64; N_JOINTS],
    /// And its rate, rad/s².
    pub acceleration_rad_s2: [f64; N_JOINTS],
    /// And its rate, rad/s³.
    pub jerk_rad_s3: [f64; N_JOINTS],
    /// How a joint must be slower towards the end of its range; without, it may be fast everywhere.
    pub braking: Option<[Braking; N_JOINTS]>,
}

/// Near the end of its range a joint must be slow enough to stop with `deceleration_rad_s2`:
/// `velocity <= sqrt(2 * deceleration * way left) - margin`.
///
/// Source: libfranka 0.21.2, `joint_velocity_limits.h`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Braking {
    /// Deceleration that is counted with, rad/s².
    pub deceleration_rad_s2: f64,
    /// Taken off the rate, rad/s.
    pub margin_rad_s: f64,
}

/// What is wrong with a step, by libfranka's names (`errors.rs` of franka-rs).
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
    /// The Panda's. Source: `franka_description` and the FCI documentation of libfranka 0.9.2.
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

    /// The FR3's. Source: `franka_description` and `rate_limiting.h` of libfranka 0.21.2.
    pub fn fr3() -> Self {
        let braking = |(deceleration_rad_s2, margin_rad_s)| Braking { deceleration_rad_s2, margin_rad_s };
        let braking =
            [(6.0, 0.3), (2.585, 0.2), (3.5, 0.2), (4.0, 0.3), (17.0, 0.35), (5.5, 0.35), (17.0, 0.35)].map(braking);
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

    /// Least and greatest rate of a joint at an angle, rad/s.
    fn velocity_range(&self, ix: usize, position_rad: f64) -> [f64; 2] {
        let [least, greatest] = self.position_rad[ix];
        let most = self.velocity_rad_s[ix];
        let towards = |left_rad: f64| match &self.braking {
            Some(braking) => {
                let Braking { deceleration_rad_s2, margin_rad_s } = braking[ix];
                ((2.0 * deceleration_rad_s2 * left_rad.max(0.0)).sqrt() - margin_rad_s).clamp(0.0, most)
            }
            None => most,
        };
        [-towards(position_rad - least), towards(greatest - position_rad)]
    }

    /// Checks a step from where joints were wanted to where they are wanted now.
    pub(super) fn check(&self, before: &Wanted, now: &Wanted) -> Result<(), Violation> {
        let over = |number: f64, most: f64| number.is_nan() || number.abs() > most + ROUNDING;
        for ix in 0..N_JOINTS {
            let (position, velocity) = (now.position_rad[ix], now.velocity_rad_s[ix]);
            let [least, greatest] = self.position_rad[ix];
            if !(least..=greatest).contains(&position) {
                return Err(Violation::Position);
            }
            let [slowest, fastest] = self.velocity_range(ix, before.position_rad[ix]);
            if !(slowest - ROUNDING..=fastest + ROUNDING).contains(&velocity) {
                return Err(Violation::Velocity);
            }
            if over(now.acceleration_rad_s2[ix], self.acceleration_rad_s2[ix]) {
                return Err(Violation::Acceleration);
            }
            let jerk = (now.acceleration_rad_s2[ix] - before.acceleration_rad_s2[ix]) / STEP_SECS;
            if over(jerk, self.jerk_rad_s3[ix]) {
                return Err(Violation::Jerk);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At rest in the middle of all ranges, where an FR3 may be as fast as anywhere; one joint changed.
    fn with(limits: &Limits, ix: usize, change: impl Fn(&mut Wanted, usize)) -> Wanted {
        let position_rad = limits.position_rad.map(|[least, greatest]| 0.5 * (least + greatest));
        let mut wanted = Wanted { position_rad, is_moving: true, ..Wanted::default() };
        change(&mut wanted, ix);
        wanted
    }

    #[test]
    fn each_limit_of_each_joint_is_kept_from_both_sides() {
        let mut wrong = Vec::new();
        for limits in [Limits::panda(), Limits::fr3()] {
            let mut expect = |expected, before: Wanted, now: Wanted| {
                if limits.check(&before, &now) != expected {
                    wrong.push((expected, before, now));
                }
            };
            let rest = with(&limits, 0, |_, _| {});
            for ix in 0..N_JOINTS {
                for frac in [0.999, 1.001, -0.999, -1.001_f64] {
                    let holds = |violation| if frac.abs() < 1.0 { Ok(()) } else { Err(violation) };
                    let of = |most: [f64; N_JOINTS]| frac * most[ix];
                    let fast = with(&limits, ix, |wanted, ix| wanted.velocity_rad_s[ix] = of(limits.velocity_rad_s));
                    expect(holds(Violation::Velocity), fast, fast);
                    let brisk =
                        with(&limits, ix, |wanted, ix| wanted.acceleration_rad_s2[ix] = of(limits.acceleration_rad_s2));
                    expect(holds(Violation::Acceleration), brisk, brisk);
                    let step = of(limits.jerk_rad_s3) * STEP_SECS;
                    let [from, to] = [-0.5, 0.5]
                        .map(|share| with(&limits, ix, |wanted, ix| wanted.acceleration_rad_s2[ix] = share * step));
                    expect(holds(Violation::Jerk), from, to);
                    let [least, greatest] = limits.position_rad[ix];
                    let (middle, half) = (0.5 * (least + greatest), 0.5 * (greatest - least));
                    let far = with(&limits, ix, |wanted, ix| wanted.position_rad[ix] = middle + frac * half);
                    expect(holds(Violation::Position), rest, far);
                }
            }
            expect(Err(Violation::Position), rest, with(&limits, 2, |wanted, ix| wanted.position_rad[ix] = f64::NAN));
            expect(Err(Violation::Velocity), rest, with(&limits, 2, |wanted, ix| wanted.velocity_rad_s[ix] = f64::NAN));
            expect(
                Err(Violation::Acceleration),
                rest,
                with(&limits, 2, |wanted, ix| wanted.acceleration_rad_s2[ix] = f64::NAN),
            );
        }
        assert!(wrong.is_empty(), "{wrong:#?}");
    }

    #[test]
    fn an_fr3_is_slower_towards_the_end_of_its_range() {
        let limits = Limits::fr3();
        let at = |position_rad: f64, velocity_rad_s: f64| {
            let wanted = with(&limits, 1, |wanted, ix| {
                (wanted.position_rad[ix], wanted.velocity_rad_s[ix]) = (position_rad, velocity_rad_s);
            });
            limits.check(&wanted, &wanted)
        };
        // sqrt(2 * 2.585 * 0.1) - 0.2 = 0.519
        assert_eq!(at(1.6918, 0.51), Ok(()));
        assert_eq!(at(1.6918, 0.53), Err(Violation::Velocity));
        assert_eq!(at(1.6918, -2.6), Ok(()), "away from it");
        assert_eq!(at(-1.6918, -0.53), Err(Violation::Velocity));
    }
}
