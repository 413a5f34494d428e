//! Fuzz target for robot descriptions: computes the kinematics of every chain.
#![no_main]
use kinematics::Chain;
use kinematics::urdf::Robot;

libfuzzer_sys::fuzz_target!(|text: &str| {
    let Ok(robot) = Robot::parse(text) else { return };
    for shape in robot.links().iter().flat_map(|link| robot.visuals(link).iter().chain(robot.collisions(link))) {
        assert!(kinematics::transform::is_finite(&shape.link_from_shape));
    }
    let Ok(root) = robot.root() else { return };
    for tip in robot.links() {
        let Ok(chain) = Chain::new(&robot, root, tip) else { continue };
        let q = vec![0.5; chain.n_joints()];
        let _ = chain.forward(&q);
        let _ = chain.jacobian(&q);
        let _ = chain.tip_twist(&q, &q);
    }
});
