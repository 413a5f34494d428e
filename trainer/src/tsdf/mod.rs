//! Truncated signed distance fields with color, built from keyframes with depth. They are the
//! baseline for meshes.
//!
//! `docs/design/tsdf.md` follows a depth image through the kernels.

pub mod block;
mod bounds;
mod buffers;
mod capacity;
mod chosen_grid;
mod entry;
mod files;
pub mod kernels;
mod marching;
mod mesh;
mod mesh_buffers;
mod model;
mod options;
mod params;
mod passes;
pub mod reference;
mod transfer;

#[cfg(test)]
mod against_twin;
#[cfg(test)]
mod edit_tests;
#[cfg(test)]
mod tests;

pub use chosen_grid::VoxelGrid;
pub(crate) use entry::ENTRY;
pub use model::TsdfModel;
pub use options::TsdfOptions;
