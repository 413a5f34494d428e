//! Finds small parts of a mesh that are not connected to its large parts.

use crate::Bounds;
use crate::floaters::{CellLabels, Floaters, Groups, is_floater_size};
use model_files::edits::CellGrid;
use model_files::mesh::Mesh;
use nalgebra::Vector3;

/// Width of the cells with which floaters are erased, voxels. Narrower cells separate floaters
/// better from nearby surfaces, but more of them are needed. The largest grid has 1024 cells along
/// an axis.
const CELL_VOXELS: f64 = 2.0;
/// Smallest and largest number of these cells along an axis. Half of the cells along an axis cover
/// the larger part of the mesh.
const N_CELLS_RANGE: [f64; 2] = [64.0, 1024.0];

/// The small parts of a mesh. `None` if there are none.
pub(in crate::tsdf) fn floaters(mesh: &Mesh, voxel_m: f64) -> Option<Floaters> {
    let part_sizes = part_sizes(mesh);
    let positions_m: Vec<[f64; 3]> = mesh
        .positions_m
        .iter()
        .map(|offset_m| std::array::from_fn(|axis| mesh.origin_m[axis] + f64::from(offset_m[axis])))
        .collect();
    let Bounds {
        center_m, radius_m, ..
    } = Bounds::of_points(&positions_m)?;
    // The contracted cube is 4 radii wide.
    let n_cells =
        (4.0 * radius_m / (CELL_VOXELS * voxel_m)).clamp(N_CELLS_RANGE[0], N_CELLS_RANGE[1]);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "clamped"
    )]
    let grid = CellGrid {
        center_m,
        radius_m,
        n_cells: n_cells as u32,
    };
    let mut labels = CellLabels::none(&grid);
    for corners in &mesh.triangles {
        let is_floating = is_floater_size(part_sizes[corners[0] as usize], mesh.triangles.len());
        // The triangles are small, so every cell that a triangle crosses contains one of its
        // corners or is next to a cell that contains a corner.
        let cells = corners.map(|ix| grid.cell_at(positions_m[ix as usize]));
        if is_floating {
            &mut labels.floating
        } else {
            &mut labels.kept
        }
        .extend(cells);
    }
    let cells = labels.erased(&grid)?;
    let n_erased = mesh
        .triangles
        .iter()
        .filter(|corners| cells.contains(triangle_center_m(corners, &positions_m)))
        .count() as u64;
    // Small parts right next to large parts share the cells of the large parts.
    (n_erased > 0).then_some(Floaters {
        cells,
        n_erased,
        item: "triangle",
    })
}

/// Center of a triangle in world coordinates, meters. A triangle is erased if its center is in
/// erased space.
fn triangle_center_m(corners: &[u32; 3], positions_m: &[[f64; 3]]) -> [f64; 3] {
    let sum: Vector3<f64> = corners
        .iter()
        .map(|ix| Vector3::from(positions_m[*ix as usize]))
        .sum();
    (sum / 3.0).into()
}

/// For each vertex, the number of triangles of its connected part.
fn part_sizes(mesh: &Mesh) -> Vec<usize> {
    let mut groups = Groups::new(mesh.positions_m.len());
    for [a, b, c] in &mesh.triangles {
        groups.join(*a, *b);
        groups.join(*a, *c);
    }
    let mut n_triangles = vec![0; mesh.positions_m.len()];
    for [a, ..] in &mesh.triangles {
        n_triangles[groups.representative(*a) as usize] += 1;
    }
    (0..)
        .take(n_triangles.len())
        .map(|vertex| n_triangles[groups.representative(vertex) as usize])
        .collect()
}
