//! Triangle meshes and their files.

mod cluster;
mod glb;
mod ply;

pub use glb::write as write_glb;
pub use ply::write as write_ply;

#[cfg(test)]
mod tests;

/// Triangles with shared vertices, in the order of their blocks.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Origin of the positions, in world coordinates, meters. f32 is precise near this point.
    pub origin_m: [f64; 3],
    /// Positions relative to `origin_m`, along the world's axes, meters.
    pub positions_m: Vec<[f32; 3]>,
    /// Outward normals of length 1, along the world's axes.
    pub normals: Vec<[f32; 3]>,
    /// Red, green, blue.
    pub colors_srgb: Vec<[u8; 3]>,
    /// Vertex indices, counterclockwise when viewed from outside.
    pub triangles: Vec<[u32; 3]>,
}
