//! GPU access with one device, pipelines that bind buffers by their names in the WGSL, and lists of
//! passes. Only this crate encodes GPU commands. It does not depend on any scene model.
//!
//! [`Gpu`] opens the device, [`Pipeline`] compiles a [`Kernel`], and [`Passes`] records dispatches.
//! [`sort`] is a radix sort. [`shared`] contains WGSL that kernels of other crates also import.
//!
//! ```
//! use gpu::{Source, reflect, resolve, shared};
//!
//! let kernel = Source {
//!     name: "clear",
//!     text: "
//! #import folded
//! @group(0) @binding(0) var<storage, read_write> output: array<u32>;
//! @compute @workgroup_size(1)
//! fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u) {
//!     output[folded(wg, n_wgs)] = 0u;
//! }",
//! };
//! let module = reflect(kernel.name, &resolve(kernel, &[shared::FOLDED])?)?;
//! assert_eq!(module.entry_points[0].name, "main");
//! # Ok::<(), gpu::Error>(())
//! ```

mod device;
mod error;
mod options;
mod passes;
mod pipeline;
mod pipeline_cache;
mod requirements;
pub mod shared;
pub mod sort;
mod submits;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
mod wgsl;

pub use device::{Buffer, Gpu, PendingRead};
pub use error::Error;
pub use options::GpuOptions;
pub use passes::{PassTiming, Passes};
pub use pipeline::Kernel;
pub use pipeline_cache::Pipeline;
pub use requirements::Optional;
pub use submits::Submits;
pub use wgsl::{Source, reflect, resolve};
