//! Extracts the triangle mesh of the surface of a field.

mod cases;
mod chunks;
mod floaters;
mod mesher;

pub(super) use cases::CASES;
pub(super) use chunks::ChangedChunks;
pub(super) use floaters::floaters;
#[cfg(test)]
pub(super) use mesher::unit_of;
pub(super) use mesher::{BlockMesh, BlockMeshes, Mesher, joined};

#[cfg(test)]
mod chunk_tests;
#[cfg(test)]
mod tests;
