//! Files of models, which are splats, meshes, checkpoints and edits. This crate does not use the
//! GPU.
//!
//! ```
//! use model_files::edits::Edit;
//! use model_files::{Aabb, Edits};
//!
//! let mut edits = Edits::default();
//! edits.push(Edit::Box(Aabb {
//!     world_from_box: kinematics::Transform::identity(),
//!     min_m: [0.0; 3],
//!     max_m: [1.0; 3],
//! }))?;
//! assert!(edits.erases([0.5; 3]) && !edits.erases([0.5, 0.5, 2.0]));
//! # Ok::<(), model_files::Error>(())
//! ```

mod aabb;
pub mod checkpoint;
pub mod contraction;
pub mod edits;
mod error;
mod initial_points;
pub mod mesh;
mod run_history;
pub mod spherical_harmonics;
pub mod splat;

pub use aabb::Aabb;
pub use edits::Edits;
pub use error::Error;
pub use initial_points::InitialPoints;
pub use run_history::RunHistory;
