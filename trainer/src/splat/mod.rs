//! Scenes of 3D Gaussians.

#[cfg(test)]
mod against_twin;
#[cfg(test)]
mod aligned;
pub mod arrays;
pub mod bench;
mod buffers;
mod camera_terms;
#[cfg(test)]
mod change_against_twin;
pub mod cloud;
pub mod kernels;
#[cfg(test)]
mod learning;
mod options;
mod params;
mod passes;
#[cfg(test)]
mod poison;
pub(crate) mod projections;
pub mod reference;
#[cfg(test)]
mod resuming;
mod seed;
mod trainer;
#[cfg(test)]
mod trial_tests;
mod trials;
mod views;

pub use camera_terms::{CameraFix, N_CODE, PosedLens, TermSet};
pub(crate) use camera_terms::{between, drift_share, moved, shares_lens};
pub use options::SplatOptions;
pub(crate) use params::{Camera, View};
pub use trainer::SplatTrainer;
pub(crate) use trainer::read_about;
pub use trials::{CameraChoice, Candidate, CountChoice, Trial};
pub(crate) use views::{depth_in_color_view, median_depth_m};
