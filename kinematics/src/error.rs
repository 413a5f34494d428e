//! Errors that this crate returns for invalid input.

/// The reason why an input was rejected.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A matrix contains NaN or infinity.
    #[error("transform: element {row},{column} is {value}, not a finite number")]
    TransformNotFinite {
        /// Row, from 0.
        row: usize,
        /// Column, from 0.
        column: usize,
        /// Value found.
        value: f64,
    },
    /// The upper left 3x3 block is not a rotation, but is scaled, sheared or mirrored.
    #[error(
        "transform: not rigid: its axes deviate from unit length or right angles by {off:.2e} (at most {allowed:.0e}), and its determinant is {determinant:.4}; {}",
        rotation_advice(*.off, *.determinant)
    )]
    NotRigid {
        /// Largest element of `|RᵀR - 1|`.
        off: f64,
        /// Largest value accepted.
        allowed: f64,
        /// Determinant of the 3x3 block.
        determinant: f64,
    },
    /// The last row of the 4x4 matrix is not `0 0 0 1`.
    #[error("transform: last row is {row:?}, must be [0, 0, 0, 1]")]
    LastRow {
        /// The row found.
        row: [f64; 4],
    },
    /// A lens parameter is out of its range.
    #[error("camera intrinsics: {what} is {value}, must be {allowed}")]
    Intrinsics {
        /// Name of the value.
        what: &'static str,
        /// Value found.
        value: f64,
        /// Accepted values.
        allowed: &'static str,
    },
    /// A pixel buffer does not fit the camera's image size.
    #[error("image has {got} values, expected {expected} for {width} x {height} pixels")]
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
    /// A COLLADA file cannot be read.
    #[error("{why}")]
    Collada {
        /// The reason, in one sentence.
        why: String,
    },
    /// The text is not XML, or describes no robot.
    #[error("urdf: cannot be read: {why}")]
    UrdfSyntax {
        /// Parser message.
        why: String,
    },
    /// An element that the kinematics depend on is invalid.
    #[error("urdf: line {line}: {what}: {why}")]
    UrdfElement {
        /// Line in the file, from 1.
        line: u32,
        /// Kind and name of the element.
        what: String,
        /// Description of the problem.
        why: String,
    },
    /// The file parses but contains no robot.
    #[error(
        "urdf: robot {robot:?} has no <link> (an export that failed or was never expanded from xacro?)"
    )]
    NoLinks {
        /// Name of the robot. It may be empty.
        robot: String,
    },
    /// Two links or two joints share a name.
    #[error("urdf: {kind} {name:?} is defined twice, in lines {} and {}", .lines[0], .lines[1])]
    Duplicate {
        /// `link` or `joint`.
        kind: &'static str,
        /// The shared name.
        name: String,
        /// Lines of both elements, from 1.
        lines: [u32; 2],
    },
    /// A joint refers to an undefined link.
    #[error("urdf: joint {joint:?} joins link {link:?}, which is not defined")]
    UndefinedLink {
        /// The joint.
        joint: String,
        /// The undefined link.
        link: String,
    },
    /// A link is the child of two joints.
    #[error("urdf: link {link:?} has two parents, through joints {first:?} and {second:?}")]
    TwoParents {
        /// The link.
        link: String,
        /// First joint above it.
        first: String,
        /// Second joint above it.
        second: String,
    },
    /// A link is its own ancestor.
    #[error("urdf: link {link:?} is its own ancestor (the joints form a cycle)")]
    Cycle {
        /// A link in the cycle.
        link: String,
    },
    /// The tree has no unique root link.
    #[error("urdf: {} links have no parent ({}), so the base link has to be named", .roots.len(), .roots.join(", "))]
    ManyRoots {
        /// All links without a parent.
        roots: Vec<String>,
    },
    /// A requested link is not in the file.
    #[error("link {link:?} is not in the URDF of {robot:?}; its links are {}", .links.join(", "))]
    UnknownLink {
        /// Requested link.
        link: String,
        /// Name of the robot.
        robot: String,
        /// All links of the file.
        links: Vec<String>,
    },
    /// The base link is not an ancestor of the tip link.
    #[error("link {tip:?} is not below link {base:?}; {}", above(.ancestors))]
    NotBelow {
        /// Requested tip link.
        tip: String,
        /// Requested base link.
        base: String,
        /// The links above the tip, nearest first.
        ancestors: Vec<String>,
    },
    /// A joint on the path has a type with more than one degree of freedom.
    #[error(
        "joint {joint:?} has the type {kind}; only fixed, revolute, continuous and prismatic joints are supported"
    )]
    JointType {
        /// The joint.
        joint: String,
        /// Its type.
        kind: &'static str,
    },
    /// A mimic joint cannot be followed. The joint that it follows does not exist or is not
    /// revolute, continuous or prismatic, or mimic joints form a loop.
    #[error("joint {joint:?} mimics {source_joint:?}, which {why}")]
    Mimic {
        /// The mimic joint.
        joint: String,
        /// The joint it follows.
        source_joint: String,
        /// Description of the problem.
        why: &'static str,
    },
    /// A joint of the chain is not among the given names.
    #[error("joint {joint:?} moves {tip:?} but is not among the joints given: {}", .given.join(", "))]
    MissingJoint {
        /// The joint.
        joint: String,
        /// Tip link of the chain.
        tip: String,
        /// Given names.
        given: Vec<String>,
    },
    /// A configuration has the wrong number of values.
    #[error("{got} joint values given, the chain has {expected}: {}", .joints.join(", "))]
    JointCount {
        /// Number of values given.
        got: usize,
        /// Number of values expected.
        expected: usize,
        /// Names of the moving joints in order.
        joints: Vec<String>,
    },
    /// The range of a joint contains no value.
    #[error("joint {joint:?}: its range from {lower} to {upper} contains no value")]
    JointRange {
        /// The joint.
        joint: String,
        /// Lower end of the range.
        lower: f64,
        /// Upper end of the range.
        upper: f64,
    },
    /// A setting of inverse kinematics is out of its range.
    #[error("inverse kinematics: {what} is {value}, must be {allowed}")]
    InverseSetting {
        /// Name of the value.
        what: &'static str,
        /// Value found.
        value: f64,
        /// Accepted values.
        allowed: &'static str,
    },
    /// A joint position or velocity is NaN or infinite.
    #[error("joint {joint:?}: {value} is not a finite number")]
    JointNotFinite {
        /// The joint.
        joint: String,
        /// Its position or velocity.
        value: f64,
    },
}

/// What to change in a matrix whose 3x3 block is not a rotation.
///
/// * `off`: largest element of `|RᵀR - 1|`.
fn rotation_advice(off: f64, determinant: f64) -> &'static str {
    const MAX_ROUNDING: f64 = 0.2; // Matrices with one decimal deviate from a rotation by up to this.
    if determinant < 0.0 {
        "it is mirrored: check the sign of each axis"
    } else if off > MAX_ROUNDING {
        "expected a rotation without scale and shear"
    } else {
        "if the numbers were rounded, write at least four decimals"
    }
}

fn above(ancestors: &[String]) -> String {
    if ancestors.is_empty() {
        "no link is above it".to_owned()
    } else {
        format!("above it are {}", ancestors.join(", "))
    }
}
