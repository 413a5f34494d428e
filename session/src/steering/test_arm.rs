//! The arm of the tests: a Panda.

use drivers::motion::MotionLimits;
use kinematics::Chain;
use kinematics::urdf::Robot;
use steering::Body;

pub(in crate::steering) const PANDA: &str = include_str!("../../../rigs/robots/panda.urdf");
/// A posture with space around it, radians.
pub(in crate::steering) const START: [f64; 7] = [0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8];

/// The chain of the arm up to its flange, its shapes, and the limits of its motions.
pub(in crate::steering) fn panda() -> (Chain, Body, Vec<MotionLimits>) {
    let urdf = Robot::parse(PANDA).expect("a robot");
    let chain = Chain::new(&urdf, "panda_link0", "panda_link8").expect("a chain");
    let body = Body::new(&urdf, &chain, &|_| None).expect("it has shapes");
    let joints = chain.limits().iter();
    let limits = joints.map(|joint| MotionLimits::new(joint, 1.0, 0.5, 0.1));
    let limits = limits.collect();
    (chain, body, limits)
}
