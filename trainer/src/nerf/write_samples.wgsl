// write_samples: writes the samples of each ray.
//
// threads   8 per ray, each for a part of it
// reads     batch, march, rays, n_found [n_rays], n_before [n_rays, 8], occupied
// writes    spans [n_samples], points [n_samples] (center of the sample, in the unit cube; w unused)
// twin      nerf/reference/march.rs

#import folded
#import ray_batch
#import march_params
#import space
#import cell_blocks
#import march
#import march_threads

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<uniform> march: March;
@group(0) @binding(2) var<storage, read> rays: array<Ray>;
@group(0) @binding(3) var<storage, read> n_found: array<u32>;
@group(0) @binding(4) var<storage, read> n_before: array<u32>;
@group(0) @binding(5) var<storage, read> occupied: array<u32>;
@group(0) @binding(6) var<storage, read_write> spans: array<Span>;
@group(0) @binding(7) var<storage, read_write> points: array<vec4f>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 64u + lane;
    let ray_ix = ix / THREADS_PER_RAY;
    if ray_ix >= batch.n_rays { return; }
    let ray = rays[ray_ix];
    if ray.n_samples == 0u { return; }
    let thinning = thinning_of(batch.max_samples, ray, n_found[ray_ix]);
    let path = path_of(march, ray);
    let range = segments_of_thread(path, ix % THREADS_PER_RAY);
    var n = n_before[ix];
    let boxes = boxes_of(march.n_cells);
    var segment_ix = range.x;
    while segment_ix < range.y {
        let visit = visit(march, boxes, ray, path, segment_ix, range.y, 0u);
        if visit.is_marked {
            let at = n / thinning.stride;
            if n % thinning.stride == thinning.phase && at < ray.n_samples {
                let segment = segment_of(march, ray, path, segment_ix);
                let middle = 0.5 * (segment.x + segment.y);
                let reach = 0.5 * (segment.y - segment.x) * f32(thinning.stride);
                spans[ray.first_sample + at] = Span(middle - reach, middle + reach, ray_ix, ray.first_sample + at);
                points[ray.first_sample + at] = vec4f(contract(ray.origin + middle * ray.direction), 0.0);
            }
            n++;
        }
        segment_ix = visit.next_ix;
    }
}
