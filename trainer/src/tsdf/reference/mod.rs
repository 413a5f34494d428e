//! f64 twins of the kernels, written for clarity rather than speed.

mod allocate;
mod cast;
mod integrate;
mod march;
mod readings;

pub use allocate::{RequiredBlocks, required_blocks};
pub use cast::{Hit, Ray, cast};
pub use integrate::{Voxel, VoxelBlocks, integrate, unobserved};
pub use march::{BlockTriangles, Vertex, march};
pub use readings::{Reading, readings};
