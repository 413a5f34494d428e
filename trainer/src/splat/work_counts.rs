//! Counts that explain the time of a step.

use super::buffers::{ImageBuffers, Scratch, n_bins, n_tiles};
use super::params::TILE_PX;
use crate::Error;
use gpu::Gpu;
use serde::Serialize;
use std::fmt;

/// Counts of the last view that was drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct WorkCounts {
    /// Intersections of splats with tiles.
    pub n_intersections: u64,
    /// Intersections up to the last splat that contributes to a pixel of the tile.
    pub n_visible: u64,
    /// Number of tiles.
    pub n_tiles: u64,
    /// Length of the longest tile list.
    pub longest_list: u64,
    /// Maximum number of visible intersections in a tile. This is not necessarily the tile of
    /// `longest_list`.
    pub longest_visible: u64,
    /// Tiles that the largest splat touches.
    pub largest_splat: u64,
}

impl WorkCounts {
    /// Counts the work of the last view, whose size is `size_px`.
    pub(crate) fn read(
        gpu: &Gpu,
        scratch: &Scratch,
        image_buffers: &ImageBuffers,
        n_splats: u32,
        size_px: [u32; 2],
    ) -> Result<Self, Error> {
        // The kernels need no list per tile, so its length is counted here from the masks of the
        // bin's entries.
        let bin_starts: Vec<u32> = gpu.read(&scratch.bin_starts, n_bins(size_px) as usize + 1)?;
        let n_entries = bin_starts.last().copied().unwrap_or(0);
        let entries: Vec<[u32; 4]> = gpu.read(&scratch.entries, n_entries as usize)?;
        // For each pixel, this is the index after the last splat that contributes to it, counted
        // from the start of the bin's list.
        let last: Vec<u32> = gpu.read(&image_buffers.last, (size_px[0] * size_px[1]) as usize)?;
        let tile_counts: Vec<u32> = gpu.read(&scratch.tile_counts, n_splats as usize)?;
        let columns = size_px[0].div_ceil(TILE_PX);
        let mut past_last = vec![0; n_tiles(size_px) as usize];
        for (pixel, last) in (0u32..).zip(&last) {
            let tile = pixel / size_px[0] / TILE_PX * columns + pixel % size_px[0] / TILE_PX;
            past_last[tile as usize] = (*last).max(past_last[tile as usize]);
        }
        let bin_columns = columns.div_ceil(4);
        let mut counts = Self {
            n_tiles: past_last.len() as u64,
            largest_splat: tile_counts.iter().copied().max().unwrap_or(0).into(),
            ..Self::default()
        };
        for (tile, past_last) in (0u32..).zip(past_last) {
            let column = tile % columns;
            let row = tile / columns;
            let bin = (row / 4 * bin_columns + column / 4) as usize;
            // One bit per tile of the bin, row by row.
            let mask = 1 << (row % 4 * 4 + column % 4);
            let list = &entries[bin_starts[bin] as usize..bin_starts[bin + 1] as usize];
            let touching =
                |part: &[[u32; 4]]| part.iter().filter(|entry| entry[1] & mask != 0).count() as u64;
            let n = touching(list);
            let n_visible = touching(&list[..past_last as usize]);
            counts.n_intersections += n;
            counts.n_visible += n_visible;
            counts.longest_list = counts.longest_list.max(n);
            counts.longest_visible = counts.longest_visible.max(n_visible);
        }
        Ok(counts)
    }
}

impl fmt::Display for WorkCounts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            n_intersections,
            n_visible,
            n_tiles,
            longest_list,
            longest_visible,
            largest_splat,
        } = self;
        let visible_percent = 100.0 * *n_visible as f64 / (*n_intersections).max(1) as f64;
        let mean_list = n_intersections / (*n_tiles).max(1);
        write!(
            f,
            "{n_intersections} intersections of splats and tiles, {visible_percent:.0} % visible; tile lists: mean \
             {mean_list}, longest {longest_list}, most visible in one tile {longest_visible}; largest splat touches \
             {largest_splat} of {n_tiles} tiles"
        )
    }
}
