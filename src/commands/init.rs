//! `fieldrig init`: finds devices, and writes a first rig file.

mod questions;

use crate::exit::Exit;
use crate::number_args::number_in_range;
use crate::print;
use capture::config::Parent;
use capture::init::{NewRigFile, RigPlan, RobotChoice, SearchPlan, WantedCamera, Wishes, search};
use capture::known_robots::KNOWN_ROBOTS;
use drivers::NetworkAddress;
use messages::BadInput;
use questions::Questions;
use std::path::PathBuf;

/// Flags of `init`.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
    Nothing moves, no setting of a device is changed, and no network is scanned. Found are: V4L2 and RealSense cameras; \
    motors on CAN interfaces that are up (by their heartbeats, or by requests that only ask for an ID); Feetech and \
    Dynamixel servos with IDs from 1 to 12 on USB adapters for servos; a Franka controller at 172.16.0.2, and one of \
    Universal Robots at 192.168.56.101, if it answers a request of its protocol, RTDE. Give other addresses with \
    --franka and --ur. A controller that does not answer at such an address is reported, and is still written.\n\n\
    Without any device, the rig file describes a UR5e with a webcam at its wrist. `fieldrig run RIG.toml --sim` simulates \
    it.\n\n\
    The flange of a URDF is found from its chain with the most moving joints, without the joints of a gripper. It is the \
    link that the last joint moves, or a link fixed to it that is named tool0, flange, link8, ee_link or tool_link. \
    --base-link and --tip choose other links.\n\n\
    On a terminal, the command asks for the robot, the address of its controller and the places of the cameras, unless \
    flags answer these questions.")]
pub(crate) struct Args {
    /// Rig file to write
    #[arg(value_name = "RIG.toml", default_value = "rig.toml")]
    rig: PathBuf,
    /// Replace the file if it exists
    #[arg(long)]
    force: bool,
    /// Known robot, or `none` for a rig without an arm; `list` prints the known robots
    #[arg(long, value_name = "NAME", conflicts_with = "urdf")]
    robot: Option<String>,
    /// Robot description (URDF, already expanded from xacro)
    #[arg(long, value_name = "FILE")]
    urdf: Option<PathBuf>,
    /// Link that is the base of the robot [default: the root link, or the base of the known robot]
    #[arg(long, value_name = "LINK")]
    base_link: Option<String>,
    /// Link to which cameras on the arm are attached [default: the end of the arm, see below]
    #[arg(long, value_name = "LINK")]
    tip: Option<String>,
    /// Place of a camera: flange, base or world; once for each camera
    ///
    /// The first flag is for the first camera that was found, and so on. `flange=/dev/video2` names
    /// the device of a camera. By default, the first camera is on the arm, and the others are fixed
    /// in the room.
    #[arg(long, value_name = "PLACE[=DEVICE]", value_parser = wanted_camera)]
    camera: Vec<WantedCamera>,
    /// Horizontal field of view of webcams in degrees, from their data sheet
    #[arg(long, value_name = "DEG", default_value_t = 65.0, value_parser = number_in_range(10.0..=160.0))]
    fov: f64,
    /// The base of the robot moves, and another program sends its pose
    #[arg(long)]
    moving_base: bool,
    /// Address of a Franka controller, with the port if it is not 1337
    #[arg(long, value_name = "ADDRESS")]
    franka: Option<String>,
    /// Address of a controller of Universal Robots, with the port if it is not 30004
    #[arg(long, value_name = "ADDRESS")]
    ur: Option<String>,
    /// Serial port to search for servos [default: the ports of USB adapters for servos]
    #[arg(long, value_name = "PORT")]
    serial: Option<PathBuf>,
    /// Ask no questions: use the defaults
    #[arg(short, long)]
    yes: bool,
}

/// Reads `PLACE` or `PLACE=DEVICE`.
fn wanted_camera(text: &str) -> Result<WantedCamera, String> {
    let (place, device) = match text.split_once('=') {
        Some((place, device)) => (place, Some(device.to_owned())),
        None => (text, None),
    };
    Ok(WantedCamera {
        parent: parent(place)?,
        device,
    })
}

/// The parent frame with this name.
fn parent(place: &str) -> Result<Parent, String> {
    Parent::named(place).ok_or_else(|| format!("{place:?} is not flange, base or world"))
}

/// Writes a rig file for the devices that are found.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    if args.robot.as_deref() == Some("list") {
        list_robots()?;
        return Ok(Exit::Done);
    }
    // Whatever can be wrong in the arguments is checked before the search, which takes seconds.
    let file = NewRigFile {
        path: args.rig.clone(),
        can_replace: args.force,
    };
    file.check()?;
    check_addresses(args)?;
    let robot = robot(args)?;
    print::notice("searching for cameras, CAN motors, servos and controllers");
    let mut findings = search(&SearchPlan {
        franka: args.franka.clone(),
        ur: args.ur.clone(),
        serial: args.serial.clone(),
    });
    print::report("Found");
    findings.lines().iter().for_each(print::report);
    let mut wishes = Wishes {
        robot,
        base_link: args.base_link.clone(),
        tip: args.tip.clone(),
        cameras: args.camera.clone(),
        field_of_view_deg: args.fov,
        has_moving_base: args.moving_base,
    };
    Questions::new(args.yes).ask(&mut wishes, &mut findings, &args.rig)?;
    let plan = RigPlan::new(&wishes, &findings).map_err(|error| BadInput(format!("{error:#}")))?;
    file.write(&wishes, &plan)?;
    let warnings = wishes.robot.mesh_warnings(&args.rig);
    let report = plan.report(&args.rig, &warnings);
    report.iter().for_each(print::report);
    Ok(Exit::Done)
}

fn list_robots() -> anyhow::Result<()> {
    for robot in KNOWN_ROBOTS {
        print::line(format_args!("{:8} {}", robot.name, robot.title))?;
    }
    Ok(())
}

/// Rejects addresses of controllers that are incomplete.
fn check_addresses(args: &Args) -> Result<(), BadInput> {
    for (flag, address) in [("--franka", &args.franka), ("--ur", &args.ur)] {
        if let Some(address) = address {
            NetworkAddress::parse(address)
                .map_err(|reason| BadInput(format!("{flag} {address}: {reason}")))?;
        }
    }
    Ok(())
}

/// The robot that the flags name.
fn robot(args: &Args) -> anyhow::Result<RobotChoice> {
    match (&args.robot, &args.urdf) {
        (Some(name), _) => Ok(RobotChoice::named(name)?),
        (None, Some(urdf)) => RobotChoice::of_urdf(urdf, &args.rig),
        (None, None) => Ok(RobotChoice::Automatic),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_of_cameras_are_read() {
        let camera = |text| wanted_camera(text).expect(text);
        assert_eq!(
            camera("world"),
            WantedCamera {
                parent: Parent::World,
                device: None
            }
        );
        assert_eq!(
            camera("flange=/dev/video2"),
            WantedCamera {
                parent: Parent::Flange,
                device: Some("/dev/video2".to_owned())
            }
        );
        let error = wanted_camera("wrist").expect_err("no place");
        assert!(error.contains("flange, base or world"), "{error}");
    }
}
