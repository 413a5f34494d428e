//! The simulation of a rig file's robot, with its kinematics, its body, its scene and its motion.

mod body;
mod description;
mod efforts;
mod follower;
mod mesh_file;
mod model;
mod plan;
mod room;
mod table;
#[cfg(test)]
mod tests;
mod trial;
mod viewpoints;

pub(crate) use body::RobotBody;
pub use description::RobotConfig;
pub(crate) use efforts::Efforts;
pub(crate) use follower::TwinFollower;
pub(crate) use model::TwinModel;
pub(crate) use plan::{Pedestal, TwinPlan, plan};
pub(crate) use trial::sees;
