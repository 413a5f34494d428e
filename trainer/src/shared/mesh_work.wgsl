// mesh_work: the blocks to mesh, and the locations of their triangles.

// The part of the block list that one dispatch meshes.
struct MeshBatch {
    first: u32,
    max_blocks: u32,
}

// A meshed block.
struct BlockMeshRange {
    block_coord: array<i32, 3>,     // in blocks
    first_vertex: u32,
    n_vertices: u32,
    first_triangle: u32,
    n_triangles: u32,
}

struct MeshVertex {
    position_m: array<f32, 3>, // from the field's anchor
    edge: u32,                // 3 (81 z + 9 y + x) + axis, where the edge begins at voxel x, y, z (0 to 8) of the block
    normal: u32,              // octahedral, two 16-bit numbers
    color: u32,               // rgb8
}

// Indices into the counters of vertices and triangles.
const N_VERTICES = 0u;        // of the batch, including vertices that did not fit
const N_TRIANGLES = 1u;
