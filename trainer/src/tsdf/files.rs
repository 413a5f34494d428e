//! Names of the files of a saved field.

/// The file of the blocks, which is a checkpoint with deflated arrays.
pub(super) const BLOCKS_FILE: &str = "field.blocks";
/// The mesh, z up.
pub(super) const MESH_PLY: &str = "mesh.ply";
/// The mesh, y up.
pub(super) const MESH_GLB: &str = "mesh.glb";
