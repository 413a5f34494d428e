// count_samples: counts the segments of each ray that are in occupied cells.
//
// threads   8 per ray, each for a part of it
// reads     batch, march, rays, occupied (one bit per cell, then one bit per block)
// writes    n_found [n_rays], n_before [n_rays, 8] (number of segments found by earlier threads of the ray)
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
@group(0) @binding(3) var<storage, read> occupied: array<u32>;
@group(0) @binding(4) var<storage, read_write> n_found: array<u32>;
@group(0) @binding(5) var<storage, read_write> n_before: array<u32>;

var<workgroup> wg_found: array<u32, 64>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 64u + lane;
    let ray_ix = ix / THREADS_PER_RAY;
    let share = ix % THREADS_PER_RAY;
    var n = 0u;
    if ray_ix < batch.n_rays {
        let ray = rays[ray_ix];
        let path = path_of(march, ray);
        let range = segments_of_thread(path, share);
        let boxes = boxes_of(march.n_cells);
        var segment_ix = range.x;
        while segment_ix < range.y {
            let visit = visit(march, boxes, ray, path, segment_ix, range.y, 0u);
            if visit.is_marked { n++; }
            segment_ix = visit.next_ix;
        }
    }
    wg_found[lane] = n;
    workgroupBarrier(); // All threads of a ray have counted.
    if ray_ix < batch.n_rays {
        var sum = 0u;
        for (var other = lane - share; other < lane; other++) { sum += wg_found[other]; }
        n_before[ix] = sum;
        if share == THREADS_PER_RAY - 1u { n_found[ray_ix] = sum + n; }
    }
}
