//! Splats in spatial chunks, for viewers that draw them.
//!
//! A chunk contains the splats of one cell of an octree. Splats have no stable identity in
//! training, because growth reorders them, but cells have a stable identity. Within a chunk, the
//! most visible splats come first. The first few splats, enlarged, approximate the chunk.

mod cells;
mod codec;

use self::cells::{Cell, leaves, location_codes};
use self::codec::encode;
use crate::model_chunks::{ChunkData, ModelChunk, ModelChunks};
use model_files::splat::arrays::SplatArrays;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hasher};

pub(super) use self::codec::MAX_SH_DEGREE;

/// The coarse form of a chunk has one splat for every `COARSE_STRIDE` splats of the chunk. More
/// splats look better, but delay the first picture of the whole scene.
const COARSE_STRIDE: usize = 8;
/// The maximum factor by which coarse splats are enlarged. With a larger factor, they would blur
/// into blobs that hide other chunks.
const MAX_SCALE_FACTOR: f64 = 2.0;
/// Changes are measured in `N_PARTS` parts of a cell, which form a grid of 4 x 4 x 4.
const N_PARTS: usize = 64;
/// A change that does not affect the sums of the parts counts as this fraction of the sums.
/// Otherwise, a chunk whose splats only exchange positions would never be sent.
const MIN_CHANGE_FRAC: f64 = 1e-3;

/// Sums over the splats in each part of a cell. They are the visible area, and the visible area
/// times red, green and blue.
type Sums = [[f64; 4]; N_PARTS];

/// Divides the splats of successive versions of a model into chunks.
#[derive(Debug, Default)]
pub(super) struct Chunker {
    /// The chunks of the last version.
    last: BTreeMap<Cell, Content>,
}

/// What a chunk contained.
#[derive(Debug)]
struct Content {
    hash: u64,
    sums: Box<Sums>,
}

impl Chunker {
    /// The chunks of these splats, or only the chunks that differ from the last call.
    pub(super) fn chunks(&mut self, splats: &SplatArrays, only_changed: bool) -> ModelChunks {
        if !only_changed {
            self.last.clear();
        }
        // If there is no last version, the receiver has to discard chunks that it may still have.
        let is_complete = self.last.is_empty();
        let sorted = location_codes(&splats.means, &splats.visible());
        let cells = leaves(&sorted, &self.last);
        let made: Vec<(Cell, Content, ModelChunk)> = cells
            .into_par_iter()
            .map(|(cell, range)| {
                let (content, chunk) = encoded(splats, cell, &sorted[range], self.last.get(&cell));
                (cell, content, chunk)
            })
            .collect();
        // Cells that remain in `last` no longer exist, because they were divided, merged or
        // emptied.
        let mut last = std::mem::take(&mut self.last);
        let mut chunks = Vec::new();
        for (cell, content, chunk) in made {
            let is_unchanged = last
                .remove(&cell)
                .is_some_and(|before| before.hash == content.hash);
            self.last.insert(cell, content);
            if !is_unchanged {
                chunks.push(chunk);
            }
        }
        ModelChunks {
            is_complete,
            chunks,
            removed: last.into_keys().map(Cell::id).collect(),
        }
    }
}

/// Encodes the splats of a cell. `before` is its content in the last version.
fn encoded(
    splats: &SplatArrays,
    cell: Cell,
    members: &[(u64, u32)],
    before: Option<&Content>,
) -> (Content, ModelChunk) {
    let sums = sums(splats, cell, members);
    let mut members: Vec<u32> = members.iter().map(|(_, splat_ix)| *splat_ix).collect();
    // The most visible splats come first, because the coarse form consists of the first splats.
    members.sort_by(|a, b| area(splats, *b).total_cmp(&area(splats, *a)));
    let fine = encode(splats, &members, 1.0, splats.sh_degree);
    // A hash is stored instead of the bytes, because the bytes would double the memory of the
    // model.
    let mut hasher = DefaultHasher::new();
    hasher.write(&fine.bytes);
    // The bytes are relative to the box and the ranges in the layout. They stay the same if all
    // splats of a chunk move together.
    hasher.write(format!("{:?}", fine.layout).as_bytes());
    let content = Content {
        hash: hasher.finish(),
        sums,
    };
    let chunk = ModelChunk {
        id: cell.id(),
        change: change(before, &content),
        coarse: coarse(splats, &members),
        fine,
    };
    (content, chunk)
}

/// Opacity times the largest cross section of a splat, square meters up to a constant factor.
fn area(splats: &SplatArrays, splat_ix: u32) -> f64 {
    // This is the product of the two largest standard deviations, as a sum of logarithms.
    let log_scale = splats.log_scales[splat_ix as usize].map(f64::from);
    let smallest = log_scale.into_iter().fold(f64::INFINITY, f64::min);
    splats.opacity(splat_ix as usize) * (log_scale.iter().sum::<f64>() - smallest).exp()
}

/// The first splats of a chunk, enlarged so that they cover its area.
fn coarse(splats: &SplatArrays, members: &[u32]) -> Option<ChunkData> {
    let n = members.len().div_ceil(COARSE_STRIDE);
    let total = |members: &[u32]| members.iter().map(|ix| area(splats, *ix)).sum::<f64>();
    let ratio = total(members) / total(&members[..n]);
    // An area is proportional to the square of the scale.
    let scale_factor = ratio.sqrt().clamp(1.0, MAX_SCALE_FACTOR);
    // A coarse form with all splats would be as large as the fine form, so it is left out.
    (n < members.len()).then(|| encode(splats, &members[..n], scale_factor, 0))
}

/// Sums over the parts of a cell.
fn sums(splats: &SplatArrays, cell: Cell, members: &[(u64, u32)]) -> Box<Sums> {
    let mut sums: Box<Sums> = Box::new([[0.0; 4]; N_PARTS]);
    for (code, splat_ix) in members {
        let part = &mut sums[cell.part_of(*code)];
        let area = area(splats, *splat_ix);
        let color = splats.sh[*splat_ix as usize * splats.n_coefficients()];
        part[0] += area;
        for (sum, coefficient) in part[1..].iter_mut().zip(color) {
            *sum += area * (0.5 + codec::SH_0 * f64::from(coefficient));
        }
    }
    sums
}

/// Visible area that has changed, in square meters up to a constant factor.
fn change(before: Option<&Content>, after: &Content) -> f64 {
    let values = |content: &Content| content.sums.as_flattened().to_vec();
    let after = values(after);
    let before = before.map_or_else(|| vec![0.0; after.len()], values);
    let difference: f64 = after
        .iter()
        .zip(&before)
        .map(|(after, before)| (after - before).abs())
        .sum();
    difference + MIN_CHANGE_FRAC * after.iter().map(|sum| sum.abs()).sum::<f64>()
}

#[cfg(test)]
mod tests;
