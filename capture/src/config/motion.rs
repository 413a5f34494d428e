//! The keys in `[arm.motion]`, which define how an arm may be moved.

use super::error::ConfigError;
use super::key::{choices, keys};
use drivers::motion::OnLoss;

keys! {
    /// How an arm may be moved; an arm without this table is only read.
    #[derive(Clone, Debug, PartialEq)]
    pub struct ArmMotion {
        /// Fail-safe behavior of the motors when communication with this computer is lost.
        pub on_loss: OnLoss, required "hold, damp or release: what the motors do when communication is lost";
        /// Time without communication after which the motors apply `on_loss`, milliseconds.
        pub timeout_millis: f64 = 100.0, in 5.0..=2000.0;
        /// Time in which an arm at rest reaches `arm.max_speed_rad_s` at
        /// full acceleration, seconds.
        pub acceleration_secs: f64 = 0.5, in 0.01..=10.0;
        /// Time from rest to full acceleration, seconds.
        pub jerk_secs: f64 = 0.1, in 0.001..=10.0;
        /// Whether motors without a watchdog may be moved.
        pub accept_no_watchdog: bool = false;
        /// External torques at which a Franka arm stops, Nm, in the order of its joints. Without this
        /// and the following keys, the driver's default.
        pub contact_torque_nm: Option<[f64; 7]>, in 1.0..=100.0;
        /// External forces on the end effector at which a Franka arm stops, along x, y and z of the
        /// robot base, N.
        pub contact_force_n: Option<[f64; 3]>, in 1.0..=100.0;
        /// External moments about the same axes at which a Franka arm stops, Nm.
        pub contact_moment_nm: Option<[f64; 3]>, in 1.0..=100.0;
        /// Joint stiffness of a Franka arm, Nm/rad, in the order of its joints.
        pub stiffness_nm_rad: Option<[f64; 7]>, in 10.0..=14250.0;
        /// Path of ODrive's `flat_endpoints.json`. Without it, the watchdog cannot be set.
        pub odrive_endpoints: String = String::new();
        /// How an operator may steer the arm.
        pub steering: ArmSteering;
    }

    /// How an operator may steer an arm from the page of a run.
    #[derive(Clone, Debug, PartialEq)]
    pub struct ArmSteering {
        /// Largest speed of the flange, and of every other part of the robot, m/s.
        pub max_speed_m_s: f64 = 0.25, in 0.01..=1.0;
        /// Largest angular speed of the flange, rad/s.
        pub max_angular_rad_s: f64 = 1.0, in 0.05..=3.0;
        /// Box that the flange stays in, m: x, y and z of its lower corner, then of its upper corner,
        /// in the frame of `arm.base_link`. Without it, only the joint limits and the scene bound the motion.
        pub workspace_m: Option<[f64; 6]>, in -100.0..=100.0;
        /// Round trip between page and run, ms, up to which the arm follows the hand. With a longer
        /// one, the page previews goals instead.
        pub servo_round_trip_millis: f64 = 120.0, in 1.0..=1000.0;
        /// Distance around the arm, m, up to which space that no camera has seen counts as free where
        /// the arm was before the first operator took it over, for example guided by hand. A
        /// simulated arm uses at least 0.15.
        pub swept_margin_m: f64 = 0.0, in 0.0..=0.2;
    }
}

impl Default for ArmSteering {
    fn default() -> Self {
        Self {
            max_speed_m_s: 0.25,
            max_angular_rad_s: 1.0,
            workspace_m: None,
            servo_round_trip_millis: 120.0,
            swept_margin_m: 0.0,
        }
    }
}

impl ArmSteering {
    /// Lower and upper corner of the box that the flange stays in.
    #[must_use]
    pub fn workspace_corners_m(&self) -> Option<[[f64; 3]; 2]> {
        let [x0, y0, z0, x1, y1, z1] = self.workspace_m?;
        Some([[x0, y0, z0], [x1, y1, z1]])
    }

    /// Checks that the workspace has a volume.
    pub(super) fn check(&self, file: &str) -> Result<(), ConfigError> {
        let Some([lower, upper]) = self.workspace_corners_m() else {
            return Ok(());
        };
        let sides = ["x", "y", "z"]
            .into_iter()
            .zip(lower.into_iter().zip(upper));
        for (axis, (lower, upper)) in sides {
            if lower >= upper {
                return Err(ConfigError::Robot {
                    file: file.to_owned(),
                    key: "arm.motion.steering.workspace_m",
                    reason: format!(
                        "{axis} is from {lower} to {upper}: list x, y and z of the lower corner, then of the upper corner"
                    ),
                });
            }
        }
        Ok(())
    }
}

choices! {
    OnLoss { Hold = "hold", Damp = "damp", Release = "release" }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_those_of_an_empty_table() {
        let text = super::super::tests::RIG.to_owned();
        let rig = crate::config::Rig::parse("rig.toml", &text, super::super::tests::URDF, &[]);
        let motion = rig.expect("a good rig file").arm.motion.expect("its table");
        assert_eq!(motion.steering, ArmSteering::default());
    }

    #[test]
    fn a_workspace_without_volume_is_rejected() {
        let with = |workspace_m| ArmSteering {
            workspace_m: Some(workspace_m),
            ..ArmSteering::default()
        };
        assert!(
            with([-1.0, -1.0, 0.0, 1.0, 1.0, 1.0])
                .check("rig.toml")
                .is_ok()
        );
        let error = with([-1.0, 1.0, 0.0, 1.0, 1.0, 1.0]).check("rig.toml");
        let text = error.expect_err("y has no length").to_string();
        assert!(text.contains("workspace_m: y is from 1 to 1"), "{text}");
    }
}
