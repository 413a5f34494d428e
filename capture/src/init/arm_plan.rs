//! Decides which arm a rig file describes, and how its joint states are read.

use super::findings::{
    ControllerKind, Findings, FoundBus, FoundController, FoundMotor, FoundServos,
};
use super::links::ArmLinks;
use super::wishes::{RobotChoice, Wishes};
use crate::known_robots::KnownRobot;
use anyhow::{Context, bail};
use messages::Setting;

/// The robot of a rig without any device and any choice.
const DEFAULT_ROBOT: &str = "ur5e";

/// The arm of a rig file.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ArmPlan {
    /// Name of the robot, for people.
    pub title: String,
    /// Value of `arm.urdf`.
    pub urdf: String,
    /// Whether nobody has said which robot it is, and no device has identified it.
    pub is_robot_guessed: bool,
    /// Whether the keys of the links are written. The links of a known robot are defaults.
    pub names_links: bool,
    /// Whether nobody has said which link is the flange of a robot that is not known.
    pub is_flange_guessed: bool,
    /// Its links and joints.
    pub links: ArmLinks,
    /// Source of its joint states.
    pub source: ArmSource,
}

/// Source of joint states.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum ArmSource {
    /// The simulator, because no device of the arm was found. The driver of the real arm is given
    /// if it is known.
    Simulated(Option<&'static str>),
    /// A controller on the network.
    Controller(FoundController),
    /// Motors on CAN buses.
    Motors {
        /// The buses of the motors.
        buses: Vec<FoundBus>,
        /// A motor for each joint, with the index of its bus.
        motors: Vec<(usize, FoundMotor)>,
    },
    /// Servos on a serial port, the first for the first joint. There may be more servos than
    /// joints.
    Servos(FoundServos),
}

/// Decides on the arm. `None` for a robot without an arm. Sentences about assumptions are added to
/// `assumptions`.
pub(super) fn choose(
    wishes: &Wishes,
    findings: &Findings,
    assumptions: &mut Vec<String>,
) -> anyhow::Result<Option<ArmPlan>> {
    let robot = match &wishes.robot {
        RobotChoice::None => return Ok(None),
        RobotChoice::Known(robot) => Description::of_known(robot),
        RobotChoice::Urdf { path, text } => Description {
            title: format!("the robot of {path}"),
            urdf: path.clone(),
            text: text.clone(),
            known: None,
        },
        RobotChoice::Automatic => Description::of_known(automatic_robot(findings, assumptions)?),
    };
    let base = wishes
        .base_link
        .as_deref()
        .or(robot.known.map(|known| known.base_link));
    let flange = wishes
        .tip
        .as_deref()
        .or(robot.known.map(|known| known.flange_link));
    let links = ArmLinks::choose(&robot.text, base, flange)
        .with_context(|| format!("cannot find the arm in {}", robot.urdf))?;
    if robot.known.is_none() {
        let ArmLinks {
            base,
            flange,
            joints,
            ..
        } = &links;
        assumptions.push(format!(
            "the arm is from {base:?} to {flange:?}, with the joints {} ({} and {} choose other links)",
            joints.join(", "),
            Setting::BaseLink,
            Setting::Tip
        ));
    }
    let source = source(&robot, &links, findings, assumptions)?;
    Ok(Some(ArmPlan {
        is_robot_guessed: wishes.robot == RobotChoice::Automatic && !is_robot_identified(findings),
        is_flange_guessed: robot.known.is_none() && wishes.tip.is_none(),
        names_links: robot.known.is_none() || wishes.tip.is_some() || wishes.base_link.is_some(),
        title: robot.title,
        urdf: robot.urdf,
        links,
        source,
    }))
}

/// A robot description.
struct Description {
    title: String,
    urdf: String,
    text: String,
    known: Option<&'static KnownRobot>,
}

impl Description {
    fn of_known(robot: &'static KnownRobot) -> Self {
        Self {
            title: robot.title.to_owned(),
            urdf: robot.reference(),
            text: robot.urdf.to_owned(),
            known: Some(robot),
        }
    }

    /// Whether a controller may control this robot. Nothing is known about robots from files.
    fn may_have(&self, kind: ControllerKind) -> bool {
        self.known.is_none_or(|robot| kind.controls(robot))
    }

    /// Whether the joints may be servos of this driver.
    fn may_have_servos(&self, driver: &str) -> bool {
        self.known
            .is_none_or(|robot| robot.name == "so101" && driver == "feetech")
    }

    /// The driver of the real arm, if it is a known robot.
    fn driver(&self) -> Option<&'static str> {
        let known = self.known?;
        let kinds = [ControllerKind::Franka, ControllerKind::Ur];
        let kind = kinds.into_iter().find(|kind| kind.controls(known));
        Some(kind.map_or("feetech", ControllerKind::driver))
    }
}

/// The known robot that was probably found, or an example if nothing was found. `None` if devices of
/// an arm were found, but not which arm they belong to.
#[must_use]
pub fn likely_robot(findings: &Findings) -> Option<&'static KnownRobot> {
    let name = if let Some(controller) = findings.controllers.first() {
        match controller.robot {
            Some(robot) => return Some(robot),
            None => controller.kind.usual_robot(),
        }
    } else if let Some(servos) = findings.servos.first() {
        match servos.driver {
            "feetech" => "so101",
            _ => return None,
        }
    } else if findings.buses.iter().any(|bus| !bus.motors.is_empty()) {
        return None;
    } else {
        DEFAULT_ROBOT
    };
    KnownRobot::find(name)
}

/// Whether the controller has identified its robot.
fn is_robot_identified(findings: &Findings) -> bool {
    let first = findings.controllers.first();
    first.is_some_and(|controller| controller.robot.is_some())
}

/// The likely robot, with a sentence about the assumption.
fn automatic_robot(
    findings: &Findings,
    assumptions: &mut Vec<String>,
) -> anyhow::Result<&'static KnownRobot> {
    let Some(robot) = likely_robot(findings) else {
        bail!(
            "servos or motors were found, but not which arm they belong to: give its robot description with {} FILE, or {} none for a rig without the arm",
            Setting::Urdf,
            Setting::Robot
        );
    };
    let title = robot.title;
    let reason = match (findings.controllers.first(), findings.servos.first()) {
        _ if is_robot_identified(findings) => return Ok(robot),
        (Some(_), _) => format!("the robot is a {title}"),
        (None, Some(_)) => format!("the servos belong to an {title}"),
        (None, None) => format!("no arm was found, so the rig has a {title} as an example"),
    };
    assumptions.push(format!(
        "{reason} ({} or {} names another robot)",
        Setting::Robot,
        Setting::Urdf
    ));
    Ok(robot)
}

/// The source of the joint states: the first device that fits the robot.
fn source(
    robot: &Description,
    links: &ArmLinks,
    findings: &Findings,
    assumptions: &mut Vec<String>,
) -> anyhow::Result<ArmSource> {
    let n_joints = links.joints.len();
    for controller in &findings.controllers {
        let kind = controller.kind;
        if robot.may_have(kind) && kind.n_joints() == n_joints {
            if !controller.answers() {
                assumptions.push(format!(
                    "a {kind} controller will answer at {}, as it does not now",
                    controller.address
                ));
            }
            return Ok(ArmSource::Controller(controller.clone()));
        }
        assumptions.push(format!(
            "the {kind} controller at {} belongs to another robot, because {} has {n_joints} joints between {:?} and {:?}",
            controller.address, robot.title, links.base, links.flange
        ));
    }
    if let Some(source) = servos(robot, n_joints, findings, assumptions) {
        return Ok(source);
    }
    if let Some(source) = motors(robot, n_joints, findings, assumptions) {
        return Ok(source);
    }
    assumptions.push("the arm is simulated, because no device of it was found".to_owned());
    Ok(ArmSource::Simulated(robot.driver()))
}

/// The first serial port with enough servos.
fn servos(
    robot: &Description,
    n_joints: usize,
    findings: &Findings,
    assumptions: &mut Vec<String>,
) -> Option<ArmSource> {
    let suitable = findings
        .servos
        .iter()
        .find(|servos| robot.may_have_servos(servos.driver) && servos.ids.len() >= n_joints);
    if suitable.is_none() {
        for servos in &findings.servos {
            assumptions.push(format!(
                "the {} {} servos on {} are not those of {}, which has {n_joints} joints",
                servos.ids.len(),
                servos.driver,
                servos.device,
                robot.title
            ));
        }
    }
    let servos = suitable?;
    assumptions.push(
        "the servos move the joints from base to flange in the order of their IDs; their zeros are in the middle of their ranges"
            .to_owned(),
    );
    Some(ArmSource::Servos(servos.clone()))
}

/// The motors of all buses, if there is one for each joint.
fn motors(
    robot: &Description,
    n_joints: usize,
    findings: &Findings,
    assumptions: &mut Vec<String>,
) -> Option<ArmSource> {
    let buses: Vec<FoundBus> = findings
        .buses
        .iter()
        .filter(|bus| !bus.motors.is_empty())
        .cloned()
        .collect();
    let motors: Vec<(usize, FoundMotor)> = buses
        .iter()
        .enumerate()
        .flat_map(|(ix, bus)| bus.motors.iter().map(move |motor| (ix, motor.clone())))
        .collect();
    if motors.is_empty() || robot.known.is_some() {
        return None;
    }
    if motors.len() != n_joints {
        assumptions.push(format!(
            "the {} motors on CAN buses are left out, because {} has {n_joints} joints; docs/guide/arms.md shows their keys",
            motors.len(),
            robot.title
        ));
        return None;
    }
    assumptions.push(
        "the motors move the joints from base to flange in the order of their buses and IDs, without gears and offsets"
            .to_owned(),
    );
    Some(ArmSource::Motors { buses, motors })
}

/// The maker of the controller that a known robot needs, if none was found.
#[must_use]
pub fn missing_controller(wishes: &Wishes, findings: &Findings) -> Option<ControllerKind> {
    let RobotChoice::Known(robot) = &wishes.robot else {
        return None;
    };
    let kinds = [ControllerKind::Franka, ControllerKind::Ur];
    let kind = kinds.into_iter().find(|kind| kind.controls(robot))?;
    let is_found = findings
        .controllers
        .iter()
        .any(|controller| controller.kind == kind);
    (!is_found).then_some(kind)
}
