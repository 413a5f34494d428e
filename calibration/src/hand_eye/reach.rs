//! Configurations near a start to which an arm may be sent.

use kinematics::{Chain, Transform};

/// Distance that configurations keep from the limits of the joints, radians or meters. Some
/// controllers stop an arm shortly before its limits.
const LIMIT_MARGIN: f64 = 0.05;
/// Largest change of a joint between two configurations of a path at which the distance from the
/// start is checked, radians or meters. One joint moves the flange of an arm of 1 m by 5 cm between
/// them.
const PATH_STEP: f64 = 0.05;

/// The space around a start configuration in which an arm moves.
#[derive(Clone, Copy, Debug)]
pub struct Reach<'a> {
    /// The arm.
    pub chain: &'a Chain,
    /// The joints at the start, in the order of the chain.
    pub start: &'a [f64],
    /// Largest change of a joint from the start, radians or meters.
    pub max_joint_change: f64,
    /// Largest distance of the flange from its position at the start, meters.
    pub max_distance_m: f64,
}

impl Reach<'_> {
    /// Joint values for a flange pose, if straight paths in joint space from `current` to it, and
    /// from it back to the start, stay near the start.
    pub fn joints_for(&self, base_from_flange: &Transform, current: &[f64]) -> Option<Vec<f64>> {
        let start = self.chain.forward(self.start).ok()?;
        // The distance is checked before inverse kinematics, which takes long.
        if distance_m(base_from_flange, &start) > self.max_distance_m {
            return None;
        }
        let bounds: Vec<[f64; 2]> = self
            .chain
            .limits()
            .iter()
            .zip(self.start)
            .map(|(limit, start)| {
                // A joint that starts close to its limit may stay there.
                let lower = (limit.lower + LIMIT_MARGIN).min(*start);
                let upper = (limit.upper - LIMIT_MARGIN).max(*start);
                [
                    lower.max(start - self.max_joint_change),
                    upper.min(start + self.max_joint_change),
                ]
            })
            .collect();
        let joints = self
            .chain
            .inverse(base_from_flange, self.start, &bounds)
            .ok()??;
        // The way back is checked, too: an arm that cannot return to its start would have to be
        // freed by hand.
        let is_allowed = current.len() == joints.len()
            && self.path_is_near(current, &joints, &start)
            && self.path_is_near(self.start, &joints, &start);
        is_allowed.then_some(joints)
    }

    /// Whether the flange stays near its pose at the start on the straight path in joint space
    /// between two configurations. The ends are not checked.
    fn path_is_near(&self, from: &[f64], to: &[f64], start: &Transform) -> bool {
        let largest = from
            .iter()
            .zip(to)
            .map(|(from, to)| (to - from).abs())
            .fold(0.0, f64::max);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "joints move by a few radians"
        )]
        let n_steps = (largest / PATH_STEP).ceil().clamp(1.0, 10_000.0) as u32;
        (1..n_steps).all(|step| {
            let share = f64::from(step) / f64::from(n_steps);
            let between: Vec<f64> = from
                .iter()
                .zip(to)
                .map(|(from, to)| from + share * (to - from))
                .collect();
            self.chain
                .forward(&between)
                .is_ok_and(|pose| distance_m(&pose, start) <= self.max_distance_m)
        })
    }
}

/// Distance between the positions of two poses, meters.
fn distance_m(a: &Transform, b: &Transform) -> f64 {
    (a.translation.vector - b.translation.vector).norm()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    const PANDA: &str = include_str!("../../../rigs/robots/panda.urdf");
    const START: [f64; 7] = [0.0, -0.3, 0.0, -2.2, 0.0, 2.2, 0.8];

    #[test]
    fn configurations_stay_near_the_start() {
        let chain = Chain::from_urdf(PANDA, "panda_link0", "panda_link8").unwrap();
        let reach = Reach {
            chain: &chain,
            start: &START,
            max_joint_change: 0.6,
            max_distance_m: 0.15,
        };
        let start = chain.forward(&START).unwrap();
        let near =
            start * Transform::new(Vector3::new(0.05, 0.0, -0.05), Vector3::new(0.2, 0.0, 0.1));
        let joints = reach.joints_for(&near, &START).expect("the pose is near");
        assert!(
            (chain.forward(&joints).unwrap().inverse() * near)
                .translation
                .vector
                .norm()
                < 1e-6
        );
        assert!(
            joints.iter().zip(&START).all(|(a, b)| (a - b).abs() <= 0.6),
            "{joints:?}"
        );
        let far = start * Transform::translation(0.2, 0.0, 0.0);
        assert_eq!(reach.joints_for(&far, &START), None, "beyond the distance");
        let rotated = start * Transform::new(Vector3::zeros(), Vector3::z() * 0.9);
        assert_eq!(
            reach.joints_for(&rotated, &START),
            None,
            "a joint would rotate by more than 0.6"
        );
        // The first and the last configuration are near, but the flange passes far from the start.
        let mut current = START;
        current[3] += 1.2;
        assert_eq!(
            reach.joints_for(&near, &current),
            None,
            "the path is too far"
        );
    }

    #[test]
    fn path_back_to_the_start_stays_near_it() {
        let chain = Chain::from_urdf(PANDA, "panda_link0", "panda_link8").unwrap();
        let wide = Reach {
            chain: &chain,
            start: &START,
            max_joint_change: 1.5,
            max_distance_m: 0.5,
        };
        let start = chain.forward(&START).unwrap();
        // The flange is where it was, but on the way it moves.
        let rotated = start * Transform::new(Vector3::zeros(), Vector3::y() * 0.7);
        let joints = wide.joints_for(&rotated, &START).expect("the pose is near");
        let middle: Vec<f64> = joints
            .iter()
            .zip(&START)
            .map(|(a, b)| 0.5 * (a + b))
            .collect();
        let middle = chain.forward(&middle).unwrap();
        let largest_m = (middle.translation.vector - start.translation.vector).norm();
        assert!(largest_m > 0.002, "{largest_m} m");
        let narrow = Reach {
            max_distance_m: 0.9 * largest_m,
            ..wide
        };
        assert_eq!(
            narrow.joints_for(&rotated, &joints),
            None,
            "the arm is there, but cannot return"
        );
    }

    #[test]
    fn joint_close_to_its_limit_may_stay_there() {
        let chain = Chain::from_urdf(PANDA, "panda_link0", "panda_link8").unwrap();
        let mut start = START;
        start[5] = 3.74;
        let reach = Reach {
            chain: &chain,
            start: &start,
            max_joint_change: 0.6,
            max_distance_m: 0.15,
        };
        let pose = chain.forward(&start).unwrap();
        assert_eq!(reach.joints_for(&pose, &start).as_deref(), Some(&start[..]));
    }
}
