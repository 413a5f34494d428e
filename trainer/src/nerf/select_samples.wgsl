// select_samples: composites the densities of one more round of samples, marks rays that are finished, and selects the
// samples whose colors are evaluated.
//
// The color of a selected sample represents all samples since the previous selected one. These contribute little,
// because most samples of a ray lie in front of or behind its surface.
//
// threads   one per ray
// reads     march (max_found: samples per round), spans, log_density [n_samples]
// writes    rays (first_sample, n_samples: now of the selected samples; progress), light [n_rays, 2] (rgb and
//           transmittance; distance, weight not represented yet, and front), selected (n_samples, zero before; n_rounds),
//           selected_spans, selected_weights [n_selected]
// twin      nerf/reference/ray.rs
//
// The positions of selected samples in the buffers depend on the order in which workgroups run; the colors do not.

#import folded
#import ray_batch
#import march_params
#import density
#import scan

struct SampleCounter {
    n_rays: u32,
    n_samples: atomic<u32>,
    n_rounds: u32,         // that had samples
    unused: u32,
}

@group(0) @binding(0) var<uniform> march: March;
@group(0) @binding(1) var<storage, read> spans: array<Span>;
@group(0) @binding(2) var<storage, read> log_density: array<f32>;
@group(0) @binding(3) var<storage, read_write> rays: array<Ray>;
@group(0) @binding(4) var<storage, read_write> light: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> selected: SampleCounter;
@group(0) @binding(6) var<storage, read_write> selected_spans: array<Span>;
@group(0) @binding(7) var<storage, read_write> selected_weights: array<f32>;
@group(0) @binding(8) var<storage, read> batch: Batch;

// Rays with less transmittance are finished. This is half of the smallest difference between 8-bit colors.
const MIN_TRANSMITTANCE = 1.0 / 512.0;
// A sample is selected when it and the samples since the last selected one add this much.
const MIN_WEIGHT = 1.0 / 64.0;

var<workgroup> wg_first: u32;

// The state of a ray while its samples are composited.
struct Progress {
    transmittance: f32,
    distance: f32,
    pending: f32,          // weight since the last selected sample
    front: f32,            // start of the first selected sample
}

// Adds a sample. Returns the weight that the sample represents if it is selected, else 0.
fn add_sample(progress: ptr<function, Progress>, ix: u32, is_last: bool) -> f32 {
    let span = spans[ix];
    let transmitted = exp(-density_of(log_density[ix]) * (span.end - span.begin));
    let weight = (*progress).transmittance * (1.0 - transmitted);
    (*progress).distance += weight * 0.5 * (span.begin + span.end);
    (*progress).transmittance *= transmitted;
    (*progress).pending += weight;
    let represented = (*progress).pending;
    if represented < select(MIN_WEIGHT, 1e-9, is_last || (*progress).transmittance <= MIN_TRANSMITTANCE) { return 0.0; }
    (*progress).pending = 0.0;
    (*progress).front = min((*progress).front, span.begin);
    return represented;
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ray_ix = folded(wg, n_wgs) * 256u + lane;
    if ray_ix == 0u && batch.n_samples > 0u { selected.n_rounds += 1u; }
    var first = 0u;
    var end = 0u;
    var before: Progress;
    var is_last_round = false;
    if ray_ix < selected.n_rays && rays[ray_ix].progress == RAY_RUNNING {
        first = rays[ray_ix].first_sample;
        end = first + rays[ray_ix].n_samples;
        is_last_round = end - first < march.max_found;
        before = Progress(light[2u * ray_ix].a, light[2u * ray_ix + 1u].x, light[2u * ray_ix + 1u].y, light[2u * ray_ix + 1u].z);
    }
    var counted = before;
    var n = 0u;
    for (var ix = first; ix < end; ix++) {
        if add_sample(&counted, ix, is_last_round && ix + 1u == end) > 0.0 { n++; }
        if counted.transmittance <= MIN_TRANSMITTANCE { end = ix + 1u; }
    }
    var total: u32;
    let below = exclusive_scan(lane, n, &total);
    if lane == 0u { wg_first = atomicAdd(&selected.n_samples, total); }
    var at = workgroupUniformLoad(&wg_first) + below;
    if ray_ix >= selected.n_rays || rays[ray_ix].progress != RAY_RUNNING { return; }
    rays[ray_ix].first_sample = at;
    rays[ray_ix].n_samples = n;
    for (var ix = first; ix < end; ix++) {
        let weight = add_sample(&before, ix, is_last_round && ix + 1u == end);
        if weight > 0.0 {
            selected_spans[at] = Span(0.0, 0.0, ray_ix, ix);
            selected_weights[at] = weight;
            at++;
        }
    }
    light[2u * ray_ix].a = counted.transmittance;
    light[2u * ray_ix + 1u] = vec4f(counted.distance, counted.pending, counted.front, 0.0);
    if is_last_round || counted.transmittance <= MIN_TRANSMITTANCE { rays[ray_ix].progress = RAY_ENDED; }
}
