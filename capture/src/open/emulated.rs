//! Opens simulated cameras on an arm whose driver is real. The driver connects to an emulated
//! controller, whose motors move the simulated arm in real time.

use super::arm_config::controller_chain;
use super::real;
use super::simulated::unlimited;
use crate::config::{ArmDriver, Rig};
use anyhow::bail;
use drivers::franka::FciVersion;
use drivers::franka::emulated::{EmulatedRobot, Limits, RobotConfig};
use drivers::motion::{JointTarget, Motion, MovableArm, SteeringPort};
use drivers::{Arm, Camera, Error, clock};
use kinematics::{JointState, Transform};
use sim::MotorHistory;
use sim::wire::{JointTrack, emulate_fci};
use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

/// Time for which the controller waits for each answer of the driver. It is long, because
/// controller and driver share this process, and because the motion must not depend on the load of
/// the computer.
const ANSWER_WAIT: Duration = Duration::from_millis(15);

/// An arm that can be moved, and cameras that show it.
type ArmAndCameras = (Box<dyn MovableArm>, Vec<Box<dyn Camera>>);

/// Opens the cameras, and the arm for motion. The address of the arm becomes that of the controller.
pub(super) fn open(rig: &mut Rig) -> anyhow::Result<ArmAndCameras> {
    if rig.arm.driver != ArmDriver::Franka {
        bail!(
            "sim.emulate_arm: only a controller of the driver \"franka\" can be emulated for a simulated camera"
        );
    }
    let mut simulated = sim::open(&unlimited(rig)?)?;
    let motors = MotorHistory::default();
    let config = RobotConfig {
        // With port 0, the system chooses a free port, so that several runs do not collide.
        address: SocketAddr::from((Ipv4Addr::LOCALHOST, 0)),
        // This is the version of the Panda in the simulated scenes.
        version: FciVersion::V5,
        chain: controller_chain(rig)?,
        flange_from_tool: Transform::identity(),
        limits: Limits::panda(),
    };
    // The arm starts at the position of the simulated arm. Otherwise, it would jump at the first
    // image.
    let track = JointTrack::at_rest(simulated.start_position()?)?;
    let controller = emulate_fci(track, config, ANSWER_WAIT, Some(motors.clone()))?;
    rig.arm.address = controller.address().to_string();
    log::info!(
        "the arm is moved by an emulated Franka controller at {}",
        rig.arm.address
    );
    let cameras = simulated.into_motorized(motors, clock::now())?;
    let arm = Box::new(EmulatedArm {
        arm: real::movable_arm(rig)?,
        _controller: controller,
    });
    Ok((arm, cameras))
}

/// A driver with the emulated controller that it is connected to.
struct EmulatedArm {
    /// This field is dropped first, while the controller still answers.
    arm: Box<dyn MovableArm>,
    _controller: EmulatedRobot,
}

impl Arm for EmulatedArm {
    fn joint_names(&self) -> &[String] {
        self.arm.joint_names()
    }

    fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
        self.arm.read(timeout)
    }
}

impl MovableArm for EmulatedArm {
    fn command(&mut self, target: &JointTarget) -> Result<JointTarget, Error> {
        self.arm.command(target)
    }

    fn motion(&self) -> Motion {
        self.arm.motion()
    }

    fn stop(&mut self) -> Result<(), Error> {
        self.arm.stop()
    }

    fn recover(&mut self) -> Result<(), Error> {
        self.arm.recover()
    }

    fn steering_port(&mut self, brake_factor: f64) -> Result<SteeringPort, Error> {
        self.arm.steering_port(brake_factor)
    }
}
