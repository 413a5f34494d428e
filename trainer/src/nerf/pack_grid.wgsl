// pack_grid: converts the entries of the grid to f16.
//
// threads   one per two entries
// reads     grid [n_entries / 2]
// writes    packed_grid [n_entries / 2]

#import folded

@group(0) @binding(0) var<storage, read> grid: array<vec4f>;
@group(0) @binding(1) var<storage, read_write> packed_grid: array<vec2u>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 256u + lane;
    if ix < arrayLength(&packed_grid) { packed_grid[ix] = vec2u(pack2x16float(grid[ix].xy), pack2x16float(grid[ix].zw)); }
}
