//! Scenes of 3D Gaussians.

#[cfg(test)]
mod against_twin;
pub mod arrays;
mod buffers;
pub mod cloud;
pub mod kernels;
mod params;
mod passes;
pub mod reference;
