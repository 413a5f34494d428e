//! A mesh that follows a field: only blocks that changed, and those beside them, are done again.

use super::Mesh;
use super::march::{BlockMesh, Key, march};
use crate::tsdf::block::{BLOCK_EDGE, Blocks, Place};
use crate::tsdf::chosen::Lattice;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// The blocks as they were told last, and their triangles.
#[derive(Debug, Default)]
pub struct Mesher {
    blocks: Blocks,
    meshes: BTreeMap<Place, BlockMesh>,
}

impl Mesher {
    /// Takes blocks that are new or changed; says how many were done again.
    pub fn update(&mut self, lattice: &Lattice, changed: Blocks) -> usize {
        let mut due = BTreeSet::new();
        for [x, y, z] in changed.keys() {
            for ix in 0..27 {
                due.insert([x + ix % 3 - 1, y + ix / 3 % 3 - 1, z + ix / 9 - 1]);
            }
        }
        self.blocks.extend(changed);
        let due: Vec<Place> = due.into_iter().filter(|place| self.blocks.contains_key(place)).collect();
        let made: Vec<BlockMesh> = due.par_iter().map(|place| march(&self.blocks, *place, lattice.voxel_m)).collect();
        let n = due.len();
        for (place, mesh) in due.into_iter().zip(made) {
            if mesh.triangles.is_empty() {
                self.meshes.remove(&place);
            } else {
                self.meshes.insert(place, mesh);
            }
        }
        n
    }

    /// All triangles, in order of their blocks; a vertex that blocks share is there once.
    pub fn mesh(&self, lattice: &Lattice) -> Mesh {
        let mut whole = Mesh { origin_m: lattice.anchor_m, ..Mesh::default() };
        let mut known: HashMap<Key, u32> = HashMap::new();
        for (place, mesh) in &self.meshes {
            let is_shared =
                |(voxel, _): &Key| (0..3).any(|axis| matches!(voxel[axis] - BLOCK_EDGE * place[axis], 0 | BLOCK_EDGE));
            let mut places = Vec::with_capacity(mesh.keys.len());
            for (ix, key) in mesh.keys.iter().enumerate() {
                let next = u32::try_from(whole.positions_m.len()).unwrap_or(u32::MAX);
                let at = if is_shared(key) { *known.entry(*key).or_insert(next) } else { next };
                if at == next {
                    whole.positions_m.push(mesh.positions_m[ix]);
                    whole.normals.push(mesh.normals[ix]);
                    whole.colors_srgb.push(mesh.colors_srgb[ix]);
                }
                places.push(at);
            }
            whole.triangles.extend(mesh.triangles.iter().map(|corners| corners.map(|ix| places[ix as usize])));
        }
        whole
    }
}
