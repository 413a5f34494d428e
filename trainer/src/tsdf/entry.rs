//! Registers distance fields as a method.

use super::files::{BLOCKS_FILE, MESH_GLB, MESH_PLY};
use super::{TsdfModel, TsdfOptions};
use crate::Error;
use crate::method_entry::{Export, ExportRequest, ExportWriter, Exported, MethodEntry, boxed};
use crate::model_options::{MethodOptions, default_options};
use calibration::ParamSet;
use gpu::Gpu;
use model_files::Edits;
use model_files::mesh::{Mesh, write_glb, write_ply};
use std::path::Path;
use std::sync::Arc;

/// Registry entry of distance fields.
pub(crate) static ENTRY: MethodEntry = MethodEntry {
    name: TsdfOptions::METHOD,
    description: "signed distance field with a mesh",
    model: "a distance field",
    primitive: "block",
    primitives_label: "Voxel blocks",
    files: &[MESH_PLY, MESH_GLB, BLOCKS_FILE],
    single_file: None,
    needs_depth: true,
    can_revise: false,
    has_chunks: true,
    learnable: ParamSet::empty(),
    exports: &[
        Export {
            format: "glb",
            contents: "mesh",
            has_cells: true,
            write: ExportWriter::Gpu(|gpu, request| export(gpu, request, write_glb)),
        },
        Export {
            format: "ply",
            contents: "mesh",
            has_cells: true,
            write: ExportWriter::Gpu(|gpu, request| export(gpu, request, write_ply)),
        },
    ],
    default_options: default_options::<TsdfOptions>,
    check_options: |options| options.typed::<TsdfOptions>().map(drop),
    start: |gpu, options| Ok(Box::new(TsdfModel::new(gpu, options.typed()?)?)),
    resume: |gpu, checkpoint, keyframes| TsdfModel::resume(gpu, checkpoint, keyframes).map(boxed),
    load: |gpu, folder| Ok(Box::new(TsdfModel::load(gpu, folder)?)),
};

/// Extracts the mesh from the voxels and writes it.
fn export(
    gpu: Arc<Gpu>,
    request: &ExportRequest<'_>,
    write: fn(&Path, &Mesh) -> Result<(), model_files::Error>,
) -> Result<Exported, Error> {
    let mesh = TsdfModel::load(gpu, request.model)?.mesh_without(&Edits::read(request.model)?)?;
    // Simplification may merge all vertices into one vertex. An empty file would look like a
    // success.
    let simplified = request
        .cell_m
        .map(|cell_m| (cell_m, mesh.clustered(cell_m)));
    if let Some((cell_m, simplified)) = &simplified
        && simplified.triangles.is_empty()
    {
        return Err(Error::EmptyMesh { cell_m: *cell_m });
    }
    let written = simplified
        .as_ref()
        .map_or(&mesh, |(_, simplified)| simplified);
    write(request.out, written)?;
    let detail = if simplified.is_some() {
        format!("instead of {}", mesh.triangles.len())
    } else {
        String::new()
    };
    Ok(Exported {
        n_items: written.triangles.len() as u64,
        item: "triangle",
        detail,
    })
}
