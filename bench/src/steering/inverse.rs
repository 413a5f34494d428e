//! Speed and success of inverse kinematics for the robots that are part of the program.

use anyhow::Result;
use capture::known_robots::{KNOWN_ROBOTS, KnownRobot};
use kinematics::Chain;
use kinematics::inverse::{InverseSolver, Target};
use numbers::random::Random;
use report::Table;
use serde::Serialize;
use std::f64::consts::PI;
use std::hint::black_box;
use std::time::Instant;

/// Largest error of a solution: a micrometer, or a millionth of a radian.
const MAX_ERROR: f64 = 1e-6;

/// Rates of one robot.
#[derive(Clone, Debug, Serialize)]
pub struct InverseRates {
    /// The robot.
    pub robot: &'static str,
    /// Number of reachable poses.
    pub n_poses: u32,
    /// Fraction of them for which joint values within the ranges were found, 0 to 1.
    pub success_frac: f64,
    /// Poses per second.
    pub poses_per_sec: f64,
}

/// Solves random reachable poses of every robot, from the middle of its ranges.
///
/// # Errors
///
/// If a robot description is invalid.
pub(super) fn measure(n_poses: u32) -> Result<Vec<InverseRates>> {
    KNOWN_ROBOTS
        .iter()
        .map(|robot| rates_of(robot, n_poses))
        .collect()
}

fn rates_of(robot: &'static KnownRobot, n_poses: u32) -> Result<InverseRates> {
    let chain = Chain::from_urdf(robot.urdf, robot.base_link, robot.flange_link)?;
    let mut random = Random::new(1);
    let ranges: Vec<[f64; 2]> = chain
        .limits()
        .iter()
        .map(|limit| [limit.lower.max(-PI), limit.upper.min(PI)])
        .collect();
    let seed: Vec<f64> = ranges
        .iter()
        .map(|range| 0.5 * (range[0] + range[1]))
        .collect();
    let mut targets = Vec::new();
    for _ in 0..n_poses {
        let ranges = ranges.iter();
        let joints: Vec<f64> = ranges
            .map(|range| random.uniform(range[0], range[1]))
            .collect();
        targets.push(Target::pose(chain.forward(&joints)?));
    }
    let mut solver = InverseSolver::new(chain.clone())?;
    let mut solutions = Vec::with_capacity(targets.len());
    let began = Instant::now();
    for target in &targets {
        solutions.push(solver.solve(black_box(target), &seed).ok());
    }
    let secs = began.elapsed().as_secs_f64();
    // The results are checked outside of the measured time.
    let n_found = targets
        .iter()
        .zip(&solutions)
        .filter(|(target, joints)| is_solution(&chain, target, joints.as_deref()))
        .count();
    Ok(InverseRates {
        robot: robot.title,
        n_poses,
        success_frac: n_found as f64 / f64::from(n_poses),
        poses_per_sec: f64::from(n_poses) / secs,
    })
}

/// Whether the joint values are within their ranges and have the pose.
fn is_solution(chain: &Chain, target: &Target, joints: Option<&[f64]>) -> bool {
    let Some(joints) = joints else {
        return false;
    };
    let is_within = joints
        .iter()
        .zip(chain.limits())
        .all(|(joint, limit)| *joint >= limit.lower && *joint <= limit.upper);
    let pose = chain.forward(joints).ok();
    is_within
        && pose.is_some_and(|pose| {
            let gap = target.gap(&pose);
            gap.distance_m <= MAX_ERROR && gap.angle_rad <= MAX_ERROR
        })
}

/// The table of all robots.
pub(super) fn table(rates: &[InverseRates]) -> Table {
    let head = [
        "robot",
        "reachable poses",
        "found, %",
        "poses per second",
        "us per pose",
    ];
    let cells = |rates: &InverseRates| {
        vec![
            rates.robot.to_owned(),
            rates.n_poses.to_string(),
            format!("{:.2}", 100.0 * rates.success_frac),
            format!("{:.0}", rates.poses_per_sec),
            format!("{:.1}", 1e6 / rates.poses_per_sec),
        ]
    };
    Table {
        title: "Inverse kinematics".to_owned(),
        head: head.map(str::to_owned).to_vec(),
        rows: rates.iter().map(cells).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_joint_values_within_the_ranges_and_with_the_pose_count() {
        let robot = KnownRobot::find("panda").expect("a known robot");
        let chain = Chain::from_urdf(robot.urdf, robot.base_link, robot.flange_link);
        let chain = chain.expect("a chain");
        let joints = [0.1, -0.5, 0.2, -2.2, 0.3, 1.8, 0.8];
        let target = Target::pose(chain.forward(&joints).expect("seven joints"));
        assert!(is_solution(&chain, &target, Some(&joints)));
        let mut other = joints;
        other[6] += 1e-4;
        assert!(!is_solution(&chain, &target, Some(&other)));
        // The same pose, beyond the range of the last joint.
        other = joints;
        other[6] += std::f64::consts::TAU;
        assert!(!is_solution(&chain, &target, Some(&other)));
        assert!(!is_solution(&chain, &target, None));
    }

    #[test]
    fn every_robot_of_the_program_is_solved() {
        let rates = measure(20).expect("sound robots");
        assert_eq!(rates.len(), KNOWN_ROBOTS.len());
        for rates in rates {
            assert!(rates.success_frac > 0.9, "{rates:?}");
        }
    }
}
