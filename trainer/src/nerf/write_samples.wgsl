// write_samples: the samples of each ray.
//
// threads   one per ray
// reads     batch, march, rays, n_found, occupied
// writes    spans [n_samples], points [n_samples] (middle of the sample, in the unit cube; w unused)
// twin      nerf/reference/march.rs

#import folded
#import ray_batch
#import march_params
#import space
#import march

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<uniform> march: March;
@group(0) @binding(2) var<storage, read> rays: array<Ray>;
@group(0) @binding(3) var<storage, read> n_found: array<u32>;
@group(0) @binding(4) var<storage, read> occupied: array<u32>;
@group(0) @binding(5) var<storage, read_write> spans: array<Span>;
@group(0) @binding(6) var<storage, read_write> points: array<vec4f>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ray_ix = folded(wg, n_wgs) * 64u + lane;
    if ray_ix >= batch.n_rays { return; }
    let ray = rays[ray_ix];
    if ray.n_samples == 0u { return; }
    let thinning = thinning_of(batch.most_samples, ray, n_found[ray_ix]);
    var at = ray.first_sample;
    let end = ray.first_sample + ray.n_samples;
    var n = 0u;
    var walk = next_piece(march, ray, begin_of(march, ray));
    while !walk.is_over && at < end {
        if n % thinning.stride == thinning.phase {
            let middle = walk.t + 0.5 * walk.length;
            let reach = 0.5 * walk.length * f32(thinning.stride);
            spans[at] = Span(middle - reach, middle + reach, ray_ix, 0u);
            points[at] = vec4f(contract(ray.origin + middle * ray.direction), 0.0);
            at++;
        }
        n++;
        walk = next_piece(march, ray, walk.t + walk.length);
    }
    // Both walks are the same numbers; should a compiler round them differently, what is left is empty.
    for (; at < end; at++) {
        spans[at] = Span(ray.end, ray.end, ray_ix, 0u);
        points[at] = vec4f(0.5);
    }
}
