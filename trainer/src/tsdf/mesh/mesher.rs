//! An incrementally updated mesh. Triangles are stored per block and joined on request.

use crate::tsdf::block::{BLOCK_EDGE, GridCoord};
use crate::tsdf::chosen_grid::VoxelGrid;
use crate::tsdf::params::MeshVertex;
use model_files::Edits;
use model_files::mesh::Mesh;
use nalgebra::Vector3;
use numbers::f32_of;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

/// The triangles of the cubes whose lowest corner is in one block.
#[derive(Debug)]
pub(in crate::tsdf) struct BlockMesh {
    pub(in crate::tsdf) vertices: Vec<MeshVertex>,
    pub(in crate::tsdf) triangles: Vec<[u32; 3]>,
}

impl BlockMesh {
    /// Whether each triangle's center is in erased space.
    fn erased<'a>(
        &'a self,
        voxel_grid: &'a VoxelGrid,
        edits: &'a Edits,
    ) -> impl Iterator<Item = bool> + 'a {
        self.triangles.iter().map(|corners| {
            let along = |axis: usize| {
                corners.map(|ix| f64::from(self.vertices[ix as usize].position_m[axis]))
            };
            let center = [0, 1, 2]
                .map(|axis| voxel_grid.anchor_m[axis] + along(axis).iter().sum::<f64>() / 3.0);
            edits.erases(center)
        })
    }

    /// The triangles that are not erased, with their vertices.
    fn without_erased(&self, voxel_grid: &VoxelGrid, edits: &Edits) -> Self {
        let mut kept = Self {
            vertices: Vec::new(),
            triangles: Vec::new(),
        };
        let mut kept_ixs: Vec<Option<u32>> = vec![None; self.vertices.len()];
        let triangles = self.triangles.iter().zip(self.erased(voxel_grid, edits));
        for (corners, _) in triangles.filter(|(_, is_erased)| !is_erased) {
            // Vertices are numbered in the order in which kept triangles use them.
            kept.triangles.push(corners.map(|ix| {
                *kept_ixs[ix as usize].get_or_insert_with(|| {
                    kept.vertices.push(self.vertices[ix as usize]);
                    u32::try_from(kept.vertices.len() - 1).expect("not more than before")
                })
            }));
        }
        kept
    }
}

/// The part of a block's mesh that is not erased.
pub(super) fn without_erased(
    mesh: &Arc<BlockMesh>,
    voxel_grid: &VoxelGrid,
    edits: &Edits,
) -> Arc<BlockMesh> {
    // Most blocks contain no erased space, and are shared instead of copied.
    if !edits.is_empty() && mesh.erased(voxel_grid, edits).any(|is_erased| is_erased) {
        Arc::new(mesh.without_erased(voxel_grid, edits))
    } else {
        Arc::clone(mesh)
    }
}

/// The triangles of each block that has some.
pub(in crate::tsdf) type BlockMeshes = BTreeMap<GridCoord, Arc<BlockMesh>>;

/// The most recent triangles of each block.
#[derive(Debug, Default)]
pub(in crate::tsdf) struct Mesher {
    meshes: BlockMeshes,
    /// Edits with which viewers last received the mesh.
    edits: Arc<Edits>,
    /// Blocks replaced since the last [`Self::take_changed`]. `None` before the first call.
    changed: Option<BTreeSet<GridCoord>>,
}

impl Mesher {
    /// Replaces the triangles of these blocks.
    pub(in crate::tsdf) fn replace(
        &mut self,
        made: impl IntoIterator<Item = (GridCoord, BlockMesh)>,
    ) {
        for (block_coord, mesh) in made {
            if let Some(changed) = &mut self.changed {
                changed.insert(block_coord);
            }
            if mesh.triangles.is_empty() {
                self.meshes.remove(&block_coord);
            } else {
                self.meshes.insert(block_coord, Arc::new(mesh));
            }
        }
    }

    /// The triangles of all blocks that have some.
    pub(in crate::tsdf) fn blocks(&self) -> &BlockMeshes {
        &self.meshes
    }

    /// The blocks replaced since the last call. `None` in the first call, for all blocks.
    pub(in crate::tsdf) fn take_changed(&mut self) -> Option<BTreeSet<GridCoord>> {
        self.changed.replace(BTreeSet::new())
    }

    /// Marks blocks as replaced if the set of their erased triangles has changed.
    pub(in crate::tsdf) fn set_edits(&mut self, voxel_grid: &VoxelGrid, edits: &Arc<Edits>) {
        let before = std::mem::replace(&mut self.edits, Arc::clone(edits));
        let Some(changed) = self.changed.as_mut().filter(|_| before != *edits) else {
            return;
        };
        // Edits may overlap and may be undone. A block is sent again only if the set of its erased
        // triangles has changed.
        let has_changed = |mesh: &BlockMesh| {
            mesh.erased(voxel_grid, &before)
                .ne(mesh.erased(voxel_grid, edits))
        };
        let blocks = self
            .meshes
            .par_iter()
            .filter(|(_, mesh)| has_changed(mesh))
            .map(|(block_coord, _)| *block_coord);
        changed.par_extend(blocks);
    }
}

/// All triangles outside erased space, in world coordinates and in the order of their blocks.
/// Vertices that blocks share are merged.
pub(in crate::tsdf) fn joined(meshes: &BlockMeshes, voxel_grid: &VoxelGrid, edits: &Edits) -> Mesh {
    let mut whole = Mesh {
        origin_m: voxel_grid.anchor_m,
        ..Mesh::default()
    };
    let mut shared_vertices: HashMap<(GridCoord, u32), u32> = HashMap::new();
    for (block_coord, mesh) in meshes {
        let mesh = without_erased(mesh, voxel_grid, edits);
        let mut vertex_ixs = Vec::with_capacity(mesh.vertices.len());
        for vertex in &mesh.vertices {
            let next = u32::try_from(whole.positions_m.len()).unwrap_or(u32::MAX);
            let at = shared_key(*block_coord, vertex.edge)
                .map_or(next, |key| *shared_vertices.entry(key).or_insert(next));
            if at == next {
                whole.positions_m.push(vertex.position_m);
                whole.normals.push(unit_of(vertex.normal));
                let [red, green, blue, _] = vertex.color.to_le_bytes();
                whole.colors_srgb.push([red, green, blue]);
            }
            vertex_ixs.push(at);
        }
        whole.triangles.extend(
            mesh.triangles
                .iter()
                .map(|corners| corners.map(|ix| vertex_ixs[ix as usize])),
        );
    }
    whole
}

/// Key of an edge that may belong to several blocks. It consists of the first voxel of the edge in
/// the field, and of its axis.
pub(super) fn shared_key(block: GridCoord, edge: u32) -> Option<(GridCoord, u32)> {
    // The number of an edge is axis + 3 (x + 9 (y + 9 z)), where x, y and z are the coordinates of
    // its first voxel, 0 to 8. Only edges on a face of the block can also belong to a neighbor.
    let local = [edge / 3 % 9, edge / 27 % 9, edge / 243].map(u32::cast_signed);
    let is_shared = local.iter().any(|along| matches!(*along, 0 | BLOCK_EDGE));
    is_shared.then(|| {
        (
            std::array::from_fn(|axis| BLOCK_EDGE * block[axis] + local[axis]),
            edge % 3,
        )
    })
}

/// Decodes a unit vector from its two octahedral coordinates.
///
/// Source: Cigolle et al. 2014, "A survey of efficient representations for independent unit
/// vectors", section 3.
pub(in crate::tsdf) fn unit_of(octahedral: u32) -> [f32; 3] {
    let bytes = octahedral.to_le_bytes();
    let [low, high] = [[bytes[0], bytes[1]], [bytes[2], bytes[3]]]
        .map(|half| f64::from(i16::from_le_bytes(half)) / 32767.0);
    // The lower half of the octahedron is folded over the outer triangles of the square.
    let up = 1.0 - low.abs() - high.abs();
    let [x, y] = if up < 0.0 {
        [
            (1.0 - high.abs()) * low.signum(),
            (1.0 - low.abs()) * high.signum(),
        ]
    } else {
        [low, high]
    };
    Vector3::new(x, y, up).normalize().map(f32_of).into()
}
