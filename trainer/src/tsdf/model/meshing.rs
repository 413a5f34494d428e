//! The mesh of a field: only what changed is made anew.

use super::TsdfModel;
use crate::Error;
use crate::gpu::{Gpu, PassTiming};
use crate::tsdf::block::{Blocks, Place};
use crate::tsdf::buffers::{Capacity, FieldBuffers};
use crate::tsdf::marching::{MeshBuffers, MeshRoom};
use crate::tsdf::mesh::{BlockMesh, Mesh};
use std::collections::{BTreeMap, BTreeSet};

/// Blocks that are done at once in a field of their own, where not all are on the GPU.
const DONE_APART: usize = 512;
/// Chunks of such a field at the start.
const CHUNKS_APART: u32 = 256;

impl TsdfModel {
    /// The surface in world as it is now; only what changed since the last call is made anew.
    pub fn mesh(&mut self) -> Result<Mesh, Error> {
        self.update_mesh()?;
        Ok(self.lattice.as_ref().map_or_else(Mesh::default, |lattice| self.mesher.mesh(lattice)))
    }

    /// Makes the triangles of what changed since the last call and brings them to the host, without joining them to one mesh;
    /// says how many blocks it were.
    pub fn update_mesh(&mut self) -> Result<usize, Error> {
        self.settle()?;
        if self.field.is_none() {
            return Ok(0);
        }
        let made = if self.waiting.is_empty() { self.march_in_place()? } else { self.march_apart()? };
        let n = made.len();
        self.mesher.replace(made);
        Ok(n)
    }

    /// GPU time of making the triangles of what changed since the last [`Self::update_mesh`]; they stay due, and nothing is
    /// brought to the host. Empty where the adapter tells no times, or blocks wait in host memory.
    pub fn profile_mesh(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.settle()?;
        let Some(field) = self.field.as_ref().filter(|_| self.waiting.is_empty()) else { return Ok(Vec::new()) };
        let buffers = serving(&mut self.mesh_buffers, &self.gpu, field.capacity.n_blocks)?;
        buffers.profile(&self.gpu, &self.pipelines, field)
    }

    /// All blocks are on the GPU, and so is the list of those that are due.
    fn march_in_place(&mut self) -> Result<Vec<(Place, BlockMesh)>, Error> {
        let Some(field) = &self.field else { return Ok(Vec::new()) };
        if !self.due.is_empty() {
            self.due.extend(field.take_changed(&self.gpu)?);
            field.mark_changed(&self.gpu, &self.due)?;
            self.due.clear();
        }
        let buffers = serving(&mut self.mesh_buffers, &self.gpu, field.capacity.n_blocks)?;
        let made = buffers.of_changed(&self.gpu, &self.pipelines, field)?;
        field.forget_changed(&self.gpu);
        Ok(made)
    }

    /// Some blocks wait in host memory: those that are due are put into a small field with all beside them, a few at a time.
    fn march_apart(&mut self) -> Result<Vec<(Place, BlockMesh)>, Error> {
        let (Some(lattice), Some(field)) = (&self.lattice, &self.field) else { return Ok(Vec::new()) };
        self.due.extend(field.take_changed(&self.gpu)?);
        let slots: BTreeMap<Place, u32> = field.places(&self.gpu)?.into_iter().zip(0..).collect();
        let exists = |place: &Place| slots.contains_key(place) || self.waiting.contains_key(place);
        let due: BTreeSet<Place> = self.due.iter().flat_map(around).filter(exists).collect();
        let due: Vec<Place> = due.into_iter().collect();
        let mut made = Vec::new();
        for part in due.chunks(DONE_APART) {
            let wanted: BTreeSet<Place> = part.iter().flat_map(around).filter(exists).collect();
            let (resident, resident_slots): (Vec<Place>, Vec<u32>) =
                wanted.iter().filter_map(|place| Some((*place, *slots.get(place)?))).unzip();
            let read = field.read(&self.gpu, &self.pipelines, &resident_slots)?;
            let waiting = wanted.iter().filter_map(|place| Some((*place, self.waiting.get(place)?.clone())));
            let blocks: Blocks = resident.into_iter().zip(read).chain(waiting).collect();
            let n_blocks = u32::try_from(blocks.len()).unwrap_or(u32::MAX);
            let capacity = Capacity { n_blocks, n_chunks: CHUNKS_APART };
            let apart = FieldBuffers::with_blocks(&self.gpu, &self.pipelines, lattice, &blocks, capacity)?;
            let slots_apart: BTreeMap<Place, u32> = blocks.into_keys().zip(0..).collect();
            let part: Vec<u32> = part.iter().map(|place| slots_apart[place]).collect();
            let buffers = serving(&mut self.mesh_buffers, &self.gpu, n_blocks)?;
            made.extend(buffers.of_slots(&self.gpu, &self.pipelines, &apart, &part)?);
        }
        self.due.clear();
        Ok(made)
    }
}

/// A block and those that touch it.
fn around(place: &Place) -> impl Iterator<Item = Place> + use<> {
    let [x, y, z] = *place;
    (0..27).map(move |ix| [x + ix % 3 - 1, y + ix / 3 % 3 - 1, z + ix / 9 - 1])
}

/// What is kept, made anew where it is too small for a pool of so many blocks.
fn serving<'a>(kept: &'a mut Option<MeshBuffers>, gpu: &Gpu, n_blocks: u32) -> Result<&'a mut MeshBuffers, Error> {
    let buffers = match kept.take().filter(|buffers| buffers.serves(n_blocks)) {
        Some(buffers) => buffers,
        None => MeshBuffers::new(gpu, MeshRoom::default(), n_blocks)?,
    };
    Ok(kept.insert(buffers))
}
