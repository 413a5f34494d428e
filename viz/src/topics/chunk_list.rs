//! The current chunks of a model, with versions and the extent of their changes.

use kinematics::Transform;
use std::collections::BTreeMap;
use std::sync::Arc;
use trainer::{ModelChunk, ModelChunks};

/// The newest version of each chunk of a model. Clones share the chunks.
#[derive(Clone, Debug, Default)]
pub(crate) struct ChunkList {
    version: u64,
    /// Pose of the model in the world of the clients.
    pub(crate) world_from_model: Transform,
    /// Chunks by id.
    pub(crate) chunks: BTreeMap<u64, Arc<VersionedChunk>>,
}

/// A version of a chunk.
#[derive(Debug)]
pub(crate) struct VersionedChunk {
    /// Version of the list that changed the chunk last.
    pub(crate) version: u64,
    /// Sum of all changes of the chunk so far. What a client has missed is the increase since its
    /// last version.
    pub(crate) total_change: f64,
    /// The chunk.
    pub(crate) chunk: ModelChunk,
}

impl ChunkList {
    /// Applies new chunks. Returns false if they only contain changes, but the list is empty, so
    /// that the chunks that have not changed are missing.
    pub(crate) fn apply(&mut self, new: ModelChunks) -> bool {
        // No client drew the model for a moment, so the list was dropped while the changes were
        // computed.
        if !new.is_complete && self.version == 0 {
            return false;
        }
        self.version += 1;
        // A complete list does not name the chunks that were removed.
        let before = if new.is_complete {
            std::mem::take(&mut self.chunks)
        } else {
            BTreeMap::new()
        };
        for id in new.removed {
            self.chunks.remove(&id);
        }
        for chunk in new.chunks {
            // The sum continues across complete lists, because it determines how much a client has
            // missed. NaN counts as no change, because `max` returns the other number.
            let last = before.get(&chunk.id).or_else(|| self.chunks.get(&chunk.id));
            let total_change = last.map_or(0.0, |last| last.total_change) + chunk.change.max(0.0);
            let versioned = VersionedChunk {
                version: self.version,
                total_change,
                chunk,
            };
            self.chunks.insert(versioned.chunk.id, Arc::new(versioned));
        }
        true
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::ChunkList;
    use trainer::{ChunkData, ChunkLayout, ModelChunk, ModelChunks};

    /// A chunk of this many bytes, with a coarse form of a tenth.
    pub(crate) fn chunk(id: u64, change: f64, n_bytes: usize) -> ModelChunk {
        let layout = ChunkLayout::Mesh {
            origin_m: [0.0; 3],
            meters_per_count: 0.001,
            n_vertices: 0,
            n_triangles: 0,
        };
        let data = |n_bytes: usize| ChunkData {
            layout,
            bytes: vec![7; n_bytes],
        };
        ModelChunk {
            id,
            change,
            coarse: Some(data(n_bytes / 10)),
            fine: data(n_bytes),
        }
    }

    pub(crate) fn complete(chunks: Vec<ModelChunk>) -> ModelChunks {
        ModelChunks {
            is_complete: true,
            chunks,
            removed: Vec::new(),
        }
    }

    #[test]
    fn changes_accumulate_until_a_complete_list_drops_chunks() {
        let mut list = ChunkList::default();
        let changes = |chunks| ModelChunks {
            is_complete: false,
            chunks,
            removed: vec![1],
        };
        assert!(
            !list.apply(changes(vec![chunk(2, 1.0, 10)])),
            "chunk 1 would be missing"
        );
        assert!(list.apply(complete(vec![chunk(1, 1.0, 10), chunk(2, 1.0, 10)])));
        assert!(list.apply(changes(vec![chunk(2, 0.5, 10), chunk(3, f64::NAN, 10)])));
        let known = |list: &ChunkList| {
            list.chunks
                .iter()
                .map(|(id, chunk)| (*id, chunk.version, chunk.total_change))
                .collect::<Vec<_>>()
        };
        assert_eq!(known(&list), [(2, 2, 1.5), (3, 2, 0.0)]);
        assert!(list.apply(complete(vec![chunk(3, 2.0, 10)])));
        assert_eq!(known(&list), [(3, 3, 2.0)]);
    }
}
