//! A steered arm or base with the server, the thread and the decisions of a run.

use super::arms::{BenchArm, BenchRobot, Moved};
use super::client::SteeringClient;
use super::scene::BenchScene;
use anyhow::{Context, Result};
use capture::config::Rig;
use capture::open::SteeredBase;
use session::{SteeringThread, drive_standalone, steer_standalone};
use std::cell::Cell;
use std::net::Ipv4Addr;
use std::sync::Arc;
use viz::{Hub, Server, ServerConfig};

/// A running rig. Dropping it brings the robot to rest, and ends all threads.
pub(super) struct SteeredRig {
    /// This field is dropped first, while the server and the robot still run.
    _steering: SteeringThread,
    pub(super) server: Server,
    pub(super) scene: Arc<BenchScene>,
    pub(super) robot: BenchRobot,
    n_clients: Cell<u64>,
}

impl SteeredRig {
    /// Starts the server and the decisions.
    ///
    /// # Errors
    ///
    /// If a thread or the server cannot be started, or the robot cannot be steered.
    pub(super) fn start(mut robot: BenchRobot) -> Result<Self> {
        let hub = Hub::new();
        let listen = (Ipv4Addr::LOCALHOST, 0).into();
        let server = Server::start(ServerConfig { listen }, hub.clone())?;
        let scene = Arc::<BenchScene>::default();
        let steering = match &mut robot.moved {
            Moved::Arm(arm) => {
                let rig = rig_of(arm)?;
                steer_standalone(&rig, arm.port.clone(), Arc::clone(&scene), &hub)?
            }
            Moved::Base(base) => {
                let drive = base.drive.take().context("the base is steered already")?;
                drive_standalone(&rig_of_base()?, SteeredBase::driven_by(drive), &hub)?
            }
        };
        Ok(Self {
            _steering: steering,
            server,
            scene,
            robot,
            n_clients: Cell::new(0),
        })
    }

    /// A new client.
    ///
    /// # Errors
    ///
    /// If the server does not accept it.
    pub(super) fn connect(&self) -> Result<SteeringClient> {
        let seed = self.n_clients.get();
        self.n_clients.set(seed + 1);
        SteeringClient::connect(self.server.address(), seed)
    }
}

/// A rig file with nothing but the arm. The bench opens the arm itself.
fn rig_of(arm: &BenchArm) -> Result<Rig> {
    let robot = arm.robot;
    let text = format!(
        "[arm]\ndriver = \"sim\"\nurdf = {:?}\nbase_link = {:?}\nflange_link = {:?}\n\
         joints = {:?}\n",
        robot.name, robot.base_link, robot.flange_link, robot.joints
    );
    Rig::parse("rig.toml", &text, robot.urdf, &[]).context("the rig of the bench")
}

/// A rig file with nothing but a base, for which nothing is seen. The bench opens the base itself.
fn rig_of_base() -> Result<Rig> {
    let text = "[arm]\ndriver = \"sim\"\nurdf = \"base\"\nbase_link = \"base\"\n\
                flange_link = \"base\"\n[base]\ndriver = \"sim\"\n\
                [base.motion]\nallow_unseen = true\n";
    let urdf = "<robot name=\"base\"><link name=\"base\"/></robot>";
    Rig::parse("rig.toml", text, urdf, &[]).context("the rig of the bench")
}

#[cfg(test)]
mod tests {
    use super::super::arms::{self, ArmKind};
    use super::*;

    #[test]
    fn the_rig_of_every_arm_has_its_joints() {
        for kind in ArmKind::available() {
            let robot = arms::start(kind).expect("a robot");
            let Moved::Arm(arm) = &robot.moved else {
                assert!(rig_of_base().expect("a rig").has_moving_base());
                continue;
            };
            let rig = rig_of(arm).expect("a rig");
            assert_eq!(rig.arm.joints, arm.chain.joint_names());
        }
    }
}
