//! The keys in `[arm.motion]`, which define how an arm may be moved.

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
    }
}

choices! {
    OnLoss { Hold = "hold", Damp = "damp", Release = "release" }
}
