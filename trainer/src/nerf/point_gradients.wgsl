// point_gradients: gradients with respect to the position of every sample, computed from its feature gradients.
//
// threads   one per sample
// reads     batch, levels [n_levels], points [n_samples], grid [n_entries], rays, spans, v_activations [n_tiles,
//           n_gradient_rows, 8]
// writes    v_points [n_samples] (per unit of the scene radius)
// twin      nerf/reference/grid.rs, nerf/reference/space.rs

#import number
#import folded
#import ray_batch
#import hash_grid
#import network_tile

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> levels: array<Level>;
@group(0) @binding(2) var<storage, read> points: array<vec4f>;
@group(0) @binding(3) var<storage, read> grid: array<vec2f>;
@group(0) @binding(4) var<storage, read> rays: array<Ray>;
@group(0) @binding(5) var<storage, read> spans: array<Span>;
@group(0) @binding(6) var<storage, read> v_activations: array<Four>;
@group(0) @binding(7) var<storage, read_write> v_points: array<vec4f>;

// Gradient with respect to the point in the unit cube.
fn gradient_in(level: Level, at: vec3f, v_features: vec2f) -> vec3f {
    let cell = cell_of(level, at);
    var gradient = vec3f(0.0);
    for (var corner = 0u; corner < 8u; corner++) {
        let step = step_of(corner);
        let parts = select(1.0 - cell.share, cell.share, step == vec3u(1u));
        let sign = select(vec3f(-1.0), vec3f(1.0), step == vec3u(1u));
        let value = dot(grid[entry_of(level, cell.first + step)], v_features);
        gradient += value * sign * parts.yzx * parts.zxy;
    }
    return gradient * f32(level.n_cells);
}

// Converts a gradient with respect to the point in the unit cube to one with respect to the point in world.
fn contract_backward(at: vec3f, v: vec3f) -> vec3f {
    let size = abs(at);
    let max_abs = max(size.x, max(size.y, size.z));
    if max_abs <= 1.0 { return v / 4.0; }
    let is_max = select(vec3f(0.0), sign(at), size == vec3f(max_abs));
    // If two axes are equal, only one of them is selected.
    let axis = select(select(vec3f(0.0, 0.0, is_max.z), vec3f(0.0, is_max.y, 0.0), is_max.y != 0.0), vec3f(is_max.x, 0.0, 0.0), is_max.x != 0.0);
    let factor = (2.0 * max_abs - 1.0) / (max_abs * max_abs);
    let by_max = (2.0 - 2.0 * max_abs) / (max_abs * max_abs * max_abs);
    return (v * factor + dot(at, v) * by_max * axis) / 4.0;
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let sample = folded(wg, n_wgs) * 64u + lane;
    if sample >= batch.n_samples { return; }
    let row = (sample / TILE * n_gradient_rows() + v_features_row()) * PARTS + sample % TILE / 4u;
    let at = points[sample].xyz;
    var gradient = vec3f(0.0);
    for (var level = 0u; level < arrayLength(&levels); level++) {
        let first = row + 2u * level * PARTS;
        let v = vec2f(f32(v_activations[first][sample % 4u]), f32(v_activations[first + PARTS][sample % 4u])) / gradient_scale(batch.n_rays);
        gradient += gradient_in(levels[level], at, v);
    }
    let span = spans[sample];
    let ray = rays[span.ray];
    v_points[sample] = vec4f(contract_backward(ray.origin + 0.5 * (span.begin + span.end) * ray.direction, gradient), 0.0);
}
