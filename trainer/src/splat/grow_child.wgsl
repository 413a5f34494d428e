// grow_child: assign each dead or new splat a parent, chosen by error, and sample a position within the parent.
//
// threads   one per splat up to n_after
// reads     growth, weights, cumulative, block_weights
// writes    means, rotations, shapes, sh_dc, sh_rest, all moments of the child; n_children [n_before] (cleared by the
//           caller), parents [n_after]
//
// Dead splats have weight zero and cannot be parents. A child is therefore never a parent, and no thread reads values
// that another thread writes. In one or two choices per million, rounding errors of the sums select a splat of weight
// zero. Such a choice is discarded.

#import view
#import growth
#import random
#import projection

@group(0) @binding(0) var<uniform> growth: Growth;
@group(0) @binding(1) var<storage, read> cumulative: array<f32>;
@group(0) @binding(2) var<storage, read> block_weights: array<f32>;
@group(0) @binding(3) var<storage, read_write> means: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> rotations: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> shapes: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> sh_dc: array<f32>;
@group(0) @binding(7) var<storage, read_write> sh_rest: array<f32>;
@group(0) @binding(8) var<storage, read_write> moments: array<vec4f>;
@group(0) @binding(9) var<storage, read_write> sh_dc_moments: array<vec2f>;
@group(0) @binding(10) var<storage, read_write> sh_rest_moments: array<f32>;
@group(0) @binding(11) var<storage, read_write> n_children: array<atomic<u32>>;
@group(0) @binding(12) var<storage, read_write> parents: array<u32>;
@group(0) @binding(13) var<storage, read> weights: array<f32>;

override WG_SIZE = 256u;
@compute @workgroup_size(WG_SIZE)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let child = folded(wg, n_wgs) * WG_SIZE + lane;
    if child >= growth.n_after { return; } // Allowed here: no barrier below.
    parents[child] = NO_PARENT;
    if child < growth.n_before && !is_dead(means[child], shapes[child], growth.min_opacity) { return; }
    let n_blocks = (growth.n_before + 255u) / 256u;
    let total = block_weights[n_blocks - 1u];
    let threshold = uniform3(vec3u(child, growth.key, 7u)).x * total;
    // These searches find the first block, and then the first splat, whose cumulative sum exceeds the threshold.
    var low = 0u;
    var high = n_blocks - 1u;
    while low < high {
        let middle = (low + high) / 2u;
        if block_weights[middle] > threshold { high = middle; } else { low = middle + 1u; }
    }
    var within_block = threshold;
    if low > 0u { within_block -= block_weights[low - 1u]; }
    var parent = low * 256u;
    high = min(parent + 255u, growth.n_before - 1u);
    while parent < high {
        let middle = (parent + high) / 2u;
        if cumulative[middle] > within_block { high = middle; } else { parent = middle + 1u; }
    }
    if weights[parent] <= 0.0 {
        // No error is recorded yet, or rounding selected a dead splat. A new splat stays invisible until the next growth.
        if child >= growth.n_before {
            means[child] = vec4f(0.0);
            rotations[child] = vec4f(1.0, 0.0, 0.0, 0.0);
            shapes[child] = vec4f(-7.0, -7.0, -7.0, -12.0);
        }
        return;
    }
    parents[child] = parent;
    atomicAdd(&n_children[parent], 1u); // Integer sums do not depend on the order.

    let shape = shapes[parent];
    let offset = rotation_of(rotations[parent]) * (exp(shape.xyz) * clamp(normal3(vec3u(child, growth.key, 11u)), vec3f(-2.0), vec3f(2.0)));
    means[child] = means[parent] + vec4f(growth.child_spread * offset, 0.0);
    rotations[child] = rotations[parent];
    shapes[child] = shape;
    for (var plane = 0u; plane < 6u; plane++) { moments[plane * growth.capacity + child] = vec4f(0.0); }
    for (var plane = 0u; plane < 3u; plane++) {
        sh_dc[plane * growth.capacity + child] = sh_dc[plane * growth.capacity + parent];
        sh_dc_moments[plane * growth.capacity + child] = vec2f(0.0);
    }
    for (var plane = 0u; plane < growth.n_sh_rest; plane++) {
        sh_rest[plane * growth.capacity + child] = sh_rest[plane * growth.capacity + parent];
    }
    sh_rest_moments[child] = 0.0;
}
