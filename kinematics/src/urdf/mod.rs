//! Parses URDF text into a checked tree of links and joints.
//!
//! Source of the format: <https://wiki.ros.org/urdf/XML>, with `quat_xyzw` and `<capsule>` of later
//! versions.

pub(crate) mod element;
pub(crate) mod joint;
mod model;

use crate::Error;
use crate::inertial::Inertial;
use crate::shape::{self, Shape};
use element::{Element, Notes};
use std::collections::{HashMap, HashSet};

pub use element::MAX_BYTES;
pub use model::{Joint, JointKind, JointLimits, Mimic};

/// Links and joints of one robot. The links of every joint exist, no link has two parents, there is
/// no cycle, and all numbers of valid joints except limits are finite.
#[derive(Clone, Debug)]
pub struct Robot {
    name: String,
    links: Vec<String>,
    joints: Vec<Joint>,
    joints_by_name: HashMap<String, usize>,
    /// Index of the joint above each link. `None` for a root.
    joint_above: HashMap<String, Option<usize>>,
    /// Visual and collision shapes of each link that has any.
    shapes: HashMap<String, shape::LinkShapes>,
    notes: Vec<String>,
}

impl Robot {
    /// Parses and checks URDF text. Invalid elements are left out if kinematics do not depend on
    /// them, see [`Robot::notes`].
    ///
    /// # Errors
    /// Fails if the text is not the XML of a robot, or is larger than [`MAX_BYTES`]. Also fails if
    /// a link or joint has no name, a joint lacks a link, two joints have the same name, a link has
    /// two parents, or joints form a cycle.
    pub fn parse(xml: &str) -> Result<Self, Error> {
        let xml = element::repaired(xml);
        let document = element::parse(&xml)?;
        let root = Element::root(&document);
        let mut notes = Notes::default();
        root.note_unknown(
            &["name", "version"],
            &[
                "link",
                "joint",
                "material",
                "gazebo",
                "transmission",
                "ros2_control",
            ],
            &mut notes,
        );
        let name = root.attribute("name").unwrap_or_default().to_owned();
        let links = read_links(root, &mut notes)?;
        if links.is_empty() {
            return Err(Error::NoLinks { robot: name });
        }
        let mut joints = root
            .all("joint")
            .map(|joint| joint::read(joint, &mut notes))
            .collect::<Result<Vec<_>, _>>()?;
        mark_undefined_links(root, &links, &mut joints, &mut notes);
        // These problems affect the whole tree, so no chain of such a file can be trusted.
        let joints_by_name = indices_by_name("joint", root.all("joint"))?;
        let joint_above = joints_above(&links, &joints)?;
        reject_cycles(&links, &joints, &joint_above)?;
        // Shapes come last. They are only drawn and checked for collisions, so their errors are
        // notes.
        let mut shapes = shape::read_all(root, &mut notes);
        drop_below_problems(&links, &joints, &joint_above, &mut shapes);
        Ok(Self {
            name,
            links,
            joints,
            joints_by_name,
            joint_above,
            shapes,
            notes: notes.into_texts(),
        })
    }

    /// Name of the robot. It is empty if the file has none.
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

    /// Valid visual shapes of a link.
    pub fn visuals(&self, link: &str) -> &[Shape] {
        self.shapes.get(link).map_or(&[], |shapes| &shapes.visuals)
    }

    /// Valid collision shapes of a link.
    pub fn collisions(&self, link: &str) -> &[Shape] {
        self.shapes
            .get(link)
            .map_or(&[], |shapes| &shapes.collisions)
    }

    /// Mass and inertia of a link. `None` if the URDF states no values or invalid values.
    pub fn inertial(&self, link: &str) -> Option<&Inertial> {
        self.shapes.get(link)?.inertial.as_ref()
    }

    /// One sentence, with the line, for each element that was left out or is not used.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// The joint with this name.
    pub fn joint(&self, name: &str) -> Option<&Joint> {
        self.joints_by_name.get(name).map(|ix| &self.joints[*ix])
    }

    /// The root link, which is the ancestor of all other links.
    pub fn root(&self) -> Result<&str, Error> {
        let roots: Vec<&String> = self
            .links
            .iter()
            .filter(|link| self.joint_above[*link].is_none())
            .collect();
        match roots[..] {
            [root] => Ok(root),
            _ => Err(Error::ManyRoots {
                roots: roots.into_iter().cloned().collect(),
            }),
        }
    }

    /// The joints from `base_link` down to `tip_link`, in that order.
    pub fn path(&self, base_link: &str, tip_link: &str) -> Result<Vec<&Joint>, Error> {
        self.check_link(base_link)?;
        self.check_link(tip_link)?;
        let mut joints_upwards = Vec::new();
        let mut link = tip_link;
        while link != base_link {
            let Some(above) = self.joint_above[link] else {
                let ancestors = joints_upwards
                    .iter()
                    .map(|joint: &&Joint| joint.parent.clone())
                    .collect();
                return Err(Error::NotBelow {
                    tip: tip_link.into(),
                    base: base_link.into(),
                    ancestors,
                });
            };
            joints_upwards.push(&self.joints[above]);
            link = &self.joints[above].parent;
        }
        // A link has one parent but many children, so the only direct way is upwards.
        joints_upwards.reverse();
        Ok(joints_upwards)
    }

    /// Checks that a link exists.
    ///
    /// # Errors
    /// [`Error::UnknownLink`] if it does not.
    pub fn check_link(&self, link: &str) -> Result<(), Error> {
        if self.joint_above.contains_key(link) {
            return Ok(());
        }
        Err(Error::UnknownLink {
            link: link.into(),
            robot: self.name.clone(),
            links: self.links.clone(),
        })
    }
}

/// The names of all links, in file order. A link that is defined again is noted and left out.
fn read_links(root: Element<'_>, notes: &mut Notes) -> Result<Vec<String>, Error> {
    let mut links = Vec::new();
    // Elements are stored instead of lines. Finding a line takes time, so it is done only for
    // notes.
    let mut element_of: HashMap<String, Element<'_>> = HashMap::new();
    for element in root.all("link") {
        let link = element
            .required("name")
            .map_err(|problem| Error::UrdfElement {
                line: problem.line,
                what: "a link".to_owned(),
                why: problem.why,
            })?
            .to_owned();
        if let Some(first) = element_of.get(&link).map(|first| first.line()) {
            notes.add(
                element.line(),
                &format!("link {link:?} is defined again; its definition in line {first} is used"),
            );
            continue;
        }
        element_of.insert(link.clone(), element);
        links.push(link);
    }
    Ok(links)
}

/// Stores a problem in each joint with a link that is not defined. It is not an error of the file,
/// because only chains through this joint need the link.
fn mark_undefined_links(
    root: Element<'_>,
    links: &[String],
    joints: &mut [Joint],
    notes: &mut Notes,
) {
    let links: HashSet<&String> = links.iter().collect();
    for (joint, element) in joints.iter_mut().zip(root.all("joint")) {
        if let Some(link) = [&joint.parent, &joint.child]
            .into_iter()
            .find(|link| !links.contains(*link))
        {
            let undefined = Error::UndefinedLink {
                joint: joint.name.clone(),
                link: link.clone(),
            };
            notes.add(
                element.line(),
                &format!("joint {:?}: link {link:?} is not defined", joint.name),
            );
            joint.problem.get_or_insert(undefined);
        }
    }
}

/// Index of each element with a name, in file order.
fn indices_by_name<'a>(
    kind: &'static str,
    elements: impl Iterator<Item = Element<'a>>,
) -> Result<HashMap<String, usize>, Error> {
    let mut indices = HashMap::new();
    let mut lines = Vec::new();
    for (ix, element) in elements.enumerate() {
        // The element is stored instead of its line. Finding a line takes time and is needed only
        // for the error.
        lines.push(element);
        let name = element.attribute("name").unwrap_or_default();
        if let Some(first_ix) = indices.insert(name.to_owned(), ix) {
            let lines = [lines[first_ix].line(), element.line()];
            return Err(Error::Duplicate {
                kind,
                name: name.to_owned(),
                lines,
            });
        }
    }
    Ok(indices)
}

/// The joint above each link. Joints with an undefined link are left out.
fn joints_above(
    links: &[String],
    joints: &[Joint],
) -> Result<HashMap<String, Option<usize>>, Error> {
    let mut above: HashMap<String, Option<usize>> =
        links.iter().map(|link| (link.clone(), None)).collect();
    for (joint_ix, joint) in joints.iter().enumerate() {
        // The joint already has a problem. Its child must have no parent, or a valid joint as its
        // parent.
        if !above.contains_key(&joint.parent) || !above.contains_key(&joint.child) {
            continue;
        }
        if let Some(first_ix) = above.insert(joint.child.clone(), Some(joint_ix)).flatten() {
            return Err(Error::TwoParents {
                link: joint.child.clone(),
                first: joints[first_ix].name.clone(),
                second: joint.name.clone(),
            });
        }
    }
    Ok(above)
}

fn reject_cycles(
    links: &[String],
    joints: &[Joint],
    above: &HashMap<String, Option<usize>>,
) -> Result<(), Error> {
    // Links from which a root was reached.
    let mut sound: HashSet<&str> = HashSet::new();
    for start in links {
        // Each walk ends at a root, at a link of an earlier walk, or at one of its own links. Each
        // link is thus visited only once, and the time is linear even in deep trees.
        let mut walked: HashSet<&str> = HashSet::new();
        let mut link: &str = start;
        while !sound.contains(link) {
            if !walked.insert(link) {
                return Err(Error::Cycle {
                    link: link.to_owned(),
                });
            }
            match above[link] {
                Some(joint_ix) => link = &joints[joint_ix].parent,
                None => break,
            }
        }
        sound.extend(walked);
    }
    Ok(())
}

/// Removes the shapes whose pose is unknown, because a joint above them is invalid.
fn drop_below_problems(
    links: &[String],
    joints: &[Joint],
    above: &HashMap<String, Option<usize>>,
    shapes: &mut HashMap<String, shape::LinkShapes>,
) {
    // Files without problems, which are nearly all, skip the search.
    if joints.iter().all(|joint| joint.problem.is_none()) {
        return;
    }
    let mut below: HashMap<&str, Vec<&str>> = HashMap::new();
    for joint in joints {
        below.entry(&joint.parent).or_default().push(&joint.child);
    }
    let is_placed =
        |link: &str| above[link].is_none_or(|joint_ix| joints[joint_ix].problem.is_none());
    let mut dropped: Vec<&str> = links
        .iter()
        .map(String::as_str)
        .filter(|link| !is_placed(link))
        .collect();
    let mut seen: HashSet<&str> = dropped.iter().copied().collect();
    // The search visits each link once. No shape below an invalid joint has a known pose.
    while let Some(link) = dropped.pop() {
        shapes.remove(link);
        dropped.extend(
            below
                .get(link)
                .into_iter()
                .flatten()
                .copied()
                .filter(|child| seen.insert(child)),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn robot(body: &str) -> Result<Robot, Error> {
        Robot::parse(&format!(
            r#"<robot name="r"><link name="a"/><link name="b"/><link name="c"/>{body}</robot>"#
        ))
    }

    fn joint_xml(name: &str, kind: &str, parent: &str, child: &str, rest: &str) -> String {
        format!(
            r#"<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{rest}</joint>"#
        )
    }

    fn error_message(result: Result<Robot, Error>) -> String {
        let message = result.expect_err("this URDF must be rejected").to_string();
        assert!(!message.contains('\n'), "more than one line: {message}");
        message
    }

    #[test]
    fn files_without_links_or_xml_are_rejected() {
        let empty = error_message(Robot::parse(
            r#"<robot xmlns:xacro="http://wiki.ros.org/xacro"></robot>"#,
        ));
        assert_eq!(
            empty,
            r#"urdf: robot "" has no <link> (an export that failed or was never expanded from xacro?)"#
        );
        assert!(error_message(Robot::parse("")).starts_with("urdf: cannot be read"));
        assert!(error_message(Robot::parse("{}")).starts_with("urdf: cannot be read"));
        assert!(
            error_message(Robot::parse(r#"<robot name="r"><link name="a">"#))
                .starts_with("urdf: cannot be read")
        );
    }

    #[test]
    fn malformed_trees_are_rejected() {
        let twice = joint_xml("j", "fixed", "a", "b", "");
        assert_eq!(
            error_message(robot(&(twice.clone() + &twice))),
            r#"urdf: joint "j" is defined twice, in lines 1 and 1"#
        );
        let two = twice.clone() + &joint_xml("k", "fixed", "c", "b", "");
        assert_eq!(
            error_message(robot(&two)),
            r#"urdf: link "b" has two parents, through joints "j" and "k""#
        );
        let cycle = joint_xml("j", "fixed", "b", "c", "") + &joint_xml("k", "fixed", "c", "b", "");
        assert!(matches!(robot(&cycle), Err(Error::Cycle { .. })));
        let self_loop = joint_xml("j", "fixed", "c", "c", "");
        assert_eq!(
            error_message(robot(&self_loop)),
            r#"urdf: link "c" is its own ancestor (the joints form a cycle)"#
        );
    }

    #[test]
    fn links_that_are_undefined_or_defined_twice_cost_only_their_joints() {
        let body =
            joint_xml("j", "fixed", "a", "d", "") + &joint_xml("w", "fixed", "world", "a", "");
        let undefined = robot(
            &(body
                + &joint_xml("k", "fixed", "a", "b", "")
                + &joint_xml("l", "fixed", "b", "c", "")),
        )
        .unwrap();
        assert_eq!(undefined.root().unwrap(), "a");
        assert_eq!(undefined.path("a", "c").unwrap().len(), 2);
        let notes = [
            r#"line 1: joint "j": link "d" is not defined"#,
            r#"line 1: joint "w": link "world" is not defined"#,
        ];
        assert_eq!(undefined.notes(), notes);
        assert!(
            undefined.path("a", "d").is_err() && undefined.joint("j").unwrap().problem.is_some()
        );
        let twice =
            robot("\n<link name=\"a\"><visual><geometry><sphere radius=\"1\"/></geometry></visual></link>").unwrap();
        assert_eq!(
            twice.notes(),
            [r#"line 2: link "a" is defined again; its definition in line 1 is used"#]
        );
        assert!(twice.links() == ["a", "b", "c"] && twice.visuals("a").is_empty());
    }

    #[test]
    fn files_that_strict_parsers_refuse_are_read() {
        let late =
            "\n <?xml version=\"1.0\"?>\n<robot name=\"r\"><link name=\"a\"/><link/></robot>";
        assert!(
            error_message(Robot::parse(late)).contains("line 3"),
            "lines are counted as in the file"
        );
        let unbound =
            r#"<robot name="r"><link name="a"/><gazebo><sensor:camera x:y="1"/></gazebo></robot>"#;
        assert_eq!(Robot::parse(unbound).unwrap().links(), ["a"]);
        let unexpanded = error_message(Robot::parse(
            r#"<robot name="r"><xacro:include filename="a"/></robot>"#,
        ));
        assert!(
            unexpanded.ends_with("expand the file with xacro first"),
            "{unexpanded}"
        );
        let many: String = (0..3000).map(|n| format!("<p{n}:a/>")).collect();
        assert!(Robot::parse(&format!("<robot>{many}</robot>")).is_err());
    }

    #[test]
    fn invalid_joint_ends_only_chains_with_it() {
        let sound = joint_xml("k", "fixed", "a", "c", "");
        for (kind, rest, reason) in [
            (
                "revolute",
                r#"<origin xyz="0 nan 0"/>"#,
                r#"xyz of <origin> is "0 nan 0", expected 3 numbers with spaces"#,
            ),
            (
                "revolute",
                r#"<origin rpy="0, 0, 1"/>"#,
                r#"rpy of <origin> is "0, 0, 1", expected 3 numbers"#,
            ),
            (
                "fixed",
                r#"<origin xyz="0 0 ${h}"/>"#,
                r#""0 0 ${h}", expected 3 numbers with spaces between them (expand"#,
            ),
            (
                "fixed",
                r#"<origin xyz="0 0"/>"#,
                r#"is "0 0", expected 3 numbers"#,
            ),
            (
                "fixed",
                r#"<origin rpy="0 0 1" quat_xyzw="0 0 0 1"/>"#,
                "<origin> has both rpy and quat_xyzw; remove one",
            ),
            (
                "fixed",
                r#"<origin xyz="1 0 0"/><origin xyz="2 0 0"/>"#,
                "two different elements <origin>, in lines 2 and 2",
            ),
            (
                "revolute",
                r#"<axis xyz="0 0 0"/>"#,
                "xyz of <axis> is zero, expected a direction",
            ),
            (
                "revolute",
                r#"<mimic joint="k" multiplier="inf"/>"#,
                r#"multiplier of <mimic> is "inf", expected a number"#,
            ),
            (
                "revolute",
                r#"<mimic multiplier="1"/>"#,
                r#"<mimic> has no attribute "joint""#,
            ),
            (
                "ball",
                "",
                r#"unknown type "ball", expected fixed, revolute, continuous, prismatic, floating, planar or spherical"#,
            ),
        ] {
            let robot =
                robot(&(sound.clone() + "\n" + &joint_xml("j", kind, "a", "b", rest))).unwrap();
            let message = crate::Chain::new(&robot, "a", "b").unwrap_err().to_string();
            assert!(
                message.starts_with(r#"urdf: line 2: joint "j": "#),
                "{message}"
            );
            assert!(message.contains(reason), "{rest}: {message}");
            assert_eq!(robot.notes(), [message.strip_prefix("urdf: ").unwrap()]);
            assert!(crate::Chain::new(&robot, "a", "c").is_ok());
        }
        for (missing, reason) in [
            (
                r#"<joint type="fixed"/>"#,
                r#"urdf: line 1: a joint: <joint> has no attribute "name""#,
            ),
            (
                r#"<joint name="j" type="fixed"><parent link="a"/></joint>"#,
                r#"urdf: line 1: joint "j": it has no <child>"#,
            ),
            (
                r#"<joint name="j"><parent/></joint>"#,
                r#"urdf: line 1: joint "j": <parent> has no attribute "link""#,
            ),
            (
                "<link/>",
                r#"urdf: line 1: a link: <link> has no attribute "name""#,
            ),
        ] {
            assert_eq!(error_message(robot(missing)), reason);
        }
    }

    #[test]
    fn invalid_parts_without_effect_on_poses_are_noted() {
        let visual = |shape: &str| format!(r#"<link name="d"><visual>{shape}</visual></link>"#);
        let sphere = r#"<geometry><sphere radius="1"/></geometry>"#;
        let inertial =
            |inside: &str| format!(r#"<link name="d"><inertial>{inside}</inertial></link>"#);
        let limit = |text: &str| joint_xml("j", "revolute", "a", "b", &format!("<limit {text}/>"));
        for (body, expected) in [
            (
                limit(r#"lower="1" upper="-1""#),
                r#"joint "j": lower of <limit> is 1, above upper, which is -1; the joint has no range and is not moved"#,
            ),
            (
                limit(r#"lower="nan" upper="1""#),
                r#"joint "j": lower of <limit> is "nan", expected a number"#,
            ),
            (
                limit(r#"lower="-1" upper="1" safe="2""#),
                r#"the attribute "safe" in <limit> is not used"#,
            ),
            (
                joint_xml("j", "revolute", "a", "b", r#"<orgin xyz="1 0 0"/>"#),
                "<orgin> in <joint> is not used",
            ),
            (
                "<xacro:arm/>".to_owned(),
                "<xacro:arm>, which xacro has not expanded, in <robot> is not used",
            ),
            (
                inertial(r#"<inertia ixx="1"/>"#),
                r#"the inertia of link "d" is invalid (it is not used): it has no <mass>"#,
            ),
            (
                inertial(r#"<mass value="1"/><inertia izz="0.48ea8d"/>"#),
                r#"izz of <inertia> is "0.48ea8d", expected a number"#,
            ),
            (
                visual(&format!(
                    r#"{sphere}<material name="m"><texture/></material>"#
                )),
                r#"a texture of link "d" is not drawn: """#,
            ),
        ] {
            let robot = format!(
                r#"<robot xmlns:xacro="http://wiki.ros.org/xacro"><link name="a"/><link name="b"/>{body}</robot>"#
            );
            let robot = Robot::parse(&robot).unwrap();
            let [note] = robot.notes() else {
                panic!("{body}: {:?}", robot.notes())
            };
            assert!(
                note.starts_with("line 1: ") && note.ends_with(expected),
                "{note}"
            );
        }
        let many = joint_xml("j", "fixed", "a", "b", "<x/><x/>\n<x/>");
        assert_eq!(
            robot(&many).unwrap().notes(),
            ["line 1 (and 2 more): <x> in <joint> is not used"]
        );
        let unnamed = visual(&format!(
            r#"{sphere}<material><color rgba="1 0 0 1"/></material>"#
        ));
        let unnamed = robot(&unnamed).unwrap();
        assert_eq!(
            (unnamed.notes().len(), unnamed.visuals("d")[0].color_srgba),
            (0, Some([1.0, 0.0, 0.0, 1.0]))
        );
    }

    #[test]
    fn shapes_below_an_invalid_joint_are_not_drawn() {
        let shape = |link: &str| {
            format!(
                r#"<link name="{link}"><visual><geometry><sphere radius="1"/></geometry></visual></link>"#
            )
        };
        let invalid = joint_xml("j", "fixed", "a", "d", r#"<origin xyz="x"/>"#);
        let tree = shape("d")
            + &shape("e")
            + &shape("f")
            + &invalid
            + &joint_xml("k", "fixed", "d", "e", "");
        let robot = robot(&(tree + &joint_xml("l", "fixed", "a", "f", ""))).unwrap();
        assert_eq!(
            ["d", "e", "f"].map(|link| robot.visuals(link).len()),
            [0, 0, 1]
        );
    }

    #[test]
    fn large_descriptions_are_read_in_linear_time_or_refused() {
        const N: usize = 20_000;
        let link = |ix: usize| format!(r#"<link name="l{ix}"/>"#);
        let joint = |ix: usize| {
            let mimic = if ix > 1 {
                format!(r#"<mimic joint="j{}" multiplier="1"/>"#, ix - 1)
            } else {
                String::new()
            };
            joint_xml(
                &format!("j{ix}"),
                "prismatic",
                &format!("l{}", ix - 1),
                &format!("l{ix}"),
                &mimic,
            )
        };
        let chain = format!(
            "<robot>{}{}</robot>",
            (0..=N).map(link).collect::<String>(),
            (1..=N).map(joint).collect::<String>()
        );
        // If the time grew quadratically, parsing this chain would take minutes, even on a fast
        // computer.
        let robot = Robot::parse(&chain).unwrap();
        let chain = crate::Chain::new(&robot, robot.root().unwrap(), &format!("l{N}")).unwrap();
        assert_eq!(chain.joint_names(), ["j1"]);
        assert!((chain.forward(&[0.5]).unwrap().translation.x - 0.5 * N as f64).abs() < 1e-6);

        let deep = format!(
            "<robot>{}{}<link name=\"a\"/></robot>",
            "<a>".repeat(200_000),
            "</a>".repeat(200_000)
        );
        assert_eq!(Robot::parse(&deep).unwrap().links(), ["a"]);
        let named: String = (0..3000).map(|ix| format!(" a{ix}=''")).collect();
        let namespaces: String = (0..200).map(|ix| format!("<a xmlns:n{ix}='x'/>")).collect();
        for (text, what) in [
            (
                format!("<robot{named}/>"),
                "3000 attributes in one element exceed the maximum of 2000",
            ),
            (
                format!("<robot>{namespaces}</robot>"),
                "200 namespaces exceed the maximum of 100",
            ),
            (
                format!("<robot>{}</robot>", "<a/>".repeat(1 << 20)),
                "nodes limit reached",
            ),
            (
                " ".repeat(MAX_BYTES + 1),
                "16777217 bytes exceed the maximum of 16777216",
            ),
            (
                "<sdf/>".to_owned(),
                "it describes a <sdf>, expected a <robot>",
            ),
        ] {
            let message = error_message(Robot::parse(&text));
            assert!(
                message.starts_with("urdf: cannot be read: ") && message.contains(what),
                "{message}"
            );
        }
    }

    #[test]
    fn elements_may_be_in_any_order() {
        let visual = r#"<visual><geometry><sphere radius="1"/></geometry></visual>"#;
        let mixed = format!(
            r#"<link name="d">{visual}<inertial><mass value="1"/><inertia/></inertial>{visual}</link>"#
        );
        let robot = robot(&(joint_xml("j", "fixed", "a", "d", "") + &mixed)).unwrap();
        assert_eq!((robot.visuals("d").len(), robot.notes().len()), (2, 0));
    }

    #[test]
    fn quaternions_of_newer_versions_are_read() {
        let pose = |origin: &str| {
            robot(&joint_xml("j", "fixed", "a", "b", origin))
                .unwrap()
                .joints()[0]
                .parent_from_joint
        };
        let (rpy, quaternion) = (
            r#"<origin xyz="1 2 3" rpy="0 0 1"/>"#,
            r#"<origin xyz="1 2 3" quat_xyzw="0 0 0.479425538604203 0.8775825618903728"/>"#,
        );
        assert!(
            (pose(rpy).to_homogeneous() - pose(quaternion).to_homogeneous())
                .abs()
                .max()
                < 1e-15
        );
    }

    #[test]
    fn root_and_path_are_found() {
        let chain =
            joint_xml("j", "revolute", "b", "c", "") + &joint_xml("k", "fixed", "a", "b", "");
        let found = robot(&chain).unwrap();
        assert_eq!(found.root(), Ok("a"));
        let names: Vec<&str> = found
            .path("a", "c")
            .unwrap()
            .iter()
            .map(|joint| joint.name.as_str())
            .collect();
        assert_eq!(names, ["k", "j"]);
        assert!(found.path("b", "b").unwrap().is_empty());
        assert_eq!(
            found.path("c", "b").unwrap_err().to_string(),
            r#"link "b" is not below link "c"; above it are a"#
        );
        assert_eq!(
            found.path("a", "hand").unwrap_err().to_string(),
            r#"link "hand" is not in the URDF of "r"; its links are a, b, c"#
        );
        let roots = robot("").unwrap().root().unwrap_err().to_string();
        assert_eq!(
            roots,
            "urdf: 3 links have no parent (a, b, c), so the base link has to be named"
        );
    }

    #[test]
    fn missing_limits_are_infinite() {
        let limit = r#"<limit lower="-1" upper="2" velocity="3" effort="4"/>"#;
        let read = |kind: &str, rest: &str| {
            robot(&joint_xml("j", kind, "a", "b", rest))
                .unwrap()
                .joints()[0]
                .limits
        };
        let given = JointLimits {
            lower: -1.0,
            upper: 2.0,
            velocity: 3.0,
            effort: 4.0,
            is_range_valid: true,
        };
        let (up, down) = (f64::INFINITY, f64::NEG_INFINITY);
        assert_eq!(read("revolute", limit), given);
        assert_eq!(
            read("continuous", limit),
            JointLimits {
                lower: down,
                upper: up,
                ..given
            }
        );
        assert_eq!(read("revolute", ""), JointLimits::NONE);
        assert_eq!(
            read(
                "revolute",
                r#"<limit lower="0" upper="0" velocity="0" effort="0"/>"#
            ),
            JointLimits::NONE
        );
        assert_eq!(
            read("revolute", r#"<limit lower="-1" upper="2"/>"#),
            JointLimits {
                velocity: up,
                effort: up,
                ..given
            }
        );
        let swapped = read(
            "revolute",
            r#"<limit lower="2" upper="-1" velocity="3" effort="4"/>"#,
        );
        assert_eq!(
            swapped,
            JointLimits {
                lower: down,
                upper: up,
                is_range_valid: false,
                ..given
            }
        );
    }
}
