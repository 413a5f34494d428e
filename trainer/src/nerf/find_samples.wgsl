// find_samples: finds the next samples of the rays of a picture, at most MAX_SAMPLES_PER_ROUND per ray.
//
// threads   one per ray
// reads     march, occupied (one bit per cell), rays (target_distance: only solid cells are sampled before it), erased
//           (for points in units of the scene radius)
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
#import erased

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
@group(0) @binding(6) var<storage, read> erased: array<vec4u>;

const MAX_SAMPLES_PER_ROUND = 8u;

var<workgroup> wg_first: u32;
var<workgroup> wg_segments: array<u32, 2048>; // [MAX_SAMPLES_PER_ROUND, 256], numbers of the segments found

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ray_ix = folded(wg, n_wgs) * 256u + lane;
    var n = 0u;
    var path: Path;
    if ray_ix < batch.n_rays && rays[ray_ix].progress == RAY_RUNNING {
        let ray = rays[ray_ix];
        path = path_of(march, ray);
        var ix = ray.next_segment;
        let free_ix = segment_at(march, path, ray.target_distance);
        let boxes = boxes_of(march.n_cells);
        while ix < path.n_segments && n < MAX_SAMPLES_PER_ROUND {
            let visit = visit(march, boxes, ray, path, ix, path.n_segments, free_ix);
            if visit.is_marked && !is_erased(middle_of(march, ray, path, ix)) {
                wg_segments[n * 256u + lane] = ix;
                n++;
            }
            ix = visit.next_ix;
        }
        rays[ray_ix].next_segment = ix;
    }
    var total: u32;
    let below = exclusive_scan(lane, n, &total);
    if lane == 0u { wg_first = atomicAdd(&batch.n_samples, total); }
    let first = workgroupUniformLoad(&wg_first) + below;
    if ray_ix >= batch.n_rays || rays[ray_ix].progress != RAY_RUNNING { return; }
    rays[ray_ix].first_sample = first;
    rays[ray_ix].n_samples = n;
    let ray = rays[ray_ix];
    for (var i = 0u; i < n; i++) {
        let segment = segment_of(march, ray, path, wg_segments[i * 256u + lane]);
        spans[first + i] = Span(segment.x, segment.y, ray_ix, first + i);
        points[first + i] = vec4f(contract(ray.origin + 0.5 * (segment.x + segment.y) * ray.direction), 0.0);
    }
}
