//! Inverse kinematics: joint values that give the tip of a chain a pose.
//!
//! [`InverseSolver::solve`] finds joint values for one pose, and [`InverseSolver::servo`] takes one
//! step toward a moving pose at bounded joint speeds. Results are always within the ranges of the
//! joints. They do not depend on time or on earlier calls, so the same input gives the same bits.
//!
//! - Any chain is solved by damped least squares within the ranges (`descent.rs`, Sugihara 2011).
//!   The search restarts from reproducible random configurations.
//! - Arms with the geometry of a Franka arm have a closed form for a given last joint (`franka.rs`,
//!   He and Liu 2021), and the last joint is searched. This geometry is detected from the chain.
//! - Servo steps are damped only in nearly singular directions (`servo.rs`, Maciejewski and Klein
//!   1988).
//!
//! ```
//! use kinematics::Chain;
//! use kinematics::inverse::{InverseSolver, Orientation, Target};
//!
//! let urdf = r#"<robot name="planar">
//!   <link name="base"/> <link name="upper"/> <link name="fore"/> <link name="hand"/>
//!   <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
//!     <axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
//!   <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/>
//!     <origin xyz="0.4 0 0"/><axis xyz="0 0 1"/>
//!     <limit lower="0" upper="3" velocity="1" effort="1"/></joint>
//!   <joint name="grip" type="fixed"><parent link="fore"/><child link="hand"/>
//!     <origin xyz="0.3 0 0"/></joint>
//! </robot>"#;
//! let chain = Chain::from_urdf(urdf, "base", "hand")?;
//! let mut solver = InverseSolver::new(chain.clone())?;
//! // The arm has two joints, so the orientation is left free.
//! let target = Target {
//!     base_from_tip: kinematics::Transform::translation(0.3, 0.4, 0.0),
//!     orientation: Orientation::Free,
//! };
//! let joints = solver.solve(&target, &[0.0, 1.0])?;
//! let reached = chain.forward(&joints)?.translation.vector;
//! assert!((reached - target.base_from_tip.translation.vector).norm() < 1e-6);
//! # Ok::<(), kinematics::inverse::Unsolved>(())
//! ```

mod bounds;
mod comfort;
mod descent;
mod failure;
mod franka;
mod franka_search;
mod least_squares;
mod servo;
mod solver;
mod target;

pub use failure::{JointBeyond, Nearest, Unsolved};
pub use franka::{Branch, FrankaArm, FrankaSolutions};
pub use least_squares::damped_change;
pub use servo::{ServoLimits, ServoStep};
pub use solver::InverseSolver;
pub use target::{Orientation, PoseGap, Target, pose_error};

#[cfg(test)]
mod franka_tests;
#[cfg(test)]
mod reach_tests;
#[cfg(test)]
mod robots_for_tests;
#[cfg(test)]
mod servo_tests;
#[cfg(test)]
mod solver_tests;
