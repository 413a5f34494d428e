//! Tests of the solver: solutions near the seed, ranges, free parts of poses, postures and
//! failures.

use super::robots_for_tests::{
    PANDA_READY, UR_READY, is_within, panda, panda_finger, random_joints, so101, ur3e, ur5e,
};
use super::{InverseSolver, Orientation, Target, Unsolved, pose_error};
use crate::{Chain, Transform};
use nalgebra::{UnitQuaternion, Vector3};
use numbers::random::Random;
use std::f64::consts::TAU;

fn panda_solver() -> (Chain, InverseSolver) {
    let chain = panda();
    (chain.clone(), InverseSolver::new(chain).unwrap())
}

fn distance(chain: &Chain, joints: &[f64], target: &Transform) -> f64 {
    pose_error(target, &chain.forward(joints).unwrap()).norm()
}

fn position(x: f64, y: f64, z: f64) -> Target {
    Target {
        base_from_tip: Transform::translation(x, y, z),
        orientation: Orientation::Free,
    }
}

#[test]
fn poses_near_the_start_are_reached_by_short_steps() {
    let (chain, mut solver) = panda_solver();
    let start = chain.forward(&PANDA_READY).unwrap();
    for ix in 0..60 {
        let value = |salt: usize| ((ix * 11 + salt * 5 + 2) as f64 * 1.3).sin();
        let translation = Vector3::new(value(0), value(1), value(2)) * 0.12;
        let rotation = Vector3::new(value(3), value(4), value(5)) * 0.45;
        let target = start * Transform::new(translation, rotation);
        let found = solver
            .solve_near(&Target::pose(target), &PANDA_READY)
            .unwrap();
        assert!(distance(&chain, &found, &target) < 1e-6);
        let moves = found.iter().zip(&PANDA_READY).map(|(a, b)| (a - b).abs());
        let largest = moves.fold(0.0, f64::max);
        assert!(is_within(&chain, &found) && largest < 2.0, "{found:?}");
    }
}

#[test]
fn joints_at_their_bounds_stay_there_and_others_take_over() {
    let (chain, mut free) = panda_solver();
    let limits = chain.limits().iter();
    let mut ranges: Vec<[f64; 2]> = limits.map(|limit| [limit.lower, limit.upper]).collect();
    let pose = chain.forward(&PANDA_READY).unwrap()
        * Transform::new(Vector3::new(0.02, 0.0, 0.0), Vector3::z() * 0.1);
    let target = Target::pose(pose);
    let found = free.solve_near(&target, &PANDA_READY).unwrap();
    assert!(
        (found[0] - PANDA_READY[0]).abs() > 1e-3,
        "the joint moves if it may"
    );

    ranges[0] = [PANDA_READY[0]; 2];
    let mut held = InverseSolver::within(chain.clone(), ranges.clone()).unwrap();
    for found in [
        held.solve_near(&target, &PANDA_READY).unwrap(),
        held.solve(&target, &PANDA_READY).unwrap(),
    ] {
        assert_eq!(found[0], PANDA_READY[0]);
        assert!(distance(&chain, &found, &pose) < 1e-6);
    }
    ranges[2] = ranges[0];
    ranges[4] = ranges[0];
    let mut four = InverseSolver::within(chain, ranges).unwrap();
    assert!(
        four.solve_near(&target, &PANDA_READY).is_err(),
        "four joints are not enough"
    );
}

#[test]
fn the_solution_turns_toward_the_seed() {
    let chain = ur5e();
    let mut solver = InverseSolver::new(chain.clone()).unwrap();
    let mut seed = UR_READY.to_vec();
    seed[5] += TAU - 0.6;
    let pose = chain.forward(&UR_READY).unwrap();
    let found = solver.solve(&Target::pose(pose), &seed).unwrap();
    assert!((found[5] - seed[5]).abs() < TAU / 2.0, "{found:?}");
    assert!(distance(&chain, &found, &pose) < 1e-6);
}

#[test]
fn singular_poses_are_found_from_singular_seeds() {
    let chain = ur5e();
    let mut solver = InverseSolver::new(chain.clone()).unwrap();
    // In the first posture, the arm is stretched. In the second posture, two axes of the wrist are
    // parallel. In the third posture, the wrist is above the base.
    for joints in [
        [0.0; 6],
        [0.3, -1.2, 1.5, -1.4, 0.0, 0.3],
        [0.0, -1.57, 0.0, -1.57, 0.0, 0.0],
    ] {
        let target = Target::pose(chain.forward(&joints).unwrap());
        for seed in [[0.0; 6], UR_READY, joints] {
            let found = solver.solve(&target, &seed).unwrap();
            assert!(distance(&chain, &found, &target.base_from_tip) < 1e-6);
        }
    }
}

#[test]
fn poses_out_of_reach_end_at_the_nearest_pose() {
    let mut random = Random::new(2);
    for chain in [panda(), ur3e(), so101()] {
        let mut solver = InverseSolver::new(chain.clone()).unwrap();
        let seed = random_joints(&chain, &mut random);
        for target in [
            position(3.0, 0.5, 0.4),
            position(-0.4, -2.0, 1.0),
            position(0.1, 0.0, 9.0),
        ] {
            let unsolved = solver.solve(&target, &seed).unwrap_err();
            let Unsolved::OutOfReach(nearest) = &unsolved else {
                panic!("{unsolved}");
            };
            assert!(is_within(&chain, &nearest.joints));
            let gap = target.gap(&chain.forward(&nearest.joints).unwrap());
            assert_eq!(gap, nearest.gap);
            for _ in 0..20_000 {
                let joints = random_joints(&chain, &mut random);
                let other = target.gap(&chain.forward(&joints).unwrap());
                // Descent ends where steps of 1e-6 no longer help.
                assert!(
                    other.distance_m > gap.distance_m - 1e-3,
                    "{other:?} {gap:?}"
                );
            }
        }
    }
}

#[test]
fn a_failure_names_the_joint_in_the_way_or_the_distance() {
    let chain = ur5e();
    let mut ranges = vec![[-TAU, TAU]; 6];
    ranges[2] = [0.2, 3.0];
    ranges[0] = [-0.2, 0.2];
    let mut solver = InverseSolver::within(chain.clone(), ranges).unwrap();
    let mut joints = UR_READY;
    joints[0] = 1.2;
    let target = Target::pose(chain.forward(&joints).unwrap());
    let unsolved = solver.solve(&target, &UR_READY).unwrap_err();
    let Unsolved::BeyondLimits { nearest, joints } = &unsolved else {
        panic!("{unsolved}");
    };
    assert!(
        joints
            .iter()
            .any(|beyond| beyond.joint == "shoulder_pan_joint"),
        "{unsolved}"
    );
    assert!(nearest.gap.distance_m > 0.01 || nearest.gap.angle_rad > 0.01);
    let text = unsolved.to_string();
    assert!(
        text.starts_with("the pose needs joint \"")
            && text.contains("within the ranges, the arm ends"),
        "{text}"
    );

    let distant = solver
        .solve(&position(0.0, 0.0, 5.0), &UR_READY)
        .unwrap_err()
        .to_string();
    assert!(
        distant.starts_with("the pose is out of reach: the arm ends 3."),
        "{distant}"
    );
}

#[test]
fn a_free_part_of_the_orientation_may_differ() {
    let chain = so101();
    let mut solver = InverseSolver::new(chain.clone()).unwrap();
    let joints = [0.4, -0.3, 0.5, 0.6, -0.8];
    let reachable = chain.forward(&joints).unwrap();
    let about_z = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 1.0);
    let about_x = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 0.7);
    for (change, orientation) in [
        (about_z, Orientation::Axis(Vector3::z_axis())),
        (about_x, Orientation::Axis(Vector3::x_axis())),
        (about_z * about_x, Orientation::Free),
    ] {
        let target = Target {
            base_from_tip: reachable * change,
            orientation,
        };
        let found = solver.solve(&target, &[0.0; 5]).unwrap();
        let pose = chain.forward(&found).unwrap();
        assert!(target.gap(&pose).distance_m < 1e-6 && target.gap(&pose).angle_rad < 1e-6);
    }
    let full = Target::pose(reachable * about_x * about_z * about_x);
    let unsolved = solver.solve(&full, &[0.0; 5]).unwrap_err();
    assert!(unsolved.nearest().is_some(), "{unsolved}");
}

#[test]
fn opposite_directions_of_an_axis_are_half_a_turn_apart() {
    let half_turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), std::f64::consts::PI);
    let target = Target {
        base_from_tip: Transform::identity(),
        orientation: Orientation::Axis(Vector3::z_axis()),
    };
    let gap = target.gap(&Transform::from_parts(Vector3::zeros().into(), half_turn));
    assert!(
        (gap.angle_rad - std::f64::consts::PI).abs() < 1e-9,
        "{gap:?}"
    );
    assert_eq!(target.gap(&Transform::identity()).angle_rad, 0.0);
}

#[test]
fn redundant_joints_move_toward_the_posture() {
    let chain = panda_finger();
    let posture = [0.0, -0.3, 0.0, -2.2, 0.0, 2.2, 0.8, 0.02];
    let mut plain = InverseSolver::new(chain.clone()).unwrap();
    let mut drawn = plain.clone().with_posture(&posture).unwrap();
    let off = |joints: &[f64]| -> f64 {
        let squares = joints.iter().zip(&posture).map(|(a, b)| (a - b).powi(2));
        squares.sum()
    };
    let mut random = Random::new(4);
    let [mut plain_sum, mut drawn_sum] = [0.0; 2];
    for _ in 0..100 {
        let joints = random_joints(&chain, &mut random);
        let target = Target::pose(chain.forward(&joints).unwrap());
        let found = drawn.solve(&target, &joints).unwrap();
        assert!(distance(&chain, &found, &target.base_from_tip) < 1e-6);
        drawn_sum += off(&found);
        plain_sum += off(&plain.solve(&target, &joints).unwrap());
    }
    assert!(drawn_sum < 0.9 * plain_sum, "{drawn_sum} {plain_sum}");
}

#[test]
fn the_same_input_gives_the_same_bits() {
    let chain = ur3e();
    let mut used = InverseSolver::new(chain.clone()).unwrap();
    let mut random = Random::new(6);
    for _ in 0..100 {
        let target = Target::pose(chain.forward(&random_joints(&chain, &mut random)).unwrap());
        let mut fresh = InverseSolver::new(chain.clone()).unwrap();
        assert_eq!(
            used.solve(&target, &UR_READY),
            fresh.solve(&target, &UR_READY)
        );
    }
}

#[test]
fn a_chain_without_joints_has_one_pose() {
    let chain =
        Chain::from_urdf(super::robots_for_tests::PANDA, "panda_link7", "panda_link8").unwrap();
    let mut solver = InverseSolver::new(chain).unwrap();
    let pose = Target::pose(Transform::translation(0.0, 0.0, 0.107));
    assert_eq!(solver.solve(&pose, &[]), Ok(Vec::new()));
    assert!(solver.solve(&position(0.0, 0.0, 0.2), &[]).is_err());
}

#[test]
fn invalid_input_is_rejected() {
    let (chain, mut solver) = panda_solver();
    let pose = Target::pose(Transform::identity());
    let mut message = |target: &Target, seed: &[f64]| {
        let unsolved = solver.solve(target, seed).unwrap_err();
        assert!(unsolved.nearest().is_none());
        unsolved.to_string()
    };
    let text = message(&pose, &PANDA_READY[..3]);
    assert!(
        text.starts_with("3 joint values given, the chain has 7"),
        "{text}"
    );
    let text = message(&pose, &[f64::NAN; 7]);
    assert!(text.ends_with("NaN is not a finite number"), "{text}");
    let text = message(&position(f64::INFINITY, 0.0, 0.0), &PANDA_READY);
    assert!(text.contains("is inf, not a finite number"), "{text}");

    assert!(InverseSolver::within(chain.clone(), vec![[0.0, 1.0]; 3]).is_err());
    let mut ranges = vec![[0.0, 1.0]; 7];
    ranges[1] = [1.0, 0.0];
    let error = InverseSolver::within(chain.clone(), ranges)
        .unwrap_err()
        .to_string();
    assert_eq!(
        error,
        r#"joint "panda_joint2": its range from 1 to 0 contains no value"#
    );
    assert!(InverseSolver::within(chain, vec![[f64::NAN; 2]; 7]).is_err());
}
