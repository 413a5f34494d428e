//! The surface of a field as triangles.

mod cases;
mod cluster;
mod glb;
mod mesher;
mod ply;

pub(super) use cases::CASES;
pub use glb::write as write_glb;
#[cfg(test)]
pub(super) use mesher::unit_of;
pub(super) use mesher::{BlockMesh, Mesher};
pub use ply::write as write_ply;

#[cfg(test)]
mod tests;

/// Triangles with shared vertices, in order of the blocks they come from.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// What positions are counted from, in world, metres: f32 is fine near it.
    pub origin_m: [f64; 3],
    /// From `origin_m`, along the world's axes, metres.
    pub positions_m: Vec<[f32; 3]>,
    /// Out of the surface, of length 1; along the world's axes.
    pub normals: Vec<[f32; 3]>,
    /// Red, green, blue.
    pub colors_srgb: Vec<[u8; 3]>,
    /// Counterclockwise as seen from outside.
    pub triangles: Vec<[u32; 3]>,
}
