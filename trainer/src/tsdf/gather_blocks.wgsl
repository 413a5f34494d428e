// gather_blocks: copies selected blocks to contiguous buffers for reading back.
//
// groups    one per block; 64 threads
// reads     listed [n_listed] (slots), geometry, colors
// writes    gathered_geometry, gathered_colors [n_listed * 512]

#import field

@group(0) @binding(0) var<storage, read> listed: array<u32>;
@group(0) @binding(1) var<storage, read> geometry: array<u32>;
@group(0) @binding(2) var<storage, read> colors: array<vec2u>;
@group(0) @binding(3) var<storage, read_write> gathered_geometry: array<u32>;
@group(0) @binding(4) var<storage, read_write> gathered_colors: array<vec2u>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = wg.y * n_wgs.x + wg.x;
    if ix * BLOCK_VOXELS >= arrayLength(&gathered_geometry) { return; } // No barrier follows this return.
    let slot = listed[ix];
    for (var z = 0u; z < 8u; z++) {
        gathered_geometry[ix * BLOCK_VOXELS + z * 64u + lane] = geometry[slot * BLOCK_VOXELS + z * 64u + lane];
        gathered_colors[ix * BLOCK_VOXELS + z * 64u + lane] = colors[slot * BLOCK_VOXELS + z * 64u + lane];
    }
}
