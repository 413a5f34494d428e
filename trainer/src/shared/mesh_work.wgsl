// mesh_work: which blocks get new triangles, and where these go.

// Which of the listed blocks a dispatch does.
struct MeshBatch {
    first: u32,
    max_blocks: u32,
}

// A block that was done.
struct BlockMeshRange {
    block_coord: array<i32, 3>,     // in blocks
    first_vertex: u32,
    n_vertices: u32,
    first_triangle: u32,
    n_triangles: u32,
}

struct MeshVertex {
    position_m: array<f32, 3>, // from the field's anchor
    edge: u32,                // of the block's cubes: 3 (81 z + 9 y + x) + axis, from the voxel it begins at, 0 to 8
    normal: u32,              // octahedral, two 16-bit numbers
    color: u32,               // rgb8
}

// Indices into `room`.
const N_VERTICES = 0u;        // of the piece, those included that found no room
const N_TRIANGLES = 1u;
