// place_samples: chooses the sample range of each ray, and a limit of samples per ray so that all rays fit.
//
// threads   256, in one workgroup
// reads     march, n_found
// writes    rays (first_sample, n_samples), batch (n_samples, max_samples)

#import ray_batch
#import march_params
#import scan

@group(0) @binding(0) var<storage, read_write> batch: Batch;
@group(0) @binding(1) var<uniform> march: March;
@group(0) @binding(2) var<storage, read> n_found: array<u32>;
@group(0) @binding(3) var<storage, read_write> rays: array<Ray>;

override CAPACITY: u32;

var<workgroup> wg_n_samples: u32;

fn n_kept(ray_ix: u32, max_samples: u32) -> u32 {
    let found = n_found[ray_ix];
    let thinning = thinning_of(max_samples, rays[ray_ix], found);
    return (found + thinning.stride - 1u - thinning.phase) / thinning.stride;
}

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
    let n_rays = batch.n_rays;
    var max_samples = march.max_samples;
    loop {
        var sum = 0u;
        for (var ray_ix = lane; ray_ix < n_rays; ray_ix += SCAN_LANES) { sum += n_kept(ray_ix, max_samples); }
        var total: u32;
        let below = exclusive_scan(lane, sum, &total);
        if lane == 0u { wg_n_samples = total; }
        let n_samples = workgroupUniformLoad(&wg_n_samples);
        if n_samples <= CAPACITY || max_samples <= 1u { break; }
        max_samples /= 2u;
    }
    var begin = 0u;
    for (var first = 0u; first < arrayLength(&rays); first += SCAN_LANES) {
        let ray_ix = first + lane;
        var n = 0u;
        if ray_ix < n_rays { n = n_kept(ray_ix, max_samples); }
        var total: u32;
        let first_sample_ix = begin + exclusive_scan(lane, n, &total);
        if ray_ix < n_rays {
            rays[ray_ix].first_sample = min(first_sample_ix, CAPACITY);
            rays[ray_ix].n_samples = select(0u, n, first_sample_ix + n <= CAPACITY);
        }
        begin += total;
    }
    if lane == 0u {
        batch.n_samples = min(begin, CAPACITY);
        batch.max_samples = max_samples;
    }
}
