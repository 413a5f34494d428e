//! Chooses base and flange of a robot description.

use anyhow::{Context, bail};
use kinematics::Transform;
use kinematics::urdf::{Joint, JointKind, Robot};
use nalgebra::{Unit, Vector3};

/// Names of links to which tools and cameras are attached, the most common first. A link matches
/// if its name is, or ends with `_` and, one of these.
const FLANGE_NAMES: [&str; 5] = ["tool0", "flange", "link8", "ee_link", "tool_link"];
/// Parts of the names of joints that belong to a gripper or hand.
const HAND_WORDS: [&str; 8] = [
    "gripper", "finger", "jaw", "knuckle", "thumb", "hand", "robotiq", "grasp",
];

/// The part of a robot between its base and the link that carries cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct ArmLinks {
    /// The base link.
    pub base: String,
    /// The link to which cameras on the arm are attached.
    pub flange: String,
    /// Moving joints from base to flange, without mimic joints.
    pub joints: Vec<String>,
    /// Direction away from the arm, in the frame of the flange: along the axis of the last joint.
    pub outward: Unit<Vector3<f64>>,
    /// 70 % of the length of the stretched chain, meters: about the distance that the arm reaches.
    pub reach_m: f64,
}

impl ArmLinks {
    /// Chooses the links of an arm. `None` instead of a name means:
    ///
    /// - The base is the root of the URDF.
    /// - The flange is found from the chain with the most moving joints; among equal chains, the
    ///   first in the file. Joints at its end that belong to a gripper are left out: mimic joints,
    ///   prismatic joints after the third joint, and joints named like a gripper. The flange is the
    ///   link that the last remaining joint moves, or a link fixed to it with a usual name, such as
    ///   `tool0`.
    ///
    /// # Errors
    ///
    /// If the text is no URDF, has no such links, or has no moving joint between them.
    pub fn choose(urdf: &str, base: Option<&str>, tip: Option<&str>) -> anyhow::Result<Self> {
        let robot = Robot::parse(urdf)?;
        let base = match base {
            Some(base) => base.to_owned(),
            None => robot.root()?.to_owned(),
        };
        robot.check_link(&base)?;
        let flange = match tip {
            Some(tip) => tip.to_owned(),
            None => flange(&robot, &base)?,
        };
        let path = robot.path(&base, &flange)?;
        if !path.iter().any(|joint| is_moving(joint)) {
            bail!("no joint moves between {base:?} and {flange:?}");
        }
        Ok(Self {
            joints: path
                .iter()
                .filter(|joint| is_moving(joint))
                .map(|joint| joint.name.clone())
                .collect(),
            outward: outward(&path),
            reach_m: 0.7 * path.iter().map(|joint| length_m(joint)).sum::<f64>(),
            base,
            flange,
        })
    }
}

/// Whether a joint moves independently of others.
fn is_moving(joint: &Joint) -> bool {
    matches!(joint.kind, JointKind::Revolute | JointKind::Prismatic) && joint.mimic.is_none()
}

/// Distance between the origins of a joint and of its parent link, meters.
fn length_m(joint: &Joint) -> f64 {
    joint.parent_from_joint.translation.vector.norm()
}

/// The flange of the chain with the most moving joints.
fn flange(robot: &Robot, base: &str) -> anyhow::Result<String> {
    let mut longest: Vec<&Joint> = Vec::new();
    for tip in robot.links() {
        // Links that are not below the base have no path.
        let Ok(path) = robot.path(base, tip) else {
            continue;
        };
        let arm = without_hand(path);
        let n_moving = |path: &[&Joint]| path.iter().filter(|joint| is_moving(joint)).count();
        if n_moving(&arm) > n_moving(&longest) {
            longest = arm;
        }
    }
    let last = longest
        .last()
        .with_context(|| format!("no joint moves below the link {base:?}"))?;
    let fixed = fixed_to(robot, &last.child);
    let named = FLANGE_NAMES.iter().find_map(|name| {
        fixed
            .iter()
            .find(|link| link == name || link.ends_with(&format!("_{name}")))
    });
    Ok(named.cloned().unwrap_or_else(|| last.child.clone()))
}

/// The path without fixed joints at its end, and without the joints of a hand.
fn without_hand(mut path: Vec<&Joint>) -> Vec<&Joint> {
    while let Some(last) = path.last() {
        let n_before = path[..path.len() - 1]
            .iter()
            .filter(|joint| is_moving(joint))
            .count();
        let is_slider = last.kind == JointKind::Prismatic && n_before >= 3;
        let name = last.name.to_lowercase();
        let is_hand = HAND_WORDS.iter().any(|word| name.contains(word));
        if is_moving(last) && !is_slider && !is_hand {
            break;
        }
        path.pop();
    }
    path
}

/// A link, and all links that are attached to it by fixed joints, in file order.
fn fixed_to(robot: &Robot, link: &str) -> Vec<String> {
    let mut fixed = vec![link.to_owned()];
    let mut next = 0;
    while let Some(parent) = fixed.get(next).cloned() {
        let children = robot
            .joints()
            .iter()
            .filter(|joint| joint.kind == JointKind::Fixed && joint.parent == parent)
            .map(|joint| joint.child.clone());
        fixed.extend(children);
        next += 1;
    }
    fixed
}

/// The direction along the axis of the last moving joint, in the frame of the last link. It points
/// away from the earlier joints.
fn outward(path: &[&Joint]) -> Unit<Vector3<f64>> {
    // Poses of the joints at joint values 0, in the frame of the first link.
    let mut base_from_joint = Transform::identity();
    let mut joints = Vec::new();
    for joint in path {
        base_from_joint *= joint.parent_from_joint;
        if is_moving(joint) {
            joints.push((base_from_joint, joint.axis));
        }
    }
    let base_from_flange = base_from_joint;
    let Some((base_from_last, axis)) = joints.pop() else {
        return Vector3::z_axis();
    };
    let axis_in_base = base_from_last.rotation * axis;
    // The nearest earlier joint that is not beside the flange decides.
    const MIN_DISTANCE_M: f64 = 0.005;
    let distance_m = joints
        .iter()
        .rev()
        .map(|(base_from_joint, _)| {
            let offset = base_from_flange.translation.vector - base_from_joint.translation.vector;
            offset.dot(&axis_in_base)
        })
        .find(|distance_m| distance_m.abs() > MIN_DISTANCE_M)
        .unwrap_or(0.0);
    let axis_in_flange = base_from_flange.rotation.inverse() * axis_in_base;
    if distance_m < 0.0 {
        -axis_in_flange
    } else {
        axis_in_flange
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::known_robots::KNOWN_ROBOTS;

    #[test]
    fn known_robots_get_their_flange() {
        for robot in KNOWN_ROBOTS {
            let links = ArmLinks::choose(robot.urdf, Some(robot.base_link), None);
            let links = links.expect(robot.name);
            assert_eq!(links.flange, robot.flange_link, "{}", robot.name);
            assert_eq!(links.joints, robot.joints, "{}", robot.name);
            assert!(
                (0.2..1.5).contains(&links.reach_m),
                "{}: {links:?}",
                robot.name
            );
        }
    }

    #[test]
    fn cameras_look_away_from_the_arm() {
        for name in ["panda", "fr3", "ur3e", "ur5e", "ur10e"] {
            let robot = crate::known_robots::KnownRobot::find(name).expect(name);
            let links = ArmLinks::choose(robot.urdf, Some(robot.base_link), None).expect(name);
            assert!(
                (*links.outward - Vector3::z()).norm() < 1e-3,
                "{name}: {links:?}"
            );
        }
    }

    fn joint(name: &str, kind: &str, parent: &str, child: &str, more: &str) -> String {
        format!(
            r#"<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
            <origin xyz="0 0 0.2"/><axis xyz="0 1 0"/>
            <limit lower="-1" upper="1" effort="1" velocity="1"/>{more}</joint>"#
        )
    }

    fn robot(links: &[&str], joints: &[String]) -> String {
        let links: String = links
            .iter()
            .map(|name| format!(r#"<link name="{name}"/>"#))
            .collect();
        format!(r#"<robot name="r">{links}{}</robot>"#, joints.concat())
    }

    #[test]
    fn gripper_and_shorter_branches_are_left_out() {
        let mimic = r#"<mimic joint="left_slide"/>"#;
        let urdf = robot(
            &[
                "root", "wheel", "l1", "l2", "l3", "palm", "my_tool0", "left", "right",
            ],
            &[
                joint("wheel", "continuous", "root", "wheel", ""),
                joint("a", "revolute", "root", "l1", ""),
                joint("b", "revolute", "l1", "l2", ""),
                joint("c", "revolute", "l2", "l3", ""),
                joint("to_palm", "fixed", "l3", "palm", ""),
                joint("to_tool", "fixed", "palm", "my_tool0", ""),
                joint("left_slide", "prismatic", "palm", "left", ""),
                joint("right_slide", "prismatic", "palm", "right", mimic),
            ],
        );
        let links = ArmLinks::choose(&urdf, None, None).expect("an arm");
        assert_eq!((&*links.base, &*links.flange), ("root", "my_tool0"));
        assert_eq!(links.joints, ["a", "b", "c"]);
        let links = ArmLinks::choose(&urdf, None, Some("left")).expect("an arm");
        assert_eq!(links.joints, ["a", "b", "c", "left_slide"]);
    }

    #[test]
    fn linear_axes_and_first_arms_are_kept() {
        let urdf = robot(
            &["root", "carriage", "arm", "left_hand", "right_hand"],
            &[
                joint("rail", "prismatic", "root", "carriage", ""),
                joint("turn", "revolute", "carriage", "arm", ""),
                joint("left_wrist", "revolute", "arm", "left_hand", ""),
                joint("right_wrist", "revolute", "arm", "right_hand", ""),
            ],
        );
        let links = ArmLinks::choose(&urdf, None, None).expect("an arm");
        assert_eq!(links.joints, ["rail", "turn", "left_wrist"]);
        assert_eq!(links.flange, "left_hand");
    }

    #[test]
    fn robots_without_an_arm_are_refused() {
        let urdf = robot(
            &["root", "plate"],
            &[joint("glue", "fixed", "root", "plate", "")],
        );
        let problem = |base, tip| {
            let links = ArmLinks::choose(&urdf, base, tip);
            links.expect_err("no joint moves").to_string()
        };
        assert!(problem(None, None).contains("no joint moves below the link \"root\""));
        assert!(problem(None, Some("plate")).contains("between \"root\" and \"plate\""));
        assert!(problem(None, Some("hand")).contains("link \"hand\" is not in the URDF"));
        assert!(problem(Some("bace"), None).contains("link \"bace\" is not in the URDF"));
    }
}
