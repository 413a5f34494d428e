//! Counts that explain the time of a step.

use super::SplatTrainer;
use crate::Error;
use crate::splat::buffers::{n_bins, n_tiles};
use crate::splat::params::TILE_PX;

/// Counts of the last view that was drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct WorkCounts {
    /// Intersections of splats with tiles.
    pub(super) n_intersections: u64,
    /// Intersections up to the last splat that contributes to a pixel of the tile.
    pub(super) n_visible: u64,
    /// Length of the longest tile list.
    pub(super) longest_list: u64,
    /// Maximum number of visible intersections in a tile; not necessarily the tile of `longest_list`.
    pub(super) longest_visible: u64,
    /// Tiles that the largest splat touches.
    pub(super) largest_splat: u64,
}

impl SplatTrainer {
    /// Counts the work of the last view, whose size is `size_px`.
    pub(super) fn work_counts(&self, size_px: [u32; 2]) -> Result<WorkCounts, Error> {
        let gpu = &self.recorder.gpu;
        let scratch = self.renderer.scratch()?;
        let bin_starts: Vec<u32> = gpu.read(&scratch.bin_starts, n_bins(size_px) as usize + 1)?;
        let n_entries = bin_starts.last().copied().unwrap_or(0);
        let entries: Vec<[u32; 4]> = gpu.read(&scratch.entries, n_entries as usize)?;
        let last: Vec<u32> = gpu.read(self.optimizer.last_contributors()?, (size_px[0] * size_px[1]) as usize)?;
        let tile_counts: Vec<u32> = gpu.read(&scratch.tile_counts, self.model.splats.n_splats as usize)?;
        let columns = size_px[0].div_ceil(TILE_PX);
        let mut past_last = vec![0; n_tiles(size_px) as usize];
        for (pixel, last) in (0u32..).zip(&last) {
            let tile = pixel / size_px[0] / TILE_PX * columns + pixel % size_px[0] / TILE_PX;
            past_last[tile as usize] = (*last).max(past_last[tile as usize]);
        }
        let bin_columns = columns.div_ceil(4);
        let mut counts = WorkCounts {
            largest_splat: tile_counts.iter().copied().max().unwrap_or(0).into(),
            ..WorkCounts::default()
        };
        for (tile, past_last) in (0u32..).zip(past_last) {
            let (column, row) = (tile % columns, tile / columns);
            let bin = (row / 4 * bin_columns + column / 4) as usize;
            let mask = 1 << (row % 4 * 4 + column % 4);
            let list = &entries[bin_starts[bin] as usize..bin_starts[bin + 1] as usize];
            let touching = |part: &[[u32; 4]]| part.iter().filter(|entry| entry[1] & mask != 0).count() as u64;
            let (n, n_visible) = (touching(list), touching(&list[..past_last as usize]));
            counts.n_intersections += n;
            counts.n_visible += n_visible;
            counts.longest_list = counts.longest_list.max(n);
            counts.longest_visible = counts.longest_visible.max(n_visible);
        }
        Ok(counts)
    }
}
