//! Steers an arm or a base without a run.

use super::base::PreparedBase;
use super::surroundings::Surroundings;
use super::{PreparedArm, PreparedSteering, SteeringThread, robot};
use capture::config::Rig;
use capture::open::{SteeredArm, SteeredBase};
use drivers::motion::SteeringPort;
use std::sync::Arc;
use viz::Hub;

/// Lets clients of the hub steer an arm, with the thread and the decisions of a run, but without
/// cameras and training. Benches measure with it.
///
/// * `rig`: the robot and the settings of steering. Its robot description must not name mesh files.
/// * `port`: the port of an arm that holds its position, in the order of the joints of `rig`.
/// * `scene`: the surroundings of the arm.
///
/// # Errors
///
/// If the robot description has no shapes, the arm reports nothing, its limits do not match the
/// robot, or no thread can be started.
pub fn steer_standalone<S: Surroundings>(
    rig: &Rig,
    port: SteeringPort,
    scene: Arc<S>,
    hub: &Hub,
) -> anyhow::Result<SteeringThread> {
    let robot = robot::chain_and_body(rig)?;
    let prepared = PreparedSteering {
        arm: Some(PreparedArm::new(SteeredArm::holding(port), rig, robot)),
        scene: Some(scene),
        ..PreparedSteering::of(rig)
    };
    prepared.start(hub, None)
}

/// Lets clients of the hub drive a base, like [`steer_standalone`].
///
/// * `rig`: the settings of the base. It must allow unseen space, because nothing is seen.
///
/// # Errors
///
/// If the configuration is not valid, or no thread can be started.
pub fn drive_standalone(rig: &Rig, base: SteeredBase, hub: &Hub) -> anyhow::Result<SteeringThread> {
    let prepared: PreparedSteering = PreparedSteering {
        base: Some(PreparedBase::new(base, rig, None, false)?),
        ..PreparedSteering::of(rig)
    };
    prepared.start(hub, None)
}
