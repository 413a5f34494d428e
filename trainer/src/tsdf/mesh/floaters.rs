//! Finds small parts of a mesh that are not connected to its large parts.

use super::Mesh;
use crate::Bounds;
use crate::edits::{CellGrid, CellLabels, Floaters, is_floater_size};
use nalgebra::Vector3;

/// Width of the cells with which floaters are erased, voxels.
const CELL_VOXELS: f64 = 2.0;
/// Number of these cells along an axis, half of which cover the larger part of the mesh.
const N_CELLS_RANGE: [f64; 2] = [64.0, 1024.0];

/// The small parts of a mesh; `None` if there are none.
pub(in crate::tsdf) fn floaters(mesh: &Mesh, voxel_m: f64) -> Option<Floaters> {
    let parts = Parts::of(mesh);
    let positions_m: Vec<[f64; 3]> = mesh
        .positions_m
        .iter()
        .map(|offset_m| std::array::from_fn(|axis| mesh.origin_m[axis] + f64::from(offset_m[axis])))
        .collect();
    let Bounds { center_m, radius_m } = Bounds::of_points(&positions_m)?;
    let n_cells = (4.0 * radius_m / (CELL_VOXELS * voxel_m)).clamp(N_CELLS_RANGE[0], N_CELLS_RANGE[1]);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped")]
    let grid = CellGrid { center_m, radius_m, n_cells: n_cells as u32 };
    let mut labels = CellLabels::default();
    for corners in &mesh.triangles {
        let is_floating = is_floater_size(parts.n_triangles_with(corners[0]), mesh.triangles.len());
        let cells = corners.map(|ix| grid.cell_at(positions_m[ix as usize]));
        if is_floating { &mut labels.floating } else { &mut labels.kept }.extend(cells);
    }
    let cells = labels.erased(&grid)?;
    let is_erased = |corners: &&[u32; 3]| {
        let sum: Vector3<f64> = corners.iter().map(|ix| Vector3::from(positions_m[*ix as usize])).sum();
        cells.contains((sum / 3.0).into())
    };
    let n_erased = mesh.triangles.iter().filter(is_erased).count() as u64;
    Some(Floaters { cells, n_erased, item: "triangle" })
}

/// The connected parts of a mesh.
struct Parts {
    /// For each vertex, another vertex of its part, closer to the part's representative, which refers to itself.
    parents: Vec<u32>,
    /// For each representative, the number of triangles.
    n_triangles: Vec<usize>,
}

impl Parts {
    fn of(mesh: &Mesh) -> Self {
        let n_vertices = mesh.positions_m.len();
        let mut parts = Self { parents: (0..).take(n_vertices).collect(), n_triangles: vec![0; n_vertices] };
        for [a, b, c] in &mesh.triangles {
            parts.join(*a, *b);
            parts.join(*a, *c);
        }
        for [a, ..] in &mesh.triangles {
            let part = parts.representative(*a);
            parts.n_triangles[part as usize] += 1;
        }
        parts
    }

    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.representative(a), self.representative(b));
        self.parents[a.max(b) as usize] = a.min(b);
    }

    /// The representative of a vertex's part. Shortens the path to it.
    fn representative(&mut self, mut vertex: u32) -> u32 {
        while self.parents[vertex as usize] != vertex {
            let parent = self.parents[vertex as usize];
            self.parents[vertex as usize] = self.parents[parent as usize];
            vertex = parent;
        }
        vertex
    }

    fn n_triangles_with(&self, mut vertex: u32) -> usize {
        while self.parents[vertex as usize] != vertex {
            vertex = self.parents[vertex as usize];
        }
        self.n_triangles[vertex as usize]
    }
}
