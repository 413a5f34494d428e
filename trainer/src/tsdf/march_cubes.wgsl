// march_cubes: extracts the triangles of the cubes whose lowest corner is in a block, for each block of a batch. Cubes
// with an unobserved corner have no triangles.
//
// groups    one per block; 256 threads, two cubes each
// reads     field, batch, coords, keys, entries, geometry, colors, stale [1 + n_stale] (count, then slots), cases [256
//           * 6] (number of triangles; then, per triangle, three edges of five bits each: corner, axis)
// writes    needed (required capacity), parts [max_blocks], vertices, triangles [3 each] (counterclockwise when viewed
//           from outside; indices into `vertices`). The position of a block's triangles depends on thread timing, but
//           their order does not. A block that does not fit writes no triangles.
// twin      tsdf/reference/march.rs
// source    Lorensen and Cline 1987; ours: a block's range is allocated by one atomic addition after a scan within the
//           block

#import field
#import field_lookup
#import folded
#import mesh_work
#import scan

@group(0) @binding(0) var<uniform> field: Field;
@group(0) @binding(1) var<uniform> batch: MeshBatch;
@group(0) @binding(2) var<storage, read> coords: array<vec4i>;
@group(0) @binding(3) var<storage, read> keys: array<u32>;
@group(0) @binding(4) var<storage, read> entries: array<u32>;
@group(0) @binding(5) var<storage, read> geometry: array<u32>;
@group(0) @binding(6) var<storage, read> colors: array<vec2u>;
@group(0) @binding(7) var<storage, read> cases: array<u32>;
@group(0) @binding(8) var<storage, read> stale: array<u32>;
@group(0) @binding(9) var<storage, read_write> needed: array<atomic<u32>>;
@group(0) @binding(10) var<storage, read_write> parts: array<BlockMeshRange>;
@group(0) @binding(11) var<storage, read_write> vertices: array<MeshVertex>;
@group(0) @binding(12) var<storage, read_write> triangles: array<u32>;

// Voxels that the vertices and normals of a block read: one before the block and two after it, along each axis.
const TILE_VOXELS = 1331u;
const TILE_STEPS = vec3u(1u, 11u, 121u);
// Edges of the block's cubes, nine voxels along each axis, and the words that hold one bit per edge.
const CUBE_EDGES = 2187u;
const EDGE_STEPS = vec3u(3u, 27u, 243u);
const USED_WORDS = 69u;
const CASE_WORDS = 6u;
const GRAY = vec3f(0.5);

var<workgroup> wg_slots: array<u32, 27>;           // slots plus one of the block and its neighbors
var<workgroup> wg_words: array<u32, TILE_VOXELS>;
var<workgroup> wg_used: array<atomic<u32>, USED_WORDS>;
var<workgroup> wg_before: array<u32, USED_WORDS>;  // Number of vertices in preceding words.
var<workgroup> wg_edges: array<u32, CUBE_EDGES>;   // edges that have a vertex, in order
var<workgroup> wg_begin: vec2u;                    // Where the block's vertices and triangles are written.

fn corner_of(corner: u32) -> vec3u {
    return vec3u(corner & 1u, (corner >> 1u) & 1u, corner >> 2u);
}

// Index in the tile of a voxel of the block or its surroundings; coordinates start at -1.
fn tile_ix(voxel: vec3u) -> u32 {
    return dot(voxel + 1u, TILE_STEPS);
}

// Case of a cube. Bit c is set if corner c is inside. The case is 0 if any corner was not observed.
fn case_of(cube: vec3u) -> u32 {
    let first = tile_ix(cube);
    var inside = 0u;
    var is_observed = true;
    for (var corner = 0u; corner < 8u; corner++) {
        let word = wg_words[first + dot(corner_of(corner), TILE_STEPS)];
        is_observed = is_observed && stored_weight(word) != 0u;
        inside |= ((word >> 15u) & 1u) << corner; // Sign of the distance.
    }
    return select(0u, inside, is_observed);
}

// Index of the edge at a triangle's corner, among the edges of all cubes of the block.
fn edge_of(cube: vec3u, codes: u32, corner: u32) -> u32 {
    let code = (codes >> (5u * corner)) & 31u;
    return dot(cube + corner_of(code & 7u), EDGE_STEPS) + (code >> 3u);
}

fn cube_of(ix: u32) -> vec3u {
    return vec3u(ix & 7u, (ix >> 3u) & 7u, ix >> 6u);
}

// Marks the edges that have a vertex. Returns the number of triangles.
fn mark_edges(cube_ix: u32) -> u32 {
    let cube = cube_of(cube_ix);
    let row = CASE_WORDS * case_of(cube);
    let n = cases[row];
    for (var ix = 0u; ix < n; ix++) {
        for (var corner = 0u; corner < 3u; corner++) {
            let edge = edge_of(cube, cases[row + 1u + ix], corner);
            atomicOr(&wg_used[edge / 32u], 1u << (edge % 32u));
        }
    }
    return n;
}

// Writes a cube's triangles and returns the position of the next cube's triangles.
fn write_triangles(cube_ix: u32, begin: u32) -> u32 {
    let cube = cube_of(cube_ix);
    let row = CASE_WORDS * case_of(cube);
    let n = cases[row];
    for (var ix = 0u; ix < n; ix++) {
        for (var corner = 0u; corner < 3u; corner++) {
            let edge = edge_of(cube, cases[row + 1u + ix], corner);
            let below = atomicLoad(&wg_used[edge / 32u]) & ((1u << (edge % 32u)) - 1u);
            triangles[3u * (begin + ix) + corner] = wg_begin.x + wg_before[edge / 32u] + countOneBits(below);
        }
    }
    return begin + n;
}

// Derivative of the distance along an axis, two-sided if both neighbors were observed.
fn gradient_along(at: u32, step: u32) -> f32 {
    let low = wg_words[at - step];
    let here = wg_words[at];
    let high = wg_words[at + step];
    let has_low = stored_weight(low) != 0u;
    let has_high = stored_weight(high) != 0u;
    let difference = stored_distance(select(here, high, has_high)) - stored_distance(select(here, low, has_low));
    return select(difference, 0.5 * difference, has_low && has_high);
}

fn gradient_at(at: u32) -> vec3f {
    return vec3f(gradient_along(at, TILE_STEPS.x), gradient_along(at, TILE_STEPS.y), gradient_along(at, TILE_STEPS.z));
}

// Index of a voxel in the pool plus one, with coordinates relative to the preceding block; 0 if its block does not
// exist.
fn pool_ix_of(voxel: vec3u) -> u32 {
    let slot = wg_slots[dot(voxel >> vec3u(3u), vec3u(1u, 3u, 9u))];
    return select(0u, (slot - 1u) * BLOCK_VOXELS + voxel_in_block(vec3i(voxel)) + 1u, slot != 0u);
}

// Red, green, blue and 1; all 0 if the voxel has no color.
fn color_at(voxel: vec3u) -> vec4f {
    let pool_ix = pool_ix_of(voxel + 8u);
    if pool_ix == 0u { return vec4f(0.0); }
    let both = colors[pool_ix - 1u];
    let rgb = vec3f(vec3u(both.x & 0xffffu, both.x >> 16u, both.y & 0xffffu)) / 65535.0;
    return select(vec4f(0.0), vec4f(rgb, 1.0), (both.y >> 16u) != 0u);
}

// Source: Cigolle et al. 2014, "A survey of efficient representations for independent unit vectors", section 3.
fn octahedral(normal: vec3f) -> u32 {
    let flat = normal.xy / (abs(normal.x) + abs(normal.y) + abs(normal.z));
    let folded_xy = (1.0 - abs(flat.yx)) * select(vec2f(-1.0), vec2f(1.0), flat >= vec2f(0.0));
    return pack2x16snorm(select(flat, folded_xy, normal.z < 0.0));
}

fn vertex_of(block: vec3i, edge: u32) -> MeshVertex {
    let axis = edge % 3u;
    let voxel = vec3u(edge / 3u % 9u, edge / 27u % 9u, edge / 243u);
    let along = vec3u(vec3u(axis) == vec3u(0u, 1u, 2u));
    let from_ix = tile_ix(voxel);
    let to_ix = from_ix + dot(along, TILE_STEPS);
    let here = stored_distance(wg_words[from_ix]);
    let there = stored_distance(wg_words[to_ix]);
    let share = here / (here - there);
    let position_m = (vec3f(8 * block + vec3i(voxel)) + 0.5 + share * vec3f(along)) * field.voxel_m;
    let gradient = mix(gradient_at(from_ix), gradient_at(to_ix), share);
    let gradient_norm = length(gradient);
    let normal = select(vec3f(along) * sign(there - here), gradient / gradient_norm, gradient_norm > 1e-12);
    let near = color_at(voxel);
    let far = color_at(voxel + along);
    // If only one of the voxels has a color, use that color.
    let only = select(vec4f(GRAY, 1.0), near + far, near.a + far.a > 0.0);
    let rgba = select(only, mix(near, far, share), near.a * far.a > 0.0);
    return MeshVertex(array(position_m.x, position_m.y, position_m.z), edge, octahedral(normal), pack4x8unorm(rgba));
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs);
    if ix >= batch.max_blocks || batch.first + ix >= stale[0] { return; } // The whole group.
    let block = coords[stale[1u + batch.first + ix]].xyz;
    if lane < 27u { wg_slots[lane] = find_slot(block + around(lane)); }
    if lane < USED_WORDS { atomicStore(&wg_used[lane], 0u); }
    workgroupBarrier(); // Slots are written before voxels are looked up.
    for (var at = lane; at < TILE_VOXELS; at += 256u) {
        let pool_ix = pool_ix_of(vec3u(at % 11u, at / 11u % 11u, at / 121u) + 7u);
        var word = 0u;
        if pool_ix != 0u { word = geometry[pool_ix - 1u]; }
        wg_words[at] = word;
    }
    workgroupBarrier(); // All voxels are written, and no edge is marked.
    let n_triangles = mark_edges(2u * lane) + mark_edges(2u * lane + 1u);
    workgroupBarrier(); // All edges are marked.
    var used_bits = 0u;
    if lane < USED_WORDS { used_bits = atomicLoad(&wg_used[lane]); }
    let n_vertices = countOneBits(used_bits);
    var both = 0u; // Both sums fit in one word: at most 2187 vertices, 2560 triangles.
    let before = exclusive_scan(lane, n_vertices | (n_triangles << 16u), &both);
    let n = vec2u(both & 0xffffu, both >> 16u);
    if lane < USED_WORDS {
        var at = before & 0xffffu;
        wg_before[lane] = at;
        for (var left = used_bits; left != 0u; left &= left - 1u) {
            wg_edges[at] = 32u * lane + firstTrailingBit(left);
            at++;
        }
    }
    if lane == 0u {
        let begin = vec2u(atomicAdd(&needed[N_VERTICES], n.x), atomicAdd(&needed[N_TRIANGLES], n.y));
        wg_begin = begin;
        parts[ix] = BlockMeshRange(array(block.x, block.y, block.z), begin.x, n.x, begin.y, n.y);
    }
    workgroupBarrier(); // The block's ranges and the list of its edges are written.
    let begin = wg_begin;
    if begin.x + n.x > arrayLength(&vertices) || 3u * (begin.y + n.y) > arrayLength(&triangles) { return; }
    for (var at = lane; at < n.x; at += 256u) {
        vertices[begin.x + at] = vertex_of(block, wg_edges[at]);
    }
    let next = write_triangles(2u * lane, begin.y + (before >> 16u));
    write_triangles(2u * lane + 1u, next);
}
