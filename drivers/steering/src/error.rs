//! Errors of a configuration, found before the arm moves.

/// Why a chain of decisions cannot be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The robot has no shape.
    #[error(
        "robot {robot:?} has no collision or visual shapes, so collisions cannot be detected: add shapes to its URDF"
    )]
    NoShapes {
        /// Name of the robot.
        robot: String,
    },
    /// The shapes of a record do not fit its robot.
    #[error("the record has no shapes of the robot, or shapes that do not fit it: it is damaged")]
    Shapes,
    /// The state of a record does not fit its robot.
    #[error("the state in the record has {got} joints, the robot has {expected}: it is damaged")]
    State {
        /// Number found.
        got: usize,
        /// Number expected.
        expected: usize,
    },
    /// The state of a record is that of another robot.
    #[error("the state in the record does not fit the parts of its robot: it is damaged")]
    Parts,
    /// A value is out of its range.
    #[error("steering: {what} is {value}, must be {expected}")]
    Value {
        /// Name of the value.
        what: String,
        /// Value found.
        value: f64,
        /// Accepted values.
        expected: &'static str,
    },
    /// A list has the wrong length.
    #[error("steering: {what} has {got} joints, the arm has {expected}")]
    JointCount {
        /// Name of the list.
        what: &'static str,
        /// Length found.
        got: usize,
        /// Length expected.
        expected: usize,
    },
    /// The generator of setpoints rejects the limits or the position.
    #[error("steering: {why}")]
    Generator {
        /// Its message.
        why: String,
    },
    /// The limits of a base are not valid.
    #[error("steering: {why}")]
    BaseLimits {
        /// What is wrong.
        why: String,
    },
    /// The chain of joints rejects its values.
    #[error(transparent)]
    Kinematics(#[from] kinematics::Error),
}
