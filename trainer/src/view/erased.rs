//! Erased space on the GPU.

use crate::Error;
use gpu::{Buffer, Gpu, Passes};
use model_files::edits::{CellGrid, CellSet, Edit};
use model_files::{Aabb, Edits};
use nalgebra::{Matrix4, Vector3};
use numbers::{f32_of, f32s_of};
use std::sync::Arc;

/// Number of groups of four words per edit in [`words`]. Three groups are rows of a transform, and
/// two groups depend on the kind of edit.
const GROUPS_PER_EDIT: usize = 5;

/// The buffers of shared/erased.wgsl. Views without edits have a separate buffer, so that no buffer
/// is replaced when views with and without edits alternate.
#[derive(Debug)]
pub(crate) struct ErasedSpace {
    nothing: Buffer,
    newest: Option<Erased>,
}

/// The edits of the last view that had any.
#[derive(Debug)]
struct Erased {
    edits: Arc<Edits>,
    world_from_drawn: Matrix4<f64>,
    buffer: Buffer,
}

impl Erased {
    /// Whether the buffer holds these edits in this frame.
    fn is_of(&self, edits: &Arc<Edits>, world_from_drawn: &Matrix4<f64>) -> bool {
        // All requests of one client point to the same edits, so comparing the addresses is usually
        // sufficient.
        let has_same_edits = Arc::ptr_eq(&self.edits, edits) || self.edits == *edits;
        has_same_edits && self.world_from_drawn == *world_from_drawn
    }
}

impl ErasedSpace {
    /// Nothing is erased.
    pub(crate) fn none(gpu: &Gpu) -> Result<Self, Error> {
        Ok(Self {
            nothing: buffer(gpu, &Edits::default(), &Matrix4::identity())?,
            newest: None,
        })
    }

    /// The buffer of these edits. Replaces the previous buffer if the edits or the frame have
    /// changed.
    ///
    /// * `world_from_drawn`: maps points of the kernel to world, meters.
    pub(crate) fn set(
        &mut self,
        gpu: &Gpu,
        passes: &mut Passes,
        edits: &Arc<Edits>,
        world_from_drawn: Matrix4<f64>,
    ) -> Result<&Buffer, Error> {
        if edits.is_empty() {
            return Ok(&self.nothing);
        }
        let same = self
            .newest
            .take()
            .filter(|erased| erased.is_of(edits, &world_from_drawn));
        let erased = match same {
            Some(erased) => erased,
            None => {
                // Cached bindings hold the previous buffer, which would not be freed.
                passes.clear_bindings();
                Erased {
                    edits: Arc::clone(edits),
                    world_from_drawn,
                    buffer: buffer(gpu, edits, &world_from_drawn)?,
                }
            }
        };
        Ok(&self.newest.insert(erased).buffer)
    }
}

fn buffer(gpu: &Gpu, edits: &Edits, world_from_drawn: &Matrix4<f64>) -> Result<Buffer, Error> {
    Ok(gpu.storage_with(
        "erased",
        bytemuck::cast_slice(&words(edits, world_from_drawn)),
    )?)
}

/// The data of shared/erased.wgsl, for kernels whose frame and units differ from the frame and
/// units of the world.
///
/// * `world_from_drawn`: maps points of the kernel to world, meters.
fn words(edits: &Edits, world_from_drawn: &Matrix4<f64>) -> Vec<[u32; 4]> {
    // All edits have the same size, so that a kernel finds each one by its index. The number of
    // cell ranges varies, so the ranges follow after the last edit. Each edit refers to its ranges.
    let n = u32::try_from(edits.len()).expect("at most 64");
    let mut words = vec![[n, 0, 0, 0]];
    let mut ranges: Vec<[u32; 4]> = Vec::new();
    let first_range = 1 + GROUPS_PER_EDIT * edits.len();
    for edit in edits.as_slice() {
        words.extend(match edit {
            Edit::Box(aabb) => box_words(aabb, world_from_drawn),
            Edit::Cells(cells) => {
                let first = u32::try_from(first_range + ranges.len()).unwrap_or(u32::MAX);
                ranges.extend(range_words(cells));
                cell_words(cells, world_from_drawn, first)
            }
        });
    }
    words.extend(ranges);
    words
}

/// The data of a box: rows of its transform, and its corners. A last word of 0 marks a box.
fn box_words(aabb: &Aabb, world_from_drawn: &Matrix4<f64>) -> [[u32; 4]; GROUPS_PER_EDIT] {
    let [x, y, z] = rows(&(aabb.world_from_box.inverse().to_homogeneous() * world_from_drawn));
    [x, y, z, corner_words(aabb.min_m), corner_words(aabb.max_m)]
}

/// A corner of a box, as bits of f32.
fn corner_words(corner_m: [f64; 3]) -> [u32; 4] {
    let [x, y, z] = f32s_of(corner_m).map(f32::to_bits);
    [x, y, z, 0]
}

/// The data of a set of cells: rows of the transform to units of the radius, number of cells along
/// an axis, the group where the ranges begin, and their number.
fn cell_words(
    cells: &CellSet,
    world_from_drawn: &Matrix4<f64>,
    first: u32,
) -> [[u32; 4]; GROUPS_PER_EDIT] {
    let CellGrid {
        center_m,
        radius_m,
        n_cells,
    } = *cells.grid();
    let scale = Matrix4::new_scaling(1.0 / radius_m);
    let [x, y, z] =
        rows(&(scale * Matrix4::new_translation(&-Vector3::from(center_m)) * world_from_drawn));
    let n_ranges = u32::try_from(cells.ranges().len()).unwrap_or(u32::MAX);
    [x, y, z, [n_cells, 0, 0, first], [0, 0, 0, n_ranges]]
}

/// The ranges of a set of cells, two per group of four words.
fn range_words(cells: &CellSet) -> impl Iterator<Item = [u32; 4]> {
    cells.ranges().chunks(2).map(|pair| {
        let [a, b] = pair[0];
        let [c, d] = pair.get(1).copied().unwrap_or_default();
        [a, b, c, d]
    })
}

/// The upper three rows of a matrix, as bits of f32.
fn rows(matrix: &Matrix4<f64>) -> [[u32; 4]; 3] {
    std::array::from_fn(|row| std::array::from_fn(|column| f32_of(matrix[(row, column)]).to_bits()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use gpu::testing::test_gpu;
    use kinematics::Transform;

    #[test]
    fn alternating_views_with_and_without_edits_keep_their_buffers() {
        let gpu = test_gpu();
        let mut passes = Passes::default();
        let mut erased = ErasedSpace::none(&gpu).unwrap();
        let with_boxes = |n: usize| {
            let aabb = Aabb {
                world_from_box: Transform::identity(),
                min_m: [0.0; 3],
                max_m: [1.0; 3],
            };
            let mut edits = Edits::default();
            (0..n).for_each(|_| edits.push(Edit::Box(aabb)).unwrap());
            Arc::new(edits)
        };
        let mut id_of = |edits: &Arc<Edits>, scale: f64| {
            erased
                .set(&gpu, &mut passes, edits, Matrix4::new_scaling(scale))
                .unwrap()
                .id()
        };
        let none = Arc::default();
        let one = with_boxes(1);
        let other = with_boxes(2);
        let ids = [id_of(&none, 1.0), id_of(&one, 1.0)];
        for _ in 0..3 {
            assert_eq!([id_of(&none, 2.0), id_of(&one, 1.0)], ids);
        }
        assert_ne!(id_of(&one, 2.0), ids[1], "another frame");
        assert_ne!(id_of(&other, 2.0), id_of(&one, 2.0), "other edits");
        assert_eq!(id_of(&none, 1.0), ids[0]);
    }
}
