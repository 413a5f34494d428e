//! Robots whose descriptions are part of the program. Rig files name them as `builtin:NAME`.

use crate::nearest_name;

/// Start of a value of `arm.urdf` that names a known robot instead of a file.
pub const BUILTIN_PREFIX: &str = "builtin:";

/// A robot whose description is part of the program.
#[derive(Debug, PartialEq)]
pub struct KnownRobot {
    /// Name after [`BUILTIN_PREFIX`].
    pub name: &'static str,
    /// Name for people.
    pub title: &'static str,
    /// The URDF text. Its shapes are cylinders, spheres and boxes, so it needs no mesh files.
    pub urdf: &'static str,
    /// Link in which the controller of the robot reports poses.
    pub base_link: &'static str,
    /// Link to which a camera on the arm is attached.
    pub flange_link: &'static str,
    /// Moving joints from base to flange.
    pub joints: &'static [&'static str],
}

/// Joints of the arms of Universal Robots.
const UR_JOINTS: &[&str] = &[
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
];

/// All known robots. The files are tested against figures of the makers in
/// `kinematics/tests/shipped_robots.rs`.
pub const KNOWN_ROBOTS: &[KnownRobot] = &[
    KnownRobot {
        name: "panda",
        title: "Franka Emika Panda",
        urdf: include_str!("../../rigs/robots/panda.urdf"),
        base_link: "panda_link0",
        flange_link: "panda_link8",
        joints: &[
            "panda_joint1",
            "panda_joint2",
            "panda_joint3",
            "panda_joint4",
            "panda_joint5",
            "panda_joint6",
            "panda_joint7",
        ],
    },
    KnownRobot {
        name: "fr3",
        title: "Franka Research 3",
        urdf: include_str!("../../rigs/robots/fr3.urdf"),
        base_link: "fr3_link0",
        flange_link: "fr3_link8",
        joints: &[
            "fr3_joint1",
            "fr3_joint2",
            "fr3_joint3",
            "fr3_joint4",
            "fr3_joint5",
            "fr3_joint6",
            "fr3_joint7",
        ],
    },
    KnownRobot {
        name: "ur3e",
        title: "Universal Robots UR3e",
        urdf: include_str!("../../rigs/robots/ur3e.urdf"),
        base_link: "base",
        flange_link: "tool0",
        joints: UR_JOINTS,
    },
    KnownRobot {
        name: "ur5e",
        title: "Universal Robots UR5e",
        urdf: include_str!("../../rigs/robots/ur5e.urdf"),
        base_link: "base",
        flange_link: "tool0",
        joints: UR_JOINTS,
    },
    KnownRobot {
        name: "ur10e",
        title: "Universal Robots UR10e",
        urdf: include_str!("../../rigs/robots/ur10e.urdf"),
        base_link: "base",
        flange_link: "tool0",
        joints: UR_JOINTS,
    },
    KnownRobot {
        name: "so101",
        title: "SO-101",
        urdf: include_str!("../../rigs/robots/so101.urdf"),
        base_link: "base_link",
        // The camera of an SO-101 is on the part that carries the fixed jaw.
        flange_link: "gripper_link",
        joints: &[
            "shoulder_pan",
            "shoulder_lift",
            "elbow_flex",
            "wrist_flex",
            "wrist_roll",
        ],
    },
];

/// An unknown robot whose name is easily confused with the name of a known robot.
struct OtherModel {
    name: &'static str,
    /// How it differs from the known robot with the most similar name.
    difference: &'static str,
}

/// Earlier models of known robots. Source of the lengths: Universal Robots, "DH Parameters for
/// calculations of kinematics and dynamics" (d1 and d4 to d6 of each model).
const OTHER_MODELS: &[OtherModel] = &[
    OtherModel {
        name: "ur3",
        difference: "a UR3 has wrist links that are up to 19 mm shorter",
    },
    OtherModel {
        name: "ur5",
        difference: "a UR5 has a shoulder that is 73 mm lower, and wrist links that are up to 24 mm shorter",
    },
    OtherModel {
        name: "ur10",
        difference: "a UR10 has a shoulder that is more than 50 mm lower, and wrist links that are up to 24 mm shorter",
    },
];

/// A reference `builtin:NAME` with a name that no known robot has.
#[derive(Debug, thiserror::Error)]
#[error(
    "no known robot is named {name:?}{}; known robots: {}",
    suggestion(.name),
    known_names().join(", ")
)]
pub struct UnknownRobot {
    /// The name after [`BUILTIN_PREFIX`].
    name: String,
}

impl KnownRobot {
    /// The robot that a value of `arm.urdf` names. `None` if the value is the path of a file.
    /// Letters may be in upper or lower case.
    ///
    /// # Errors
    ///
    /// If the value is `builtin:NAME`, and no known robot has this name.
    pub fn named_by(urdf: &str) -> Result<Option<&'static Self>, UnknownRobot> {
        let Some(name) = urdf.strip_prefix(BUILTIN_PREFIX) else {
            return Ok(None);
        };
        match Self::find(name) {
            Some(robot) => Ok(Some(robot)),
            None => Err(UnknownRobot {
                name: name.to_owned(),
            }),
        }
    }

    /// The robot with this name, in upper or lower case.
    #[must_use]
    pub fn find(name: &str) -> Option<&'static Self> {
        KNOWN_ROBOTS
            .iter()
            .find(|robot| robot.name.eq_ignore_ascii_case(name))
    }

    /// The value of `arm.urdf` that names this robot.
    #[must_use]
    pub fn reference(&self) -> String {
        format!("{BUILTIN_PREFIX}{}", self.name)
    }
}

fn known_names() -> Vec<&'static str> {
    KNOWN_ROBOTS.iter().map(|robot| robot.name).collect()
}

/// The known robot with the most similar name, as a question. Empty if none is similar. A similar
/// name may be that of another machine, so the suggestion says what the robot is, and what to do if
/// the user has another one.
fn suggestion(name: &str) -> String {
    let name = name.to_ascii_lowercase();
    let Some(nearest) = nearest_name(&name, known_names()).and_then(KnownRobot::find) else {
        return String::new();
    };
    let other = OTHER_MODELS.iter().find(|other| other.name == name);
    let difference = other.map_or("another model has other lengths", |other| other.difference);
    format!(
        ", did you mean {:?} ({}; {difference}: it needs its own URDF file)?",
        nearest.name, nearest.title
    )
}

#[cfg(test)]
mod tests {
    use super::{KNOWN_ROBOTS, KnownRobot, OTHER_MODELS, suggestion};
    use kinematics::Chain;
    use std::collections::BTreeSet;

    #[test]
    fn every_entry_matches_its_urdf() {
        for robot in KNOWN_ROBOTS {
            let chain = Chain::from_urdf(robot.urdf, robot.base_link, robot.flange_link);
            let chain = chain.expect(robot.name);
            assert_eq!(chain.joint_names(), robot.joints, "{}", robot.name);
        }
    }

    #[test]
    fn the_reference_lists_all_robots() {
        let reference = include_str!("../../docs/reference/rig.md");
        for robot in KNOWN_ROBOTS {
            let row = format!(
                "| {} | `{}` | `{}` | `{}` |",
                robot.title, robot.name, robot.base_link, robot.flange_link
            );
            assert!(reference.contains(&row), "{row}");
        }
    }

    #[test]
    fn references_name_robots() {
        let names: BTreeSet<&str> = KNOWN_ROBOTS.iter().map(|robot| robot.name).collect();
        assert_eq!(names.len(), KNOWN_ROBOTS.len());
        for robot in KNOWN_ROBOTS {
            let found = KnownRobot::named_by(&robot.reference()).expect(robot.name);
            assert_eq!(found, Some(robot));
        }
        let found = KnownRobot::named_by("builtin:UR5e").expect("upper case is accepted");
        assert_eq!(found.expect("a known robot").name, "ur5e");
    }

    #[test]
    fn a_path_is_not_a_reference() {
        for path in ["ur5e", "robots/ur5e.urdf", "./builtin:ur5e", ""] {
            assert_eq!(KnownRobot::named_by(path).expect(path), None, "{path}");
        }
    }

    #[test]
    fn an_unknown_name_lists_the_known_ones() {
        let error = KnownRobot::named_by("builtin:ur5")
            .expect_err("unknown")
            .to_string();
        assert_eq!(
            error,
            "no known robot is named \"ur5\", did you mean \"ur5e\" (Universal Robots UR5e; a UR5 has a shoulder \
             that is 73 mm lower, and wrist links that are up to 24 mm shorter: it needs its own URDF file)?; \
             known robots: panda, fr3, ur3e, ur5e, ur10e, so101"
        );
        let error = KnownRobot::named_by("builtin:pandas")
            .expect_err("unknown")
            .to_string();
        assert!(
            error.contains(
                "\"panda\" (Franka Emika Panda; another model has other lengths: it needs"
            ),
            "{error}"
        );
        let error = KnownRobot::named_by("builtin:xyz")
            .expect_err("unknown")
            .to_string();
        assert!(
            error.contains("is named \"xyz\"; known robots: panda"),
            "{error}"
        );
    }
    #[test]
    fn other_models_are_compared_with_the_robot_that_is_suggested() {
        for other in OTHER_MODELS {
            assert_eq!(KnownRobot::find(other.name), None);
            let suggested = suggestion(other.name);
            let robot = other.name.to_ascii_uppercase();
            assert!(
                suggested.contains(&format!("{:?}", format!("{}e", other.name)))
                    && suggested.contains(&format!("a {robot} has")),
                "{suggested}"
            );
        }
    }
}
