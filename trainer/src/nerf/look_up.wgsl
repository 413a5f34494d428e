// look_up: what the grid holds around the middle of every sample.
//
// threads   one per sample and level
// reads     batch, space, levels [n_levels], rays, spans [n_samples], grid [n_entries]
// writes    features [n_samples, n_levels]
// twin      nerf/reference/grid.rs
// source    Mueller et al. 2022

#import ray_batch
#import space
#import hash_grid

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<uniform> space: Space;
@group(0) @binding(2) var<storage, read> levels: array<Level>;
@group(0) @binding(3) var<storage, read> rays: array<Ray>;
@group(0) @binding(4) var<storage, read> spans: array<Span>;
@group(0) @binding(5) var<storage, read> grid: array<vec2f>;
@group(0) @binding(6) var<storage, read_write> features: array<vec2f>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 256u + lane;
    let n_levels = arrayLength(&levels);
    let sample = ix / n_levels;
    if sample >= batch.n_samples { return; }
    let level = levels[ix % n_levels];
    let span = spans[sample];
    let cell = cell_of(level, contract(space, middle_of(rays[span.ray], span)));
    var found = vec2f(0.0);
    for (var corner = 0u; corner < 8u; corner++) {
        let step = step_of(corner);
        found += weight_of(cell, step) * grid[entry_of(level, cell.first + step)];
    }
    features[ix] = found;
}
