//! An incrementally updated mesh: triangles per block, joined on request.

use super::Mesh;
use crate::gpu::f32_of;
use crate::tsdf::block::{BLOCK_EDGE, GridCoord};
use crate::tsdf::chosen_grid::VoxelGrid;
use crate::tsdf::params::MeshVertex;
use nalgebra::Vector3;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

/// The triangles of the cubes whose lowest corner is in one block.
#[derive(Debug)]
pub(in crate::tsdf) struct BlockMesh {
    pub(in crate::tsdf) vertices: Vec<MeshVertex>,
    pub(in crate::tsdf) triangles: Vec<[u32; 3]>,
}

/// The most recent triangles of each block.
#[derive(Debug, Default)]
pub(in crate::tsdf) struct Mesher {
    meshes: BTreeMap<GridCoord, Arc<BlockMesh>>,
    /// Blocks replaced since the last [`Self::take_changed`]; `None` before the first.
    changed: Option<BTreeSet<GridCoord>>,
}

impl Mesher {
    /// Replaces the triangles of these blocks.
    pub(in crate::tsdf) fn replace(&mut self, made: impl IntoIterator<Item = (GridCoord, BlockMesh)>) {
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
    pub(in crate::tsdf) fn blocks(&self) -> &BTreeMap<GridCoord, Arc<BlockMesh>> {
        &self.meshes
    }

    /// The blocks replaced since the last call; `None` in the first call, for all blocks.
    pub(in crate::tsdf) fn take_changed(&mut self) -> Option<BTreeSet<GridCoord>> {
        self.changed.replace(BTreeSet::new())
    }

    /// All triangles, in the order of their blocks; vertices shared by blocks are merged.
    pub(in crate::tsdf) fn mesh(&self, voxel_grid: &VoxelGrid) -> Mesh {
        let mut whole = Mesh { origin_m: voxel_grid.anchor_m, ..Mesh::default() };
        let mut shared_vertices: HashMap<(GridCoord, u32), u32> = HashMap::new();
        for (block_coord, mesh) in &self.meshes {
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
            whole.triangles.extend(mesh.triangles.iter().map(|corners| corners.map(|ix| vertex_ixs[ix as usize])));
        }
        whole
    }
}

/// Key of an edge that may belong to several blocks: its first voxel in the field, and its axis.
pub(super) fn shared_key(block: GridCoord, edge: u32) -> Option<(GridCoord, u32)> {
    let local = [edge / 3 % 9, edge / 27 % 9, edge / 243].map(u32::cast_signed);
    let is_shared = local.iter().any(|along| matches!(*along, 0 | BLOCK_EDGE));
    is_shared.then(|| (std::array::from_fn(|axis| BLOCK_EDGE * block[axis] + local[axis]), edge % 3))
}

/// Decodes a unit vector from its two octahedral coordinates.
///
/// Source: Cigolle et al. 2014, "A survey of efficient representations for independent unit vectors", section 3.
pub(in crate::tsdf) fn unit_of(octahedral: u32) -> [f32; 3] {
    let bytes = octahedral.to_le_bytes();
    let [low, high] =
        [[bytes[0], bytes[1]], [bytes[2], bytes[3]]].map(|half| f64::from(i16::from_le_bytes(half)) / 32767.0);
    let up = 1.0 - low.abs() - high.abs();
    let [x, y] =
        if up < 0.0 { [(1.0 - high.abs()) * low.signum(), (1.0 - low.abs()) * high.signum()] } else { [low, high] };
    Vector3::new(x, y, up).normalize().map(f32_of).into()
}
