//! Random reachable poses are found, for every robot that is shipped or used in tests.

use super::robots_for_tests::{
    fr3, is_within, middle, panda, panda_finger, panda_on_base, panda_tool, random_joints, so101,
    ur3e, ur5e, ur5e_dh, ur10e,
};
use super::{InverseSolver, Orientation, Target};
use crate::Chain;
use nalgebra::Vector3;
use numbers::random::Random;

const N_POSES: u32 = 10_000;
/// Meters and radians.
const MAX_ERROR: f64 = 1e-6;
const MIN_FOUND_FRAC: f64 = 0.995;

/// Checks that the poses of random joint values are found, starting in the middle of the ranges.
fn check(chain: Chain, orientation: Orientation) {
    let mut random = Random::new(7);
    let seed = middle(&chain);
    let mut solver = InverseSolver::new(chain.clone()).unwrap();
    let mut n_found = 0;
    for _ in 0..N_POSES {
        let joints = random_joints(&chain, &mut random);
        let target = Target {
            base_from_tip: chain.forward(&joints).unwrap(),
            orientation,
        };
        match solver.solve(&target, &seed) {
            Ok(found) => {
                let gap = target.gap(&chain.forward(&found).unwrap());
                assert!(gap.distance_m.max(gap.angle_rad) < MAX_ERROR, "{gap:?}");
                assert!(is_within(&chain, &found), "{found:?}");
                n_found += 1;
            }
            Err(unsolved) => {
                let nearest = unsolved.nearest().expect("the input is valid");
                assert!(is_within(&chain, &nearest.joints), "{nearest:?}");
            }
        }
    }
    let found_frac = f64::from(n_found) / f64::from(N_POSES);
    eprintln!("{}: {found_frac}", chain.tip_link());
    assert!(found_frac >= MIN_FOUND_FRAC, "{found_frac}");
}

#[test]
fn poses_of_a_panda_are_found() {
    check(panda(), Orientation::Full);
}

#[test]
fn poses_of_an_fr3_are_found() {
    check(fr3(), Orientation::Full);
}

#[test]
fn poses_of_a_panda_on_a_base_are_found() {
    check(panda_on_base(), Orientation::Full);
}

#[test]
fn poses_of_a_tool_on_a_panda_are_found() {
    check(panda_tool(), Orientation::Full);
}

#[test]
fn poses_of_a_finger_with_a_mimic_joint_are_found() {
    check(panda_finger(), Orientation::Full);
}

#[test]
fn poses_of_a_ur3e_are_found() {
    check(ur3e(), Orientation::Full);
}

#[test]
fn poses_of_a_ur5e_are_found() {
    check(ur5e(), Orientation::Full);
    check(ur5e_dh(), Orientation::Full);
}

#[test]
fn poses_of_a_ur10e_are_found() {
    check(ur10e(), Orientation::Full);
}

#[test]
fn poses_of_an_so101_are_found() {
    check(so101(), Orientation::Full);
    check(so101(), Orientation::Axis(Vector3::z_axis()));
    check(so101(), Orientation::Free);
}
