//! Scenes of 3D Gaussians (splats).

#[cfg(test)]
mod against_twin;
#[cfg(test)]
mod alignment_tests;
pub mod arrays;
pub mod bench;
mod buffers;
mod camera_params;
#[cfg(test)]
mod change_against_twin;
#[cfg(test)]
mod checkpoint_tests;
pub mod cloud;
pub mod kernels;
#[cfg(test)]
mod non_finite_tests;
mod options;
mod params;
mod passes;
pub mod reference;
mod schedule;
mod seed;
mod snapshot;
mod trainer;
#[cfg(test)]
mod training_tests;
#[cfg(test)]
mod trial_tests;
mod trials;
mod views;

pub use options::SplatOptions;
pub use trainer::SplatTrainer;
pub use trials::CountPolicy;
