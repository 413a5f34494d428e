//! Radiance fields trained on wgpu: keyframes in, pictures out.

mod aligned;
pub mod checkpoint;
mod error;
pub mod eval;
pub mod gpu;
mod keyframe_signature;
pub mod loss;
pub mod method;
#[cfg(test)]
mod mismatches;
pub mod nerf;
pub mod optim;
pub mod ply;
pub mod request;
pub mod sort;
pub mod splat;
pub mod spz;
#[cfg(test)]
#[path = "../../tests/common/test_data.rs"]
mod test_data;
#[cfg(test)]
mod test_scenes;

pub mod atomic_file;
pub mod tsdf;

pub use aligned::{Aligned, Restartable, ResumedModel};
pub use error::Error;
pub use method::{Method, Progress};
pub use request::{Aabb, Picture, Projection, RenderRequest};
