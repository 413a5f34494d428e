//! What the user wants in a rig file.

use crate::config::Parent;
use crate::known_robots::KnownRobot;

/// What the user wants. `None` and empty lists leave the decision to the findings.
#[derive(Clone, Debug, PartialEq)]
pub struct Wishes {
    /// The robot.
    pub robot: RobotChoice,
    /// Base link of the robot.
    pub base_link: Option<String>,
    /// Link to which cameras on the arm are attached.
    pub tip: Option<String>,
    /// The cameras.
    pub cameras: Vec<WantedCamera>,
    /// Horizontal field of view of webcams, degrees.
    pub field_of_view_deg: f64,
    /// Whether the base moves, and another program sends its pose.
    pub has_moving_base: bool,
}

/// The robot of a rig file.
#[derive(Clone, Debug, PartialEq)]
pub enum RobotChoice {
    /// The robot that was found, or an example.
    Automatic,
    /// No arm.
    None,
    /// A robot whose description is part of the program.
    Known(&'static KnownRobot),
    /// The robot of a file.
    Urdf {
        /// Its path relative to the rig file.
        path: String,
        /// Its text.
        text: String,
    },
}

/// A camera that the user wants.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WantedCamera {
    /// Frame to which it is attached.
    pub parent: Parent,
    /// Value of the key `device`. `None`: the next camera that was found.
    pub device: Option<String>,
}
