// allocate_blocks: allocates every block that the rays of a depth image cross near the surface.
//
// threads   one per pixel of the depth image
// reads     field, depth_view, readings [n_pixels]
// writes    status, keys, entries, coords [n_block_slots] (block coordinates of a slot)
// twin      tsdf/reference/allocate.rs
// source    Niessner et al. 2013, section 4.2; steps from block to block: Amanatides and Woo 1987

#import field
#import field_status
#import field_insert
#import depth_view
#import folded

@group(0) @binding(0) var<uniform> field: Field;
@group(0) @binding(1) var<uniform> depth_view: DepthView;
@group(0) @binding(2) var<storage, read> readings: array<vec2f>;
@group(0) @binding(3) var<storage, read_write> status: array<atomic<u32>>;
@group(0) @binding(4) var<storage, read_write> keys: array<atomic<u32>>;
@group(0) @binding(5) var<storage, read_write> entries: array<atomic<u32>>;
@group(0) @binding(6) var<storage, read_write> coords: array<vec4i>;

const MAX_BLOCKS_PER_RAY = 64;
const MAX_TRIES = 64u;

fn request_block(block: vec3i) {
    let chunk = block >> vec3u(3u);
    if !chunk_in_range(chunk) {
        atomicAdd(&status[N_OUTSIDE], 1u);
        return;
    }
    let row = insert_chunk(chunk);
    if row == 0u {
        atomicStore(&status[TABLE_FULL], 1u);
        atomicStore(&status[FAILED], 1u);
        return;
    }
    let at = (row - 1u) * BLOCK_VOXELS + voxel_in_block(block);
    for (var i = 0u; i < MAX_TRIES; i++) {
        if atomicLoad(&entries[at]) != NO_BLOCK { return; }
        if atomicCompareExchangeWeak(&entries[at], NO_BLOCK, BLOCK_REQUESTED).exchanged {
            let slot = atomicAdd(&status[N_BLOCKS], 1u);
            if slot < field.n_block_slots {
                coords[slot] = vec4i(block, 0);
                atomicStore(&entries[at], slot + 1u);
            } else {
                atomicStore(&status[FAILED], 1u);
            }
            return;
        }
    }
}

override WG_SIZE = 64u;
@compute @workgroup_size(WG_SIZE)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = folded(wg, n_wgs) * WG_SIZE + lane;
    if at >= depth_view.depth_size_px.x * depth_view.depth_size_px.y { return; } // No barrier follows this return.
    // An earlier depth image failed and must be fused first.
    if atomicLoad(&status[STOPPED]) != 0u { return; }
    let depth_m = readings[at].x;
    if !(depth_m > 0.0) { return; }
    let pixel = vec2u(at % depth_view.depth_size_px.x, at / depth_view.depth_size_px.x);
    let ray = ray_of(depth_view, vec2f(pixel) + 0.5);
    let band_m = truncation_at(field, depth_m) / length(ray);
    let block_m = 8.0 * field.voxel_m;
    let begin = field_from_depth(depth_view, ray * max(depth_m - band_m, 0.0)) / block_m;
    let end = field_from_depth(depth_view, ray * (depth_m + band_m)) / block_m;
    var block = vec3i(floor(begin));
    let last = vec3i(floor(end));
    let toward = sign(last - block);
    let along = end - begin;
    // Fraction of the ray up to the next face along each axis, and from one face to the next.
    let next_face = vec3f(block + max(toward, vec3i(0)));
    var reached = select(vec3f(2.0), (next_face - begin) / along, toward != vec3i(0));
    let between = select(vec3f(2.0), abs(1.0 / along), toward != vec3i(0));
    let left = abs(last - block);
    let n_steps = min(left.x + left.y + left.z, MAX_BLOCKS_PER_RAY);
    request_block(block);
    for (var i = 0; i < n_steps; i++) {
        let open = block != last;
        let x = select(3.0, reached.x, open.x);
        let y = select(3.0, reached.y, open.y);
        let z = select(3.0, reached.z, open.z);
        if x <= y && x <= z {
            block.x += toward.x;
            reached.x += between.x;
        } else if y <= z {
            block.y += toward.y;
            reached.y += between.y;
        } else {
            block.z += toward.z;
            reached.z += between.z;
        }
        request_block(block);
    }
}
