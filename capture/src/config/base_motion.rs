//! The keys in `[base.motion]`, which define how a base may be driven.

use super::error::ConfigError;
use super::key::keys;
use drivers::base_motion::BaseLimits;
use std::net::SocketAddr;

keys! {
    /// How an operator may drive the base; a base without this table only reports its pose.
    #[derive(Clone, Debug, PartialEq)]
    pub struct BaseMotion {
        /// Address of the controller of the base, which receives velocities as datagrams. Simulated
        /// bases need none.
        pub address: Option<SocketAddr>;
        /// Largest speed forward and backward, m/s.
        pub max_forward_m_s: f64 = 0.3, in 0.01..=2.0;
        /// Largest speed to the sides, m/s; 0 for a base that cannot move sideways.
        pub max_sideways_m_s: f64 = 0.0, in 0.0..=2.0;
        /// Largest yaw rate, rad/s.
        pub max_yaw_rad_s: f64 = 0.5, in 0.01..=3.0;
        /// Largest acceleration over the floor, m/s².
        pub acceleration_m_s2: f64 = 0.3, in 0.01..=5.0;
        /// Largest yaw acceleration, rad/s².
        pub yaw_acceleration_rad_s2: f64 = 0.6, in 0.01..=10.0;
        /// Deceleration of braking, m/s²; at least `acceleration_m_s2`.
        pub brake_m_s2: f64 = 0.6, in 0.01..=20.0;
        /// Yaw deceleration of braking, rad/s²; at least `yaw_acceleration_rad_s2`.
        pub brake_yaw_rad_s2: f64 = 1.2, in 0.01..=40.0;
        /// Rectangle on the floor that the base link stays in, m: smallest x and y, then largest x
        /// and y, in the world. Without it, the base may drive anywhere.
        pub area_m: Option<[f64; 4]>, in -10000.0..=10000.0;
        /// Positions of the arm's joints while the base moves, radians or meters, in the order of
        /// `arm.joints`. A robot with an arm needs this key.
        pub stowed: Vec<f64> = Vec::new();
        /// Largest distance of each joint from its stowed position, radians or meters.
        pub stowed_tolerance: f64 = 0.1, in 0.001..=1.0;
        /// Radius of a circle around the base link, m, in which the robot is while the base moves.
        /// Without this key and `footprint_m`, the footprint encloses the shapes of the robot
        /// description.
        pub footprint_radius_m: Option<f64>, in 0.05..=3.0;
        /// Corners of a convex polygon around the robot while the base moves, m: x and y of each
        /// corner, one after the other, in the frame of the base link.
        pub footprint_m: Vec<f64> = Vec::new();
        /// Lowest and highest height of obstacles, m, in the frame of the base link. The lowest one
        /// must be above the floor. Without this key, obstacles are at the height of the robot,
        /// except for its lowest 0.1 m.
        pub footprint_height_m: Option<[f64; 2]>, in -5.0..=5.0;
        /// Whether the base may enter space that no depth camera or range scanner has seen.
        pub allow_unseen: bool = false;
        /// Distance around the footprint, m, up to which space that nothing has seen counts as free
        /// where the base was before the first operator took it over. A simulated base uses at least
        /// 0.15.
        pub swept_margin_m: f64 = 0.0, in 0.0..=0.2;
    }
}

impl Default for BaseMotion {
    fn default() -> Self {
        Self {
            address: None,
            max_forward_m_s: 0.3,
            max_sideways_m_s: 0.0,
            max_yaw_rad_s: 0.5,
            acceleration_m_s2: 0.3,
            yaw_acceleration_rad_s2: 0.6,
            brake_m_s2: 0.6,
            brake_yaw_rad_s2: 1.2,
            area_m: None,
            stowed: Vec::new(),
            stowed_tolerance: 0.1,
            footprint_radius_m: None,
            footprint_m: Vec::new(),
            footprint_height_m: None,
            allow_unseen: false,
            swept_margin_m: 0.0,
        }
    }
}

impl BaseMotion {
    /// The limits of the base.
    #[must_use]
    pub fn limits(&self) -> BaseLimits {
        BaseLimits {
            max_forward_m_s: self.max_forward_m_s,
            max_left_m_s: self.max_sideways_m_s,
            max_yaw_rad_s: self.max_yaw_rad_s,
            acceleration_m_s2: self.acceleration_m_s2,
            yaw_acceleration_rad_s2: self.yaw_acceleration_rad_s2,
            brake_m_s2: self.brake_m_s2,
            brake_yaw_rad_s2: self.brake_yaw_rad_s2,
        }
    }

    /// Corners of the footprint; empty if they are not given.
    #[must_use]
    pub fn footprint_corners_m(&self) -> Vec<[f64; 2]> {
        self.footprint_m.as_chunks::<2>().0.to_vec()
    }

    /// Checks values that depend on each other.
    ///
    /// * `n_joints`: joints of the arm.
    pub(super) fn check(&self, file: &str, n_joints: usize) -> Result<(), ConfigError> {
        let error = |key, reason| {
            Err(ConfigError::Robot {
                file: file.to_owned(),
                key,
                reason,
            })
        };
        if let Err(limits) = self.limits().check() {
            return error("base.motion", limits.to_string());
        }
        if let Some([x0, y0, x1, y1]) = self.area_m
            && (x0 >= x1 || y0 >= y1)
        {
            let reason = format!(
                "it is from x {x0}, y {y0} to x {x1}, y {y1}: list the smallest x and y, then the largest"
            );
            return error("base.motion.area_m", reason);
        }
        let n_stowed = self.stowed.len();
        if n_stowed > 0 && n_stowed != n_joints {
            let reason = format!("it has {n_stowed} positions, the arm has {n_joints} joints");
            return error("base.motion.stowed", reason);
        }
        let n_numbers = self.footprint_m.len();
        if n_numbers > 0 && (n_numbers < 6 || !n_numbers.is_multiple_of(2)) {
            let reason = format!(
                "it has {n_numbers} numbers: list x and y of at least 3 corners, one after the other"
            );
            return error("base.motion.footprint_m", reason);
        }
        if n_numbers > 0 && self.footprint_radius_m.is_some() {
            let reason = "footprint_radius_m is set, too: remove one of them".to_owned();
            return error("base.motion.footprint_m", reason);
        }
        if let Some([low, high]) = self.footprint_height_m
            && low >= high
        {
            let reason = format!("it is from {low} to {high}: list the lowest height first");
            return error("base.motion.footprint_height_m", reason);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Rig;
    use crate::config::tests::{RIG, URDF};

    fn read(table: &str) -> Result<BaseMotion, String> {
        let text = RIG.replace("[base.motion]", &format!("[base.motion]\n{table}"));
        let rig = Rig::parse("rig.toml", &text, URDF, &[]).map_err(|error| error.to_string())?;
        Ok(rig.base.motion.expect("its table"))
    }

    #[test]
    fn defaults_are_those_of_an_empty_table() {
        assert_eq!(read(""), Ok(BaseMotion::default()));
        assert!(BaseMotion::default().limits().check().is_ok());
    }

    #[test]
    fn values_that_contradict_each_other_are_rejected() {
        for (table, expected) in [
            ("acceleration_m_s2 = 1.0", "brake_m_s2 is 0.6"),
            ("area_m = [0, 1, 2, 1]", "base.motion.area_m: it is from"),
            ("stowed = [0.1]", "it has 1 positions, the arm has 2 joints"),
            ("footprint_m = [0, 0, 1, 0]", "at least 3 corners"),
            (
                "footprint_m = [0, 0, 1, 0, 0, 1]\nfootprint_radius_m = 1",
                "footprint_radius_m is set, too",
            ),
            ("footprint_height_m = [0.2, 0.1]", "the lowest height first"),
        ] {
            let error = read(table).expect_err(table);
            assert!(error.contains(expected), "{error}");
        }
    }
}
