//! Parses URDF text into a checked tree of links and joints.

use crate::shape::{self, Shape};
use crate::{Error, Transform};
use nalgebra::{Translation3, Unit, UnitQuaternion, Vector3};
use std::collections::HashMap;

/// Links and joints of one robot. The links of every joint exist, no link has two parents, there is no cycle, and all
/// numbers are finite.
#[derive(Clone, Debug)]
pub struct Robot {
    name: String,
    links: Vec<String>,
    joints: Vec<Joint>,
    /// Index of each link's parent joint.
    joint_above: HashMap<String, usize>,
    /// Visual and collision shapes of each link that has any.
    shapes: HashMap<String, LinkShapes>,
    ignored_shapes: Vec<String>,
}

#[derive(Clone, Debug, Default)]
struct LinkShapes {
    visuals: Vec<Shape>,
    collisions: Vec<Shape>,
}

/// One joint between two links.
#[derive(Clone, Debug)]
pub struct Joint {
    /// Name in the URDF.
    pub name: String,
    /// Type of motion.
    pub kind: JointKind,
    /// Parent link.
    pub parent: String,
    /// Child link; its frame moves with the joint.
    pub child: String,
    /// Pose of the joint's frame in the parent link at joint value 0.
    pub parent_from_joint: Transform,
    /// Direction of motion in the joint's frame; unused for fixed joints.
    pub axis: Unit<Vector3<f64>>,
    /// Allowed range.
    pub limits: JointLimits,
    /// The joint that this joint follows; `None` if it moves independently.
    pub mimic: Option<Mimic>,
}

/// Type of a joint's motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JointKind {
    /// No motion.
    Fixed,
    /// Rotation about the axis, radians (revolute or continuous).
    Revolute,
    /// Translation along the axis, meters (prismatic).
    Prismatic,
    /// A type with more than one degree of freedom, with its name in the URDF.
    Unsupported(&'static str),
}

/// Allowed range of a joint; infinite if the URDF sets no limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointLimits {
    /// Smallest position, radians or meters.
    pub lower: f64,
    /// Largest position, radians or meters.
    pub upper: f64,
    /// Largest speed, radians or meters per second.
    pub velocity: f64,
    /// Largest torque or force, newton meters or newtons.
    pub effort: f64,
}

/// Rule by which a mimic joint follows another: `multiplier * source + offset`.
#[derive(Clone, Debug, PartialEq)]
pub struct Mimic {
    /// Name of the followed joint.
    pub source: String,
    /// Factor on the source's value.
    pub multiplier: f64,
    /// Offset added to the scaled value, radians or meters.
    pub offset: f64,
}

impl Robot {
    /// Parses and checks URDF text.
    pub fn parse(xml: &str) -> Result<Self, Error> {
        let parsed = urdf_rs::read_from_string(xml).map_err(|error| Error::UrdfSyntax { why: one_line(&error) })?;
        if parsed.links.is_empty() {
            return Err(Error::NoLinks { robot: parsed.name });
        }
        let (shapes, ignored_shapes) = shapes(&parsed);
        let links: Vec<String> = parsed.links.into_iter().map(|link| link.name).collect();
        let joints = parsed.joints.iter().map(joint).collect::<Result<Vec<_>, _>>()?;
        reject_duplicates("link", links.iter())?;
        reject_duplicates("joint", joints.iter().map(|joint| &joint.name))?;
        let joint_above = joints_above(&links, &joints)?;
        let robot = Self { name: parsed.name, links, joints, joint_above, shapes, ignored_shapes };
        robot.reject_cycles()?;
        Ok(robot)
    }

    /// Name of the robot; empty if the file has none.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Names of all links, in file order.
    pub fn links(&self) -> &[String] {
        &self.links
    }

    /// All joints, in file order.
    pub fn joints(&self) -> &[Joint] {
        &self.joints
    }

    /// Visual shapes of a link, without invalid ones.
    pub fn visuals(&self, link: &str) -> &[Shape] {
        self.shapes.get(link).map_or(&[], |shapes| &shapes.visuals)
    }

    /// Collision shapes of a link, without invalid ones.
    pub fn collisions(&self, link: &str) -> &[Shape] {
        self.shapes.get(link).map_or(&[], |shapes| &shapes.collisions)
    }

    /// One sentence for each invalid shape. Kinematics do not depend on shapes, so these are no errors.
    pub fn ignored_shapes(&self) -> &[String] {
        &self.ignored_shapes
    }

    /// The joint with this name.
    pub fn joint(&self, name: &str) -> Option<&Joint> {
        self.joints.iter().find(|joint| joint.name == name)
    }

    /// The root link: the ancestor of all other links.
    pub fn root(&self) -> Result<&str, Error> {
        let roots: Vec<&String> = self.links.iter().filter(|link| !self.joint_above.contains_key(*link)).collect();
        match roots[..] {
            [root] => Ok(root),
            _ => Err(Error::ManyRoots { roots: roots.into_iter().cloned().collect() }),
        }
    }

    /// The joints from `base_link` down to `tip_link`, in that order.
    pub fn path(&self, base_link: &str, tip_link: &str) -> Result<Vec<&Joint>, Error> {
        self.check_link(base_link)?;
        self.check_link(tip_link)?;
        let mut joints_upwards = Vec::new();
        let mut link = tip_link;
        while link != base_link {
            let Some(&above) = self.joint_above.get(link) else {
                let ancestors = joints_upwards.iter().map(|joint: &&Joint| joint.parent.clone()).collect();
                return Err(Error::NotBelow { tip: tip_link.into(), base: base_link.into(), ancestors });
            };
            joints_upwards.push(&self.joints[above]);
            link = &self.joints[above].parent;
        }
        joints_upwards.reverse();
        Ok(joints_upwards)
    }

    fn check_link(&self, link: &str) -> Result<(), Error> {
        if self.links.iter().any(|known| known == link) {
            return Ok(());
        }
        Err(Error::UnknownLink { link: link.into(), robot: self.name.clone(), links: self.links.clone() })
    }

    fn reject_cycles(&self) -> Result<(), Error> {
        for start in &self.links {
            let mut link = start;
            // Going up more steps than there are links visits a link twice, so the last link is on the cycle.
            for _ in 0..=self.links.len() {
                match self.joint_above.get(link) {
                    Some(&above) => link = &self.joints[above].parent,
                    None => break,
                }
            }
            if self.joint_above.contains_key(link) {
                return Err(Error::Cycle { link: link.clone() });
            }
        }
        Ok(())
    }
}

/// The valid shapes of all links, and the reasons why the others are invalid.
fn shapes(parsed: &urdf_rs::Robot) -> (HashMap<String, LinkShapes>, Vec<String>) {
    let (mut by_link, mut ignored) = (HashMap::<String, LinkShapes>::new(), Vec::new());
    for link in &parsed.links {
        let mut valid = |kind: &str, shapes: Vec<Result<Shape, String>>| -> Vec<Shape> {
            let keep = |shape: Result<Shape, String>| {
                shape
                    .map_err(|why| ignored.push(format!("a {kind} shape of link {:?} is ignored: {why}", link.name)))
                    .ok()
            };
            shapes.into_iter().filter_map(keep).collect()
        };
        let visuals = link.visual.iter().map(|parsed_shape| shape::visual(parsed_shape, &parsed.materials)).collect();
        let visuals = valid("visual", visuals);
        let collisions = valid("collision", link.collision.iter().map(shape::collision).collect());
        if !visuals.is_empty() || !collisions.is_empty() {
            by_link.insert(link.name.clone(), LinkShapes { visuals, collisions });
        }
    }
    (by_link, ignored)
}

fn one_line(error: &urdf_rs::UrdfError) -> String {
    error.to_string().split_whitespace().collect::<Vec<_>>().join(" ")
}

fn joint(parsed: &urdf_rs::Joint) -> Result<Joint, Error> {
    let kind = kind(&parsed.joint_type);
    let rejected = |what, value: [f64; 3]| Error::JointNumber { joint: parsed.name.clone(), what, value };
    let (xyz, rpy) = (parsed.origin.xyz.0, parsed.origin.rpy.0);
    for (what, value) in [("origin xyz", xyz), ("origin rpy", rpy), ("axis", parsed.axis.xyz.0)] {
        if value.iter().any(|number| !number.is_finite()) {
            return Err(rejected(what, value));
        }
    }
    let is_movable = matches!(kind, JointKind::Revolute | JointKind::Prismatic);
    let axis = match Unit::try_new(Vector3::from(parsed.axis.xyz.0), f64::MIN_POSITIVE) {
        Some(axis) => axis,
        None if !is_movable => Vector3::x_axis(),
        None => return Err(rejected("axis", parsed.axis.xyz.0)),
    };
    let limits = limits(parsed);
    if limits.lower.is_nan() || limits.upper.is_nan() || limits.lower > limits.upper {
        return Err(rejected("range (lower, upper)", [limits.lower, limits.upper, 0.0]));
    }
    let mimic = match &parsed.mimic {
        Some(mimic) if is_movable => Some(Mimic {
            source: mimic.joint.clone(),
            multiplier: mimic.multiplier.unwrap_or(1.0),
            offset: mimic.offset.unwrap_or(0.0),
        }),
        _ => None,
    };
    if let Some(Mimic { multiplier, offset, .. }) = mimic
        && !(multiplier.is_finite() && offset.is_finite())
    {
        return Err(rejected("mimic (multiplier, offset)", [multiplier, offset, 0.0]));
    }
    Ok(Joint {
        name: parsed.name.clone(),
        kind,
        parent: parsed.parent.link.clone(),
        child: parsed.child.link.clone(),
        // Roll, pitch and yaw rotate about the parent's fixed axes x, y, z in both URDF and nalgebra.
        parent_from_joint: Transform::from_parts(
            Translation3::from(Vector3::from(xyz)),
            UnitQuaternion::from_euler_angles(rpy[0], rpy[1], rpy[2]),
        ),
        axis,
        limits,
        mimic,
    })
}

fn kind(joint_type: &urdf_rs::JointType) -> JointKind {
    match joint_type {
        urdf_rs::JointType::Fixed => JointKind::Fixed,
        urdf_rs::JointType::Revolute | urdf_rs::JointType::Continuous => JointKind::Revolute,
        urdf_rs::JointType::Prismatic => JointKind::Prismatic,
        urdf_rs::JointType::Floating => JointKind::Unsupported("floating"),
        urdf_rs::JointType::Planar => JointKind::Unsupported("planar"),
        urdf_rs::JointType::Spherical => JointKind::Unsupported("spherical"),
    }
}

fn limits(parsed: &urdf_rs::Joint) -> JointLimits {
    let limit = &parsed.limit;
    // The parser returns zeros if the file has no <limit>.
    let has_limit = *limit != urdf_rs::JointLimit::default();
    let has_range = has_limit && parsed.joint_type != urdf_rs::JointType::Continuous;
    let or_infinite = |given: bool, value: f64| if given { value } else { f64::INFINITY };
    JointLimits {
        lower: -or_infinite(has_range, -limit.lower),
        upper: or_infinite(has_range, limit.upper),
        velocity: or_infinite(has_limit, limit.velocity),
        effort: or_infinite(has_limit, limit.effort),
    }
}

fn reject_duplicates<'a>(kind: &'static str, names: impl Iterator<Item = &'a String>) -> Result<(), Error> {
    let mut unique = std::collections::HashSet::new();
    for name in names {
        if !unique.insert(name) {
            return Err(Error::Duplicate { kind, name: name.clone() });
        }
    }
    Ok(())
}

fn joints_above(links: &[String], joints: &[Joint]) -> Result<HashMap<String, usize>, Error> {
    let mut above: HashMap<String, usize> = HashMap::new();
    for (joint_ix, joint) in joints.iter().enumerate() {
        for link in [&joint.parent, &joint.child] {
            if !links.contains(link) {
                return Err(Error::UndefinedLink { joint: joint.name.clone(), link: link.clone() });
            }
        }
        if let Some(first) = above.insert(joint.child.clone(), joint_ix) {
            return Err(Error::TwoParents {
                link: joint.child.clone(),
                first: joints[first].name.clone(),
                second: joint.name.clone(),
            });
        }
    }
    Ok(above)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn robot(body: &str) -> Result<Robot, Error> {
        Robot::parse(&format!(r#"<robot name="r"><link name="a"/><link name="b"/><link name="c"/>{body}</robot>"#))
    }

    fn joint_xml(name: &str, kind: &str, parent: &str, child: &str, rest: &str) -> String {
        format!(r#"<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{rest}</joint>"#)
    }

    fn error_message(result: Result<Robot, Error>) -> String {
        let message = result.expect_err("this URDF must be rejected").to_string();
        assert!(!message.contains('\n'), "more than one line: {message}");
        message
    }

    #[test]
    fn files_without_links_or_xml_are_rejected() {
        let empty = error_message(Robot::parse(r#"<robot xmlns:xacro="http://wiki.ros.org/xacro"></robot>"#));
        assert_eq!(empty, r#"urdf: robot "" has no <link> (an export that failed or was never expanded from xacro?)"#);
        assert!(error_message(Robot::parse("")).starts_with("urdf: cannot be read"));
        assert!(error_message(Robot::parse("{}")).starts_with("urdf: cannot be read"));
        assert!(error_message(Robot::parse(r#"<robot name="r"><link name="a">"#)).starts_with("urdf: cannot be read"));
    }

    #[test]
    fn malformed_trees_are_rejected() {
        let twice = joint_xml("j", "fixed", "a", "b", "");
        assert_eq!(error_message(robot(&(twice.clone() + &twice))), r#"urdf: joint "j" is defined twice"#);
        assert_eq!(error_message(robot(r#"<link name="a"/>"#)), r#"urdf: link "a" is defined twice"#);
        let two = twice.clone() + &joint_xml("k", "fixed", "c", "b", "");
        assert_eq!(error_message(robot(&two)), r#"urdf: link "b" has two parents, through joints "j" and "k""#);
        let cycle = joint_xml("j", "fixed", "b", "c", "") + &joint_xml("k", "fixed", "c", "b", "");
        assert!(matches!(robot(&cycle), Err(Error::Cycle { .. })));
        let self_loop = joint_xml("j", "fixed", "c", "c", "");
        assert_eq!(error_message(robot(&self_loop)), r#"urdf: link "c" is its own ancestor (the joints form a cycle)"#);
        let nowhere = joint_xml("j", "fixed", "a", "d", "");
        assert_eq!(error_message(robot(&nowhere)), r#"urdf: joint "j" joins link "d", which is not defined"#);
    }

    #[test]
    fn invalid_numbers_are_rejected() {
        for rest in [
            r#"<origin xyz="0 nan 0"/>"#,
            r#"<origin rpy="0 0 inf"/>"#,
            r#"<axis xyz="0 0 0"/>"#,
            r#"<limit lower="1" upper="-1" velocity="1"/>"#,
            r#"<limit lower="nan" upper="1" velocity="1"/>"#,
            r#"<mimic joint="k" multiplier="inf"/>"#,
        ] {
            let rejected = robot(&joint_xml("j", "revolute", "a", "b", rest));
            assert!(matches!(rejected, Err(Error::JointNumber { .. })), "{rest}: {rejected:?}");
        }
    }

    #[test]
    fn root_and_path_are_found() {
        let chain = joint_xml("j", "revolute", "b", "c", "") + &joint_xml("k", "fixed", "a", "b", "");
        let found = robot(&chain).unwrap();
        assert_eq!(found.root(), Ok("a"));
        let names: Vec<&str> = found.path("a", "c").unwrap().iter().map(|joint| joint.name.as_str()).collect();
        assert_eq!(names, ["k", "j"]);
        assert!(found.path("b", "b").unwrap().is_empty());
        assert_eq!(found.path("c", "b").unwrap_err().to_string(), r#"link "b" is not below link "c"; above it are a"#);
        assert_eq!(
            found.path("a", "hand").unwrap_err().to_string(),
            r#"link "hand" is not in the URDF of "r"; its links are a, b, c"#
        );
        let roots = robot("").unwrap().root().unwrap_err().to_string();
        assert_eq!(roots, "urdf: 3 links have no parent (a, b, c), so the base link has to be named");
    }

    #[test]
    fn missing_limits_are_infinite() {
        let limit = r#"<limit lower="-1" upper="2" velocity="3" effort="4"/>"#;
        let read = |kind: &str, rest: &str| robot(&joint_xml("j", kind, "a", "b", rest)).unwrap().joints()[0].limits;
        let given = JointLimits { lower: -1.0, upper: 2.0, velocity: 3.0, effort: 4.0 };
        let (up, down) = (f64::INFINITY, f64::NEG_INFINITY);
        assert_eq!(read("revolute", limit), given);
        assert_eq!(read("continuous", limit), JointLimits { lower: down, upper: up, ..given });
        assert_eq!(read("revolute", ""), JointLimits { lower: down, upper: up, velocity: up, effort: up });
    }
}
