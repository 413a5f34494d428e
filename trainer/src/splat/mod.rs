//! Scenes of 3D Gaussians.

pub mod arrays;
pub mod cloud;
pub mod reference;
