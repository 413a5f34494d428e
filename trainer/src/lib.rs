//! Radiance fields trained on wgpu: keyframes in, pictures out.
//!
//! ```
//! use trainer::eval::{PixelPair, psnr};
//!
//! let (rendered, truth) = ([100; 4 * 6], [110; 4 * 6]);
//! let pair = PixelPair::new([3, 2], &rendered, &truth)?;
//! assert!((psnr(&pair)? - 20.0 * (255.0_f64 / 10.0).log10()).abs() < 1e-9);
//! # Ok::<(), trainer::Error>(())
//! ```

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
mod model_metadata;
pub mod nerf;
pub mod optim;
pub mod ply;
#[cfg(test)]
mod random;
pub mod request;
pub mod sort;
pub mod splat;
pub mod spz;
mod submits;
#[cfg(test)]
#[path = "../../tests/common/test_data.rs"]
mod test_data;
#[cfg(test)]
mod test_scenes;

pub mod atomic_file;
pub mod tsdf;
mod view;

pub use aligned::{Aligned, Restartable, ResumedModel};
pub use error::Error;
pub use method::{Method, Progress};
pub use request::{Aabb, Picture, Projection, RenderRequest};
