// count_samples: how many pieces of each ray lie where something is.
//
// threads   one per ray
// reads     batch, march, rays, occupied (a bit a cell)
// writes    n_found [n_rays]
// twin      nerf/reference/march.rs

#import folded
#import ray_batch
#import march_params
#import space
#import march

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<uniform> march: March;
@group(0) @binding(2) var<storage, read> rays: array<Ray>;
@group(0) @binding(3) var<storage, read> occupied: array<u32>;
@group(0) @binding(4) var<storage, read_write> n_found: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ray_ix = folded(wg, n_wgs) * 64u + lane;
    if ray_ix >= batch.n_rays { return; }
    let ray = rays[ray_ix];
    var n = 0u;
    var walk = next_piece(march, ray, begin_of(march, ray));
    while !walk.is_over && n < march.most_found {
        n++;
        walk = next_piece(march, ray, walk.t + walk.length);
    }
    n_found[ray_ix] = n;
}
