//! Sizes of the pool of blocks and of the hash table, and the GPU memory that they take.

use super::block::N_VOXELS;
use gpu::Gpu;

/// Bytes per block on the GPU, for distances, colors, coordinates, and the flags `changed` and
/// `visible`.
pub(crate) const BYTES_PER_BLOCK: u64 = 512 * (4 + 8) + 16 + 4 + 4;
/// Bytes per chunk, for a key and the slots of its blocks.
pub(crate) const BYTES_PER_CHUNK: u64 = 4 + 4 * 512;

/// Sizes of the pool and the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Capacity {
    pub(crate) n_blocks: u32,
    /// Number of chunks in the hash table, which is a power of two.
    pub(crate) n_chunks: u32,
}

/// Maximum number of blocks that the adapter can bind.
pub(crate) fn max_blocks(gpu: &Gpu) -> u32 {
    // The colors, 8 bytes per voxel, are the largest buffer.
    u32::try_from(gpu.max_binding_bytes() / (8 * N_VOXELS as u64))
        .unwrap_or(u32::MAX)
        .max(1)
}

/// Maximum number of blocks that the adapter can bind and that fit into `max_bytes` together with
/// the table.
pub(crate) fn max_blocks_within(gpu: &Gpu, max_bytes: Option<u64>, n_chunks: u32) -> u32 {
    let table_bytes = u64::from(n_chunks) * BYTES_PER_CHUNK;
    let by_bytes = max_bytes.map_or(u64::MAX, |bytes| {
        bytes.saturating_sub(table_bytes) / BYTES_PER_BLOCK
    });
    // The result is at least one block, because empty buffers cannot be bound.
    max_blocks(gpu)
        .min(u32::try_from(by_bytes).unwrap_or(u32::MAX))
        .max(1)
}
