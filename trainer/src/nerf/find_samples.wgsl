// find_samples: finds the next samples of the rays of a picture, at most MAX_SAMPLES_PER_ROUND per ray.
//
// threads   one per ray
// reads     march, occupied (one bit per cell)
// writes    rays (next_segment, first_sample, n_samples), batch (n_samples, zero before), spans, points [n_samples]
//           (center of the sample, in the unit cube)
// twin      nerf/reference/march.rs
//
// The positions of samples in the buffers depend on the order in which workgroups run; the resulting colors do not.

#import folded
#import ray_batch
#import march_params
#import space
#import cell_blocks
#import march
#import scan

struct SampleCounter {
    n_rays: u32,
    n_samples: atomic<u32>,
    unused: vec2u,
}

@group(0) @binding(0) var<uniform> march: March;
@group(0) @binding(1) var<storage, read> occupied: array<u32>;
@group(0) @binding(2) var<storage, read_write> batch: SampleCounter;
@group(0) @binding(3) var<storage, read_write> rays: array<Ray>;
@group(0) @binding(4) var<storage, read_write> spans: array<Span>;
@group(0) @binding(5) var<storage, read_write> points: array<vec4f>;

const MAX_SAMPLES_PER_ROUND = 8u;

var<workgroup> wg_first: u32;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ray_ix = folded(wg, n_wgs) * 256u + lane;
    var segments: array<vec2f, MAX_SAMPLES_PER_ROUND>;
    var n = 0u;
    var ray: Ray;
    if ray_ix < batch.n_rays {
        ray = rays[ray_ix];
        let path = path_of(march, ray);
        let end_ix = select(path.n_segments, 0u, ray.is_finished == 1u);
        var segment = next_segment(march, ray, path, ray.next_segment, end_ix);
        while segment.ix < end_ix && n < MAX_SAMPLES_PER_ROUND {
            segments[n] = vec2f(segment.begin, segment.end);
            n++;
            rays[ray_ix].next_segment = segment.ix + 1u;
            if n < MAX_SAMPLES_PER_ROUND { segment = next_segment(march, ray, path, segment.ix + 1u, end_ix); }
        }
    }
    var total: u32;
    let below = exclusive_scan(lane, n, &total);
    if lane == 0u { wg_first = atomicAdd(&batch.n_samples, total); }
    let first = workgroupUniformLoad(&wg_first) + below;
    if ray_ix < batch.n_rays {
        rays[ray_ix].first_sample = first;
        rays[ray_ix].n_samples = n;
        for (var i = 0u; i < n; i++) {
            spans[first + i] = Span(segments[i].x, segments[i].y, ray_ix, 0u);
            points[first + i] = vec4f(contract(ray.origin + 0.5 * (segments[i].x + segments[i].y) * ray.direction), 0.0);
        }
    }
}
