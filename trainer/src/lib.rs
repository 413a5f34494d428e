//! Trains radiance fields on wgpu. The inputs are keyframes, and the outputs are pictures.
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
mod bounds;
mod corrected_keyframe;
mod error;
pub mod eval;
mod failed_model;
pub mod floaters;
mod keyframe_signature;
pub mod loss;
#[cfg(test)]
mod mean_color;
pub mod method;
pub mod method_entry;
#[cfg(test)]
mod mismatches;
mod model_chunks;
mod model_metadata;
mod model_options;
mod model_spec;
pub mod nerf;
pub mod optim;
mod packing;
mod pending;
#[cfg(test)]
mod random;
mod registry;
pub mod request;
pub mod splat;
#[cfg(test)]
mod test_scenes;

pub mod tsdf;
mod view;

pub use aligned::{AlignedModel, ResumedModel};
pub use bounds::Bounds;
pub use corrected_keyframe::CorrectedKeyframe;
pub use error::Error;
pub use failed_model::FailedModel;
pub use method::{Method, Progress};
pub use model_chunks::{
    ChunkData, ChunkLayout, MAX_MESH_COUNT, ModelChunk, ModelChunks, PendingChunks,
};
pub use model_options::{AlignTiming, CommonOptions, MethodOptions, ModelOptions};
pub use model_spec::{
    KeyframeId, LoadedModel, ModelSpec, Resumed, load, resume, resume_without_missing,
};
pub use packing::{JPEG_QUALITY, PackedDepth, PackedPicture, Packing, QueuedPicture, Rendered};
pub use pending::{Pending, PendingCheckpoint};
pub use registry::ModelKind;
pub use request::{Picture, Projection, RenderRequest};
