// field: a signed distance field in blocks of 8x8x8 voxels, and the packing of a voxel's words.
//
// Field coordinates are meters from the anchor, along the world's axes. Voxel i covers [i, i + 1) voxel_m; its center
// is at i + 0.5. A chunk is 8x8x8 blocks. `keys` is a hash table of chunks with open addressing. The chunk at position
// h of that table owns row h of `entries`: one entry per block, the block's slot plus one, or 0 if the block is
// missing.
//
// source    Niessner et al. 2013 (voxel hashing); Oleynikova et al. 2017 (Voxblox); chunks of blocks are ours: a ray
//           crosses an empty chunk in one step, and a key fits into one word

struct Field {
    voxel_m: f32,
    truncation_m: f32,        // minimum truncation
    scale_m: f32,             // maximum truncation; also the distance that the largest stored number represents
    noise_per_m2: f32,        // standard deviation of depth at 1 m; grows with the square of depth
    max_depth_m: f32,
    max_weight: u32,          // in 256ths
    n_chunk_slots: u32,       // a power of two
    n_block_slots: u32,
}

const BLOCK_VOXELS = 512u;
const NO_BLOCK = 0u;
const BLOCK_REQUESTED = 0xffffffffu; // Requested while the pool was full.
const WEIGHT_ONE = 256.0;
const MAX_PROBES = 128u;
const CHUNK_LIMIT = vec3i(1023, 1023, 511);

// Truncation distance along the surface normal for a reading at this depth, meters.
fn truncation_at(field: Field, depth_m: f32) -> f32 {
    return clamp(3.0 * field.noise_per_m2 * depth_m * depth_m, field.truncation_m, field.scale_m);
}

fn stored_distance(word: u32) -> f32 {
    return f32(bitcast<i32>(word << 16u) >> 16u) / 32767.0;
}

fn stored_weight(word: u32) -> u32 {
    return word >> 16u;
}

fn voxel_in_block(voxel: vec3i) -> u32 {
    let local = vec3u(voxel & vec3i(7));
    return local.z * 64u + local.y * 8u + local.x;
}

// Whether the chunk is close enough to the anchor to have a key.
fn chunk_in_range(chunk: vec3i) -> bool {
    return all(chunk >= -CHUNK_LIMIT) && all(chunk < CHUNK_LIMIT);
}

// Key of a chunk. Never 0, which marks an empty position.
fn key_of(chunk: vec3i) -> u32 {
    let at = vec3u(chunk + CHUNK_LIMIT + 1);
    return ~((at.x << 21u) | (at.y << 10u) | at.z);
}

fn hash_of(key: u32) -> u32 {
    let mixed = key * 0x9e3779b1u;
    return mixed ^ (mixed >> 15u);
}
