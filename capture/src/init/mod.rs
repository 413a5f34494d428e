//! A first rig file for the devices of this computer, as `fieldrig init` writes it.
//!
//! [`search`] finds devices, and moves none. [`RigPlan::new`] decides on the contents of the rig
//! file, from the findings and from what the user wants. [`RigPlan::to_toml`] writes the plan. The
//! last two steps do no I/O. [`NewRigFile`] checks and writes the file.

mod arm_plan;
mod camera_guess;
mod findings;
mod links;
mod new_rig_file;
mod plan;
mod rig_text;
mod robot_choice;
mod search;
#[cfg(test)]
mod tests;
mod wishes;

/// Beginning of the comment above a key whose value is a guess.
pub(crate) const GUESS: &str = "Guess: ";

pub use arm_plan::{likely_robot, missing_controller};
pub use findings::{
    ControllerKind, Findings, FoundBus, FoundCamera, FoundController, FoundMotor, FoundServos,
};
pub use links::ArmLinks;
pub use new_rig_file::NewRigFile;
pub use plan::{RigPlan, default_parent};
pub use search::{SearchPlan, controller_at, search};
pub use wishes::{RobotChoice, WantedCamera, Wishes};
