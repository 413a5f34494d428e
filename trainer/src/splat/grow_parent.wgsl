// grow_parent: make room for the children, and start counting errors anew.
//
// threads   one per splat up to n_after
// reads     growth, n_children
// writes    shapes, moments, error_sums

#import view
#import growth

@group(0) @binding(0) var<uniform> growth: Growth;
@group(0) @binding(1) var<storage, read> n_children: array<u32>;
@group(0) @binding(2) var<storage, read_write> shapes: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> moments: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> error_sums: array<f32>;

override WG_SIZE = 256u;
@compute @workgroup_size(WG_SIZE)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let splat_ix = folded(wg, n_wgs) * WG_SIZE + lane;
    if splat_ix >= growth.n_after { return; } // Allowed here: no barrier below.
    error_sums[splat_ix] = 0.0;
    if splat_ix >= growth.n_before || n_children[splat_ix] == 0u { return; }
    shapes[splat_ix] += vec4f(vec3f(growth.child_log_scale), 0.0);
    for (var plane = 4u; plane < 6u; plane++) { moments[plane * growth.capacity + splat_ix] = vec4f(0.0); }
}
