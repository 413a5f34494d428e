//! The shaft of an emulated motor: inertia, friction, and the action of its drive.

use crate::wire::can::mit::{Command, Limits, Motion};

/// Inertia of the shaft and its load, kg m2. With the gains of the tests (30 N m / rad and 1.5 N m
/// s / rad), the shaft is well damped: the damping ratio is `(1.5 + 0.25) / (2 sqrt(30 * 0.05))`,
/// or 0.7.
const INERTIA_KG_M2: f64 = 0.05;
/// Viscous friction, N m s / rad.
const FRICTION_NM_S_RAD: f64 = 0.25;
/// Gain of the drive's position loop, 1 / s. Unless the command contains the velocity, the shaft
/// lags a moving target by the velocity divided by this gain. The next constant is the maximum
/// velocity of the loop, rad / s.
const FOLLOWING_HZ: f64 = 60.0;
const MAX_FOLLOWING_RAD_S: f64 = 40.0;
/// Deceleration of the quick-stop ramp, rad / s2.
const QUICK_STOP_RAD_S2: f64 = 30.0;
/// Maximum length of a simulation step, s. The semi-implicit Euler method is stable if the step is
/// small compared with the inertia divided by the damping, which is 10 ms for a damping of 5 N m s
/// / rad.
const STEP_SECS: f64 = 2.5e-4;
/// Maximum time to simulate at once, s. After a longer stall, the rest is skipped, because
/// simulating it would take so long that the next step is late, too.
const MAX_SECS: f64 = 1.0;

/// Action of a drive on its shaft.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::can) enum Actuation {
    /// Releases it.
    Free,
    /// Applies the torque law of MIT mode.
    Mit(Command),
    /// Runs its own position loop.
    Follow(Command),
    /// Stops it and holds its position.
    Stop,
}

/// A shaft that moves under the torque of its drive and friction.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shaft {
    pub(super) motion: Motion,
    /// Mechanical stops: lowest and highest position.
    pub(super) stops_rad: [f64; 2],
}

impl Shaft {
    pub(super) fn at_rest() -> Self {
        let motion = Motion {
            position_rad: 0.0,
            velocity_rad_s: 0.0,
            torque_nm: 0.0,
        };
        Self {
            motion,
            stops_rad: [f64::NEG_INFINITY, f64::INFINITY],
        }
    }

    /// Advances the simulation by `secs`.
    pub(super) fn advance(&mut self, secs: f64, actuation: &Actuation, limits: &Limits) {
        let mut remaining = secs.clamp(0.0, MAX_SECS);
        while remaining > 0.0 {
            let step = remaining.min(STEP_SECS);
            self.step(step, actuation, limits);
            remaining -= step;
        }
    }

    fn step(&mut self, secs: f64, actuation: &Actuation, limits: &Limits) {
        let Motion {
            position_rad,
            velocity_rad_s,
            ..
        } = self.motion;
        let torque_nm = match actuation {
            Actuation::Free => 0.0,
            Actuation::Mit(command) => {
                let torque = command.kp_nm_rad * (command.position_rad - position_rad)
                    + command.kd_nm_s_rad * (command.velocity_rad_s - velocity_rad_s)
                    + command.torque_nm;
                // A drive cannot apply more torque than its range.
                torque.clamp(-limits.torque_nm, limits.torque_nm)
            }
            Actuation::Follow(command) => {
                let target_velocity =
                    command.velocity_rad_s + FOLLOWING_HZ * (command.position_rad - position_rad);
                return self.rotate(
                    target_velocity.clamp(-MAX_FOLLOWING_RAD_S, MAX_FOLLOWING_RAD_S),
                    secs,
                );
            }
            Actuation::Stop => {
                // The clamp keeps the last step from reversing the direction.
                let max_deceleration_step = QUICK_STOP_RAD_S2 * secs;
                return self.rotate(
                    velocity_rad_s
                        - velocity_rad_s.clamp(-max_deceleration_step, max_deceleration_step),
                    secs,
                );
            }
        };
        // Semi-implicit Euler: the position is advanced with the new velocity, which keeps
        // oscillations from growing.
        let acceleration = (torque_nm - FRICTION_NM_S_RAD * velocity_rad_s) / INERTIA_KG_M2;
        self.rotate(velocity_rad_s + acceleration * secs, secs);
        // `rotate` sets the torque to 0. That is correct for the position loop, whose torque is
        // unknown. For other commands, the torque is set here.
        self.motion.torque_nm = torque_nm;
    }

    fn rotate(&mut self, velocity_rad_s: f64, secs: f64) {
        let free_rad = self.motion.position_rad + velocity_rad_s * secs;
        let position_rad = free_rad.clamp(self.stops_rad[0], self.stops_rad[1]);
        // At a mechanical stop, the shaft loses its velocity, and the drive continues to push.
        let velocity_rad_s = if position_rad == free_rad {
            velocity_rad_s
        } else {
            0.0
        };
        self.motion = Motion {
            position_rad,
            velocity_rad_s,
            torque_nm: 0.0,
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: Limits = Limits::of(12.5, 30.0, 10.0);

    #[test]
    fn shaft_reaches_target_and_rests() {
        let command = Command {
            position_rad: 0.7,
            kp_nm_rad: 30.0,
            kd_nm_s_rad: 1.5,
            ..Command::default()
        };
        for actuation in [Actuation::Mit(command), Actuation::Follow(command)] {
            let mut shaft = Shaft::at_rest();
            for _ in 0..1500 {
                shaft.advance(2e-3, &actuation, &LIMITS);
            }
            assert!(
                (shaft.motion.position_rad - 0.7).abs() < 1e-6,
                "{actuation:?} {:?}",
                shaft.motion
            );
        }
    }

    #[test]
    fn blocked_shaft_stays_at_its_stop_under_torque() {
        let command = Command {
            position_rad: 0.7,
            kp_nm_rad: 10.0,
            kd_nm_s_rad: 1.5,
            ..Command::default()
        };
        let mut shaft = Shaft {
            stops_rad: [-1.0, 0.2],
            ..Shaft::at_rest()
        };
        shaft.advance(0.9, &Actuation::Mit(command), &LIMITS);
        assert!(
            shaft.motion.position_rad == 0.2 && shaft.motion.velocity_rad_s < 1e-9,
            "{:?}",
            shaft.motion
        );
        assert!(
            (shaft.motion.torque_nm - 5.0).abs() < 1e-9,
            "{:?}",
            shaft.motion
        );
    }

    #[test]
    fn free_shaft_coasts_and_stopping_shaft_rests() {
        let motion = Motion {
            position_rad: 0.0,
            velocity_rad_s: 3.0,
            torque_nm: 0.0,
        };
        let moving = Shaft {
            motion,
            ..Shaft::at_rest()
        };
        let (mut free, mut stopped) = (moving, moving);
        free.advance(0.2, &Actuation::Free, &LIMITS);
        stopped.advance(0.2, &Actuation::Stop, &LIMITS);
        assert!(
            free.motion.position_rad > 0.3 && free.motion.velocity_rad_s > 1.0,
            "{:?}",
            free.motion
        );
        // The velocity falls from 3 rad/s to 0 within 0.1 s, so the shaft moves by half of 3 rad/s
        // times 0.1 s.
        assert!(
            (stopped.motion.position_rad - 0.15).abs() < 1e-3,
            "{:?}",
            stopped.motion
        );
        assert_eq!(stopped.motion.velocity_rad_s, 0.0);
    }
}
