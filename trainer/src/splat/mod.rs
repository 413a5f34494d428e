//! Scenes of 3D Gaussians.

#[cfg(test)]
mod against_twin;
pub mod arrays;
pub mod bench;
mod buffers;
#[cfg(test)]
mod change_against_twin;
pub mod cloud;
mod equirect;
pub mod kernels;
#[cfg(test)]
mod learning;
mod options;
mod params;
mod passes;
pub mod reference;
#[cfg(test)]
mod resuming;
mod seed;
mod trainer;
mod views;

pub use options::SplatOptions;
pub use trainer::SplatTrainer;
