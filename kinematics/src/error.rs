//! What can be wrong with the input of this crate.

/// Why an input was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A matrix holds NaN or infinity.
    #[error("transform: element {row},{column} is {value}, not a finite number")]
    TransformNotFinite {
        /// Row, from 0.
        row: usize,
        /// Column, from 0.
        column: usize,
        /// What stands there.
        value: f64,
    },
    /// The upper left 3x3 is no rotation: scaled, sheared or mirrored.
    #[error(
        "transform: not rigid, its axes are off unit length or right angles by {off:.2e} (at most {allowed:.0e}) and its determinant is {determinant:.4}"
    )]
    NotRigid {
        /// Largest element of `|RᵀR - 1|`.
        off: f64,
        /// Largest value accepted.
        allowed: f64,
        /// Determinant of the 3x3.
        determinant: f64,
    },
    /// The last row of the 4x4 is not `0 0 0 1`.
    #[error("transform: last row is {row:?}, must be [0, 0, 0, 1]")]
    LastRow {
        /// The row found.
        row: [f64; 4],
    },
    /// A lens parameter is out of its range.
    #[error("camera intrinsics: {what} is {value}, must be {allowed}")]
    Intrinsics {
        /// Which number.
        what: &'static str,
        /// Its value.
        value: f64,
        /// What would be accepted.
        allowed: &'static str,
    },
    /// A pixel buffer does not fit the camera's image size.
    #[error("image of {got} values, must be {expected} for {width} x {height} pixels")]
    ImageSize {
        /// Values given.
        got: usize,
        /// Values needed.
        expected: usize,
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
    },
    /// The text is no URDF.
    #[error("urdf: cannot be read: {why}")]
    UrdfSyntax {
        /// What the parser said.
        why: String,
    },
    /// The file parses, but describes no robot.
    #[error("urdf: robot {robot:?} has no <link> (an export that failed or was never expanded from xacro?)")]
    NoLinks {
        /// Name of the robot, may be empty.
        robot: String,
    },
    /// Two links or two joints share a name.
    #[error("urdf: {kind} {name:?} is defined twice")]
    Duplicate {
        /// `link` or `joint`.
        kind: &'static str,
        /// The shared name.
        name: String,
    },
    /// A joint names a link that is not defined.
    #[error("urdf: joint {joint:?} joins link {link:?}, which is not defined")]
    UndefinedLink {
        /// The joint.
        joint: String,
        /// The link it names.
        link: String,
    },
    /// A link is the child of two joints.
    #[error("urdf: link {link:?} has two parents, through joints {first:?} and {second:?}")]
    TwoParents {
        /// The link.
        link: String,
        /// One joint above it.
        first: String,
        /// The other joint above it.
        second: String,
    },
    /// Following parents leads back to the same link.
    #[error("urdf: link {link:?} is its own ancestor (the joints form a cycle)")]
    Cycle {
        /// A link on the cycle.
        link: String,
    },
    /// There is no single link above all others.
    #[error("urdf: {} links have no parent ({}), so the base link has to be named", .roots.len(), .roots.join(", "))]
    ManyRoots {
        /// All links without a parent.
        roots: Vec<String>,
    },
    /// A link asked for is not in the file.
    #[error("link {link:?} is not in the URDF of {robot:?}; its links are {}", .links.join(", "))]
    UnknownLink {
        /// The link asked for.
        link: String,
        /// Name of the robot.
        robot: String,
        /// All links of the file.
        links: Vec<String>,
    },
    /// The base is not above the tip.
    #[error("link {tip:?} is not below link {base:?}; {}", above(.ancestors))]
    NotBelow {
        /// The tip asked for.
        tip: String,
        /// The base asked for.
        base: String,
        /// The links above the tip, nearest first.
        ancestors: Vec<String>,
    },
    /// A joint on the way has a type that one number does not describe.
    #[error("joint {joint:?} is {kind}, only fixed, revolute, continuous and prismatic joints can be computed")]
    JointType {
        /// The joint.
        joint: String,
        /// Its type.
        kind: &'static str,
    },
    /// A number of a joint is NaN, infinite, or an axis has no direction.
    #[error("joint {joint:?}: {what} is {value:?}, not usable")]
    JointNumber {
        /// The joint.
        joint: String,
        /// Which number.
        what: &'static str,
        /// Its value.
        value: [f64; 3],
    },
    /// A mimic joint follows a joint that does not exist, is fixed, or follows it in turn.
    #[error("joint {joint:?} mimics {source_joint:?}, which {why}")]
    Mimic {
        /// The mimic joint.
        joint: String,
        /// The joint it follows.
        source_joint: String,
        /// What is wrong.
        why: &'static str,
    },
    /// A joint of the chain is not among the names given.
    #[error("joint {joint:?} moves {tip:?} but is not among the joints given: {}", .given.join(", "))]
    MissingJoint {
        /// The joint.
        joint: String,
        /// The chain's tip.
        tip: String,
        /// The names given.
        given: Vec<String>,
    },
    /// A configuration has too few or too many numbers.
    #[error("{got} joint values given, the chain has {expected}: {}", .joints.join(", "))]
    JointCount {
        /// Numbers given.
        got: usize,
        /// Numbers needed.
        expected: usize,
        /// Names of the moving joints in order.
        joints: Vec<String>,
    },
    /// A joint value or velocity is NaN or infinite.
    #[error("joint {joint:?} is at {value}, not a finite number")]
    JointNotFinite {
        /// The joint.
        joint: String,
        /// Its value.
        value: f64,
    },
}

fn above(ancestors: &[String]) -> String {
    if ancestors.is_empty() {
        "no link is above it".to_owned()
    } else {
        format!("above it are {}", ancestors.join(", "))
    }
}
