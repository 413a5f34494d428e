//! Saved fields in folders, with the mesh for other programs and the blocks for resuming.

use super::TsdfModel;
use super::checkpoint::{METHOD, invalid_state};
use crate::model_metadata::METADATA_FILE;
use crate::model_options::CommonOptions;
use crate::tsdf::files::{BLOCKS_FILE, MESH_GLB, MESH_PLY};
use crate::{Error, Method};
use flate2::Compression;
use flate2::read::DeflateDecoder;
use flate2::write::DeflateEncoder;
use gpu::Gpu;
use model_files::Edits;
use model_files::checkpoint::{Array, Checkpoint};
use model_files::mesh::{Mesh, write_glb, write_ply};
use std::io::{Read, Write};
use std::path::Path;
use std::sync::Arc;

/// Maximum size of an inflated array in bytes, so that a small damaged file cannot fill the memory
/// of the host with zeros without end. Fields are far smaller.
const MAX_ARRAY_BYTES: u64 = 1 << 36;

impl TsdfModel {
    /// Loads a saved field, for rendering or further fusion.
    pub fn load(gpu: Arc<Gpu>, folder: &Path) -> Result<Self, Error> {
        let path = folder.join(BLOCKS_FILE);
        let mut checkpoint = Checkpoint::read(&path)?;
        for array in &mut checkpoint.arrays {
            let mut whole = Vec::new();
            let inflated = DeflateDecoder::new(array.bytes.as_slice())
                .take(MAX_ARRAY_BYTES)
                .read_to_end(&mut whole);
            inflated.map_err(|error| invalid_state(format!("array {:?}: {error}", array.name)))?;
            array.bytes = whole;
        }
        Self::of_state(gpu, &checkpoint)
    }

    /// Writes the mesh without erased space, for other programs.
    pub(super) fn write_meshes(&mut self, folder: &Path, edits: &Edits) -> Result<Mesh, Error> {
        let mesh = self.mesh_without(edits)?;
        write_ply(&folder.join(MESH_PLY), &mesh)?;
        write_glb(&folder.join(MESH_GLB), &mesh)?;
        Ok(mesh)
    }

    pub(super) fn write_folder(&mut self, folder: &Path) -> Result<(), Error> {
        self.finish_in_flight()?;
        self.fuse_one()?;
        std::fs::create_dir_all(folder).map_err(|source| write_error(folder, source))?;
        let mesh = self.write_meshes(folder, &Edits::default())?;
        let blocks = folder.join(BLOCKS_FILE);
        let (mut state, arrays) = self.state()?;
        // Other common options do not affect a field. They are reset, so that equal fields give
        // equal files.
        let common = CommonOptions {
            max_bytes: self.options.common.max_bytes,
            ..CommonOptions::default()
        };
        state["options"]["common"] =
            serde_json::to_value(common).map_err(|error| invalid_state(error.to_string()))?;
        let arrays = arrays
            .into_iter()
            .map(deflated)
            .collect::<std::io::Result<Vec<Array>>>();
        let arrays = arrays.map_err(|source| write_error(&blocks, source))?;
        Checkpoint::new(METHOD, state, arrays).write(&blocks)?;
        let description = serde_json::json!({
            "method": METHOD,
            "steps": self.queue.step(),
            "blocks": self.progress().primitives,
            "skipped_keyframes": self.queue.n_skipped,
            "vertices": mesh.positions_m.len(),
            "triangles": mesh.triangles.len(),
            "voxel_grid": self.voxel_grid(),
        });
        let path = folder.join(METADATA_FILE);
        files::write(&path, format!("{description:#}\n"))
            .map_err(|source| write_error(&path, source))
    }
}

fn write_error(path: &Path, source: std::io::Error) -> Error {
    Error::Write {
        path: path.to_owned(),
        source,
    }
}

/// Compresses an array. Unobserved voxels are zeros, which even the fastest level compresses well.
fn deflated(array: Array) -> std::io::Result<Array> {
    let mut encoder = DeflateEncoder::new(Vec::new(), Compression::fast());
    encoder.write_all(&array.bytes)?;
    Ok(Array {
        bytes: encoder.finish()?,
        ..array
    })
}
