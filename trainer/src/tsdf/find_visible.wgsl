// find_visible: lists the blocks that a depth image may observe. Their order depends on thread timing, but results do
// not, because blocks are processed independently.
//
// threads   one per block
// reads     field, depth_view, coords [n_blocks]
// writes    status (N_VISIBLE), visible [N_VISIBLE] (slots)
// twin      tsdf/reference/integrate.rs

#import field
#import field_status
#import depth_view
#import folded

@group(0) @binding(0) var<uniform> field: Field;
@group(0) @binding(1) var<uniform> depth_view: DepthView;
@group(0) @binding(2) var<storage, read> coords: array<vec4i>;
@group(0) @binding(3) var<storage, read_write> status: array<atomic<u32>>;
@group(0) @binding(4) var<storage, read_write> visible: array<u32>;

override WG_SIZE = 64u;
@compute @workgroup_size(WG_SIZE)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let slot = folded(wg, n_wgs) * WG_SIZE + lane;
    if atomicLoad(&status[FAILED]) != 0u { return; } // No barrier follows this return.
    if slot >= min(atomicLoad(&status[N_BLOCKS]), field.n_block_slots) { return; }
    let center = depth_from_field(depth_view, (vec3f(coords[slot].xyz) + 0.5) * (8.0 * field.voxel_m));
    let radius_m = 7.0 * field.voxel_m; // Half the diagonal of a block is 6.93 voxels.
    let focal = depth_view.depth_focal_px;
    let principal = depth_view.depth_principal_px;
    let rest = vec2f(depth_view.depth_size_px) - principal;
    let low = focal * center.xy + principal * center.z >= -radius_m * sqrt(focal * focal + principal * principal);
    let high = rest * center.z - focal * center.xy >= -radius_m * sqrt(focal * focal + rest * rest);
    let near = center.z >= -radius_m;
    let far = center.z <= field.max_depth_m + field.scale_m + radius_m;
    if all(low) && all(high) && near && far {
        visible[atomicAdd(&status[N_VISIBLE], 1u)] = slot;
    }
}
