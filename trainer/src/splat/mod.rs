//! Scenes of 3D Gaussians.

pub mod reference;
