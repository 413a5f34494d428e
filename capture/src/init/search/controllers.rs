//! Finds controllers of arms at known addresses.

use super::SearchPlan;
use crate::Rig;
use crate::init::findings::{ControllerKind, Findings, FoundController};
use crate::known_robots::{KNOWN_ROBOTS, KnownRobot};
use crate::open::{FCI_PORT, ur_config};
use drivers::ur::{FlangePose, RTDE_PORT, inspect};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

/// Address of a Franka controller in Franka's documentation of FCI ("Getting started").
const FRANKA_ADDRESS: &str = "172.16.0.2";
/// Address of a controller in the documentation of the ROS driver of Universal Robots, and of their
/// simulator in a container.
const UR_ADDRESS: &str = "192.168.56.101";
/// A port that no controller uses. Its service, TCPMUX, is historic (RFC 7805).
const UNUSED_PORT: u16 = 1;
/// Time for an address that nobody has given. A controller in the same network answers within
/// milliseconds.
const QUICK: Duration = Duration::from_millis(300);
/// Time for an address that the user has given.
const PATIENT: Duration = Duration::from_secs(2);

/// Adds the controllers.
pub(super) fn find(plan: &SearchPlan, findings: &mut Findings) {
    // Whoever gives an address knows which robot the rig has.
    let is_usual = plan.franka.is_none() && plan.ur.is_none();
    let searched = [
        (ControllerKind::Franka, &plan.franka, FRANKA_ADDRESS),
        (ControllerKind::Ur, &plan.ur, UR_ADDRESS),
    ];
    for (kind, given, usual) in searched {
        match given {
            Some(address) => findings.controllers.push(controller_at(kind, address)),
            None if is_usual && is_only_port(port(kind), |port| answers(usual, port, QUICK)) => {
                findings.controllers.push(controller_at(kind, usual));
            }
            None => {}
        }
    }
}

/// Whether something answers on the port of a controller, and not on every port. Some networks have
/// a proxy that accepts connections to any address, whether or not there is a computer.
fn is_only_port(port: u16, answers: impl Fn(u16) -> bool) -> bool {
    answers(port) && !answers(UNUSED_PORT)
}

/// The controller at an address, whether or not it answers.
pub(super) fn controller_at(kind: ControllerKind, address: &str) -> FoundController {
    let answers = answers(address, port(kind), PATIENT);
    let is_ur = kind == ControllerKind::Ur;
    FoundController {
        kind,
        address: address.to_owned(),
        answers,
        robot: (answers && is_ur).then(|| ur_robot(address)).flatten(),
    }
}

/// The port of a controller if its address has none.
fn port(kind: ControllerKind) -> u16 {
    match kind {
        ControllerKind::Franka => FCI_PORT,
        ControllerKind::Ur => RTDE_PORT,
    }
}

/// Whether a port accepts connections. Nothing is sent, so the only client connection of a Franka
/// controller stays free.
fn answers(address: &str, port: u16, patience: Duration) -> bool {
    let has_port =
        address.starts_with('[') && address.contains("]:") || address.matches(':').count() == 1;
    let resolved = if has_port {
        address.to_socket_addrs()
    } else {
        (address.trim_matches(['[', ']']), port).to_socket_addrs()
    };
    resolved.is_ok_and(|mut addresses| {
        addresses.any(|address| TcpStream::connect_timeout(&address, patience).is_ok())
    })
}

/// The known robot whose flange is where the controller reports it. `None` if none fits, or if the
/// joints have no power.
fn ur_robot(address: &str) -> Option<&'static KnownRobot> {
    let robots = KNOWN_ROBOTS
        .iter()
        .filter(|robot| ControllerKind::Ur.controls(robot));
    let mut similar = None;
    for robot in robots {
        match flange_pose(address, robot) {
            Ok(FlangePose::Same(_)) => return Some(robot),
            // A controller uses the measured dimensions of its robot, and known robots have the
            // nominal ones.
            Ok(FlangePose::Doubtful(_)) => similar = similar.or(Some(robot)),
            Ok(FlangePose::Different(_)) => {}
            Err(error) => {
                log::debug!("{address}: {error:#}");
                return None;
            }
        }
    }
    similar
}

/// Compares the flange of a known robot with that of a controller.
fn flange_pose(address: &str, robot: &KnownRobot) -> anyhow::Result<FlangePose> {
    let text = format!(
        "[arm]\ndriver = \"ur\"\naddress = {}\nurdf = {}\n\
         [camera.any]\ndriver = \"sim\"\nsize_px = [64, 64]\nrate_hz = 1\nparent = \"flange\"\n\
         intrinsics = {{ focal_px = [64, 64], principal_px = [32, 32] }}\n",
        toml::Value::from(address),
        toml::Value::from(robot.reference())
    );
    let rig = Rig::parse("the controller", &text, "", &[])?;
    Ok(inspect(&ur_config(&rig)?)?.flange)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::TcpListener;

    #[test]
    fn given_address_is_kept_although_nothing_answers() {
        // A port that was free a moment ago.
        let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = free.local_addr().expect("bound").to_string();
        drop(free);
        let plan = SearchPlan {
            franka: Some(address.clone()),
            ..SearchPlan::default()
        };
        let mut findings = Findings::default();
        find(&plan, &mut findings);
        let franka = findings
            .controllers
            .iter()
            .find(|controller| controller.kind == ControllerKind::Franka)
            .expect("it was given");
        assert_eq!((&*franka.address, franka.answers), (&*address, false));
    }

    #[test]
    fn a_proxy_that_accepts_everything_is_no_controller() {
        assert!(is_only_port(FCI_PORT, |port| port == FCI_PORT));
        assert!(!is_only_port(FCI_PORT, |_| false));
        assert!(!is_only_port(FCI_PORT, |_| true));
    }

    #[test]
    fn ports_are_part_of_an_address() {
        let server = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let port = server.local_addr().expect("bound").port();
        assert!(answers(&format!("127.0.0.1:{port}"), 1, PATIENT));
        assert!(answers("127.0.0.1", port, PATIENT));
        assert!(!answers("no host", port, PATIENT));
    }
}
