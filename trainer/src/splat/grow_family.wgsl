// grow_family: divide a parent's opacity among the parent and its children, and reset the error sums.
//
// threads   one per splat up to n_after
// reads     growth, n_children, parents
// writes    shapes, moments, error_sums
// source    Kheradmand et al. 2024 (3DGS-MCMC), equation 9: n splats at one position look like the original splat

#import view
#import growth

@group(0) @binding(0) var<uniform> growth: Growth;
@group(0) @binding(1) var<storage, read> n_children: array<u32>;
@group(0) @binding(2) var<storage, read> parents: array<u32>;
@group(0) @binding(3) var<storage, read_write> shapes: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> moments: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> error_sums: array<f32>;

override WG_SIZE = 256u;
const MAX_FAMILY = 16u; // Larger families are treated as if they had this size.

@compute @workgroup_size(WG_SIZE)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let splat_ix = folded(wg, n_wgs) * WG_SIZE + lane;
    if splat_ix >= growth.n_after { return; } // Allowed here: no barrier below.
    error_sums[splat_ix] = 0.0;
    var parent = parents[splat_ix];
    if parent == NO_PARENT { parent = splat_ix; }
    if parent >= growth.n_before || n_children[parent] == 0u { return; }
    let n = min(n_children[parent] + 1u, MAX_FAMILY);
    let shape = shapes[splat_ix];
    let opacity = clamp(1.0 / (1.0 + exp(-shape.w)), 1e-4, 0.9999);
    let shared_opacity = clamp(1.0 - pow(1.0 - opacity, 1.0 / f32(n)), growth.min_opacity, 0.9999);
    var weight = 0.0;
    for (var i = 1u; i <= n; i++) {
        var choose = 1.0;    // binomial coefficient (i - 1 choose k)
        var power = shared_opacity;
        for (var k = 0u; k < i; k++) {
            weight += select(choose, -choose, (k & 1u) == 1u) * power / sqrt(f32(k) + 1.0);
            choose *= f32(i - 1u - k) / f32(k + 1u);
            power *= shared_opacity;
        }
    }
    let shrink = log(clamp(opacity / weight, 0.05, 1.0));
    shapes[splat_ix] = vec4f(shape.xyz + shrink, log(shared_opacity / (1.0 - shared_opacity)));
    // Resetting Adam's moments makes a family's first steps at least three times as long as usual, so that it
    // converges faster.
    for (var plane = 0u; plane < 6u; plane++) { moments[plane * growth.capacity + splat_ix] = vec4f(0.0); }
}
