//! The robots of the tests.

use crate::Chain;
use numbers::random::Random;
use std::f64::consts::PI;

pub(super) const PANDA: &str = include_str!("../../../rigs/robots/panda.urdf");
const FR3: &str = include_str!("../../../rigs/robots/fr3.urdf");
const UR3E: &str = include_str!("../../../rigs/robots/ur3e.urdf");
const UR5E: &str = include_str!("../../../rigs/robots/ur5e.urdf");
const UR10E: &str = include_str!("../../../rigs/robots/ur10e.urdf");
const SO101: &str = include_str!("../../../rigs/robots/so101.urdf");
const MOBILE_ARM: &str = include_str!("../../../rigs/robots/mobile-arm.urdf");
const PANDA_WITH_HAND: &str = include_str!("../../tests/data/panda.urdf");
const UR5E_DH: &str = include_str!("../../tests/data/ur5e-dh.urdf");

/// Joint values of a Panda in the middle of its workspace.
pub(super) const PANDA_READY: [f64; 7] = [0.0, -0.3, 0.0, -2.2, 0.0, 2.2, 0.8];
/// Joint values of an arm of Universal Robots in the middle of its workspace.
pub(super) const UR_READY: [f64; 6] = [0.2, -1.2, 1.5, -1.4, -1.3, 0.3];

fn chain(urdf: &str, base: &str, tip: &str) -> Chain {
    Chain::from_urdf(urdf, base, tip).expect("the file is sound")
}

pub(super) fn panda() -> Chain {
    chain(PANDA, "panda_link0", "panda_link8")
}

pub(super) fn fr3() -> Chain {
    chain(FR3, "fr3_link0", "fr3_link8")
}

pub(super) fn panda_on_base() -> Chain {
    chain(MOBILE_ARM, "base", "panda_link8")
}

pub(super) fn panda_tool() -> Chain {
    chain(PANDA_WITH_HAND, "link0", "tcp")
}

/// A Panda whose tip is a finger. The chain has eight joints, and a prismatic joint that follows
/// another joint.
pub(super) fn panda_finger() -> Chain {
    chain(PANDA_WITH_HAND, "link0", "finger_right")
}

pub(super) fn ur3e() -> Chain {
    chain(UR3E, "base_link", "tool0")
}

pub(super) fn ur5e() -> Chain {
    chain(UR5E, "base_link", "tool0")
}

pub(super) fn ur5e_dh() -> Chain {
    chain(UR5E_DH, "base_link", "tool0")
}

pub(super) fn ur10e() -> Chain {
    chain(UR10E, "base_link", "tool0")
}

pub(super) fn so101() -> Chain {
    chain(SO101, "base_link", "gripper_frame_link")
}

/// Random joint values within the ranges, and within one turn if there is no range.
pub(super) fn random_joints(chain: &Chain, random: &mut Random) -> Vec<f64> {
    let limits = chain.limits().iter();
    limits
        .map(|limit| random.uniform(limit.lower.max(-2.0 * PI), limit.upper.min(2.0 * PI)))
        .collect()
}

/// The middle of the ranges.
pub(super) fn middle(chain: &Chain) -> Vec<f64> {
    let limits = chain.limits().iter();
    limits
        .map(|limit| 0.5 * (limit.lower.max(-2.0 * PI) + limit.upper.min(2.0 * PI)))
        .collect()
}

/// Whether joint values are within the ranges of the URDF.
pub(super) fn is_within(chain: &Chain, joints: &[f64]) -> bool {
    let mut limits = chain.limits().iter().zip(joints);
    limits.all(|(limit, value)| limit.lower <= *value && *value <= limit.upper)
}
