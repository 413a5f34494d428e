//! Finds controllers of arms at known addresses.

use super::SearchPlan;
use crate::Rig;
use crate::init::findings::{ControllerKind, Findings, FoundController};
use crate::known_robots::{KNOWN_ROBOTS, KnownRobot};
use crate::open::{FCI_PORT, ur_config};
use drivers::ur::{FlangePose, RTDE_PORT, controller_version, inspect};
use drivers::{Error, NetworkAddress};
use std::net::TcpStream;
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
            None if is_usual && is_only_port(port(kind), |port| connects(usual, port)) => {
                let found = controller_at(kind, usual);
                // Nobody has said that there is a controller, so another service is none.
                findings
                    .controllers
                    .extend(Some(found).filter(FoundController::answers));
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

/// Whether a port of the usual address of a controller accepts connections at once.
fn connects(host: &str, port: u16) -> bool {
    connect(host, port, QUICK).is_ok()
}

/// The controller at an address, whether or not it answers.
pub(super) fn controller_at(kind: ControllerKind, address: &str) -> FoundController {
    let asked = match kind {
        // Only a controller agrees on the protocol.
        ControllerKind::Ur => match controller_version(address) {
            Ok(_) => Ok(()),
            // The address is shown before the reason.
            Err(Error::Rtde { reason, .. }) => Err(reason),
            Err(other) => Err(other.to_string()),
        },
        ControllerKind::Franka => connect(address, FCI_PORT, PATIENT),
    };
    FoundController {
        kind,
        address: address.to_owned(),
        robot: (kind == ControllerKind::Ur && asked.is_ok())
            .then(|| ur_robot(address))
            .flatten(),
        problem: asked.err(),
    }
}

/// The port of a controller if its address has none.
fn port(kind: ControllerKind) -> u16 {
    match kind {
        ControllerKind::Franka => FCI_PORT,
        ControllerKind::Ur => RTDE_PORT,
    }
}

/// Opens a connection and closes it. Nothing is sent, so the only client connection of a Franka
/// controller stays free.
fn connect(address: &str, default_port: u16, patience: Duration) -> Result<(), String> {
    let resolved = NetworkAddress::parse(address)?.resolve(default_port)?;
    let mut failure = String::new();
    for address in resolved {
        match TcpStream::connect_timeout(&address, patience) {
            Ok(_) => return Ok(()),
            Err(error) => failure = format!("cannot connect to {address}: {error}"),
        }
    }
    Err(failure)
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

    /// An address at which nothing listens: a port that was free a moment ago.
    fn silent_address() -> String {
        let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
        free.local_addr().expect("bound").to_string()
    }

    #[test]
    fn given_address_is_kept_although_nothing_answers() {
        let address = silent_address();
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
        assert_eq!((&*franka.address, franka.answers()), (&*address, false));
        let shown = franka.to_string();
        assert!(shown.contains("cannot connect"), "{shown}");
    }

    #[test]
    fn a_proxy_that_accepts_everything_is_no_controller() {
        assert!(is_only_port(FCI_PORT, |port| port == FCI_PORT));
        assert!(!is_only_port(FCI_PORT, |_| false));
        assert!(!is_only_port(FCI_PORT, |_| true));
    }

    #[test]
    fn a_server_of_another_kind_is_no_controller_of_universal_robots() {
        let server = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = server.local_addr().expect("bound").to_string();
        let closes = std::thread::spawn(move || drop(server.accept().expect("a client")));
        let found = controller_at(ControllerKind::Ur, &address);
        closes.join().expect("it has accepted");
        assert!(!found.answers() && found.robot.is_none(), "{found}");
    }

    #[test]
    fn ports_are_part_of_an_address() {
        let server = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let port = server.local_addr().expect("bound").port();
        assert_eq!(connect(&format!("127.0.0.1:{port}"), 1, PATIENT), Ok(()));
        assert_eq!(connect("127.0.0.1", port, PATIENT), Ok(()));
        assert!(connect("no host", port, PATIENT).is_err());
    }
}
