//! GPU access: one device, pipelines that bind buffers by reflection, and lists of passes.
//! Independent of splats.

mod device;
mod options;
mod passes;
mod pipeline;
mod pipeline_cache;
mod requirements;
#[cfg(test)]
pub(crate) mod testing;
mod wgsl;

pub use device::{Buffer, Gpu, PendingRead};
pub use kinematics::{f32_of, f32s_of};
pub use options::GpuOptions;
pub use passes::{PassTiming, Passes};
pub use pipeline::Kernel;
pub use pipeline_cache::Pipeline;
pub use requirements::Optional;
pub use wgsl::{Source, reflect, resolve};
