//! The closed form agrees with forward kinematics, and is used for the right chains.

use super::franka::FrankaArm;
use super::robots_for_tests::{
    PANDA, PANDA_READY, fr3, panda, panda_finger, panda_on_base, panda_tool, random_joints, so101,
    ur5e,
};
use super::{InverseSolver, Target};
use crate::{Chain, Transform};
use nalgebra::Vector3;
use numbers::random::Random;
use std::f64::consts::TAU;

/// Meters and radians.
const CLOSE: f64 = 1e-9;

fn difference(a: &Transform, b: &Transform) -> f64 {
    let gap = Target::pose(*a).gap(b);
    gap.distance_m.max(gap.angle_rad)
}

/// Largest difference between joint values, apart from full turns.
fn turn_difference(a: &[f64], b: &[f64]) -> f64 {
    let off = |(a, b): (&f64, &f64)| (a - b - TAU * ((a - b) / TAU).round()).abs();
    a.iter().zip(b).map(off).fold(0.0, f64::max)
}

#[test]
fn all_solutions_have_the_pose_and_one_has_the_joints() {
    for chain in [panda(), fr3(), panda_on_base(), panda_tool()] {
        let arm = FrankaArm::of(&chain).expect("a Franka arm");
        let mut random = Random::new(3);
        let mut n_solutions = 0;
        for _ in 0..10_000 {
            let joints = random_joints(&chain, &mut random);
            let pose = chain.forward(&joints).unwrap();
            let solutions = arm.solutions(&pose, joints[6]);
            for (branch, found) in solutions.iter() {
                let off = difference(&pose, &chain.forward(&found).unwrap());
                assert!(off < CLOSE, "{branch:?}: {off:e}");
                n_solutions += 1;
            }
            let joints: [f64; 7] = joints.try_into().unwrap();
            let branch = arm.branch(&joints, &pose).expect("the pose of the joints");
            let same = solutions.on_branch(branch).expect("its own branch");
            assert!(
                turn_difference(&same, &joints) < 1e-6,
                "{same:?} {joints:?}"
            );
        }
        assert!(n_solutions > 40_000, "{n_solutions}");
    }
}

#[test]
fn solutions_of_different_branches_differ() {
    let chain = panda();
    let arm = FrankaArm::of(&chain).unwrap();
    let pose = chain.forward(&PANDA_READY).unwrap();
    let solutions: Vec<_> = arm.solutions(&pose, PANDA_READY[6]).iter().collect();
    assert!(solutions.len() >= 4, "{solutions:?}");
    for (ix, (branch, joints)) in solutions.iter().enumerate() {
        assert_eq!(arm.branch(joints, &pose), Some(*branch));
        for (_, other) in &solutions[..ix] {
            assert!(turn_difference(joints, other) > 1e-3);
        }
    }
}

#[test]
fn a_branch_stays_continuous_along_a_path() {
    let chain = panda();
    let arm = FrankaArm::of(&chain).unwrap();
    let start = chain.forward(&PANDA_READY).unwrap();
    let branch = arm.branch(&PANDA_READY, &start).unwrap();
    let mut last = PANDA_READY;
    for step in 0..1000 {
        let angle = TAU * f64::from(step) / 1000.0;
        let offset = Vector3::new(angle.sin(), 1.0 - angle.cos(), 0.5 * angle.sin()) * 0.08;
        let pose = Transform::translation(offset.x, offset.y, offset.z) * start;
        let last_rad = PANDA_READY[6] + 0.2 * angle.sin();
        let joints = arm.solutions(&pose, last_rad).on_branch(branch).unwrap();
        assert!(
            turn_difference(&joints, &last) < 0.05,
            "step {step}: {joints:?} {last:?}"
        );
        last = joints;
    }
}

#[test]
fn other_chains_are_not_taken_for_a_franka_arm() {
    for chain in [ur5e(), so101(), panda_finger()] {
        assert!(FrankaArm::of(&chain).is_none(), "{}", chain.tip_link());
    }
    for (from, to) in [
        // These chains have a forearm beside the upper arm, an elbow that bends to the other side,
        // and a tilted axis.
        (r#"xyz="-0.0825 0.384 0.0""#, r#"xyz="-0.0825 0.384 0.05""#),
        (
            r#"<origin xyz="0.0825 0.0 0.0" rpy="1.57"#,
            r#"<origin xyz="0.0825 0.0 0.0" rpy="-1.57"#,
        ),
        (
            r#"<origin xyz="0.0 0.0 0.0" rpy="1.57"#,
            r#"<origin xyz="0.0 0.0 0.0" rpy="1.47"#,
        ),
    ] {
        let urdf = PANDA.replace(from, to);
        assert_ne!(urdf, PANDA, "{from}");
        let chain = Chain::from_urdf(&urdf, "panda_link0", "panda_link8").unwrap();
        assert!(FrankaArm::of(&chain).is_none(), "{to}");
    }
}

#[test]
fn other_lengths_are_measured_and_calibrated_arms_are_corrected() {
    for (from, to) in [
        // These chains are another arm of the same kind, and a calibrated Panda.
        (r#"xyz="0.0825 0.0 0.0""#, r#"xyz="0.11 0.0 0.0""#),
        (
            r#"xyz="0.0825 0.0 0.0" rpy="1.5707"#,
            r#"xyz="0.0831 0.0007 -0.0004" rpy="1.5721"#,
        ),
    ] {
        let urdf = PANDA.replace(from, to);
        assert_ne!(urdf, PANDA, "{from}");
        let chain = Chain::from_urdf(&urdf, "panda_link0", "panda_link8").unwrap();
        let mut solver = InverseSolver::new(chain.clone()).unwrap();
        assert!(solver.franka_arm().is_some(), "{to}");
        let mut random = Random::new(5);
        for _ in 0..200 {
            let target = Target::pose(chain.forward(&random_joints(&chain, &mut random)).unwrap());
            let found = solver.solve(&target, &PANDA_READY).unwrap();
            let off = difference(&target.base_from_tip, &chain.forward(&found).unwrap());
            assert!(off < 1e-6, "{off:e}");
        }
    }
}

#[test]
fn the_search_returns_to_the_seed_and_finds_no_farther_solution_than_a_fine_grid() {
    let chain = panda();
    let arm = FrankaArm::of(&chain).unwrap();
    let mut solver = InverseSolver::new(chain.clone()).unwrap();
    let ready = Target::pose(chain.forward(&PANDA_READY).unwrap());
    let found = solver.solve(&ready, &PANDA_READY).unwrap();
    assert!(turn_difference(&found, &PANDA_READY) < 0.05, "{found:?}");

    let cost = |joints: &[f64]| -> f64 {
        let values = joints.iter().zip(&PANDA_READY).enumerate();
        values
            .map(|(ix, (value, seed))| {
                (value - seed).powi(2) + solver.comfort.cost_of(&solver.bounds, ix, *value)
            })
            .sum()
    };
    let mut random = Random::new(9);
    let mut n_close = 0;
    for _ in 0..100 {
        let pose = chain.forward(&random_joints(&chain, &mut random)).unwrap();
        let found = solver
            .clone()
            .solve(&Target::pose(pose), &PANDA_READY)
            .unwrap();
        let [lower, upper] = solver.bounds.range(6);
        let mut least = f64::INFINITY;
        for step in 0..=500 {
            let last_rad = lower + (upper - lower) * f64::from(step) / 500.0;
            for (_, joints) in arm.solutions(&pose, last_rad).iter() {
                let placed: Option<Vec<f64>> = joints
                    .iter()
                    .enumerate()
                    .map(|(ix, value)| solver.bounds.nearest_turn(ix, *value, PANDA_READY[ix]))
                    .collect();
                least = least.min(placed.map_or(f64::INFINITY, |joints| cost(&joints)));
            }
        }
        n_close += u32::from(cost(&found) < 1.1 * least + 0.1);
    }
    // The grid of the search is coarse, so it may miss a narrow solution.
    assert!(n_close >= 90, "{n_close}");
}
