// keep_fronts: keeps the distances at which the accumulated weights of rays first reach MIN_WEIGHT.
//
// threads   one per ray
// reads     batch, march (first_ray: the first pixel in `pixel_order`; pixel_stride), view, rays, light
// writes    fronts [height, width] (distance along the ray; FAR_FRONT if it hits no surface, 0 if unknown)

#import view
#import pixel_order
#import ray_batch
#import march_params

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<uniform> march: March;
@group(0) @binding(2) var<uniform> view: View;
@group(0) @binding(3) var<storage, read> rays: array<Ray>;
@group(0) @binding(4) var<storage, read> light: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> fronts: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ray_ix = folded(wg, n_wgs) * 64u + lane;
    if ray_ix >= batch.n_rays { return; }
    let front = light[2u * ray_ix + 1u].z;
    let is_unknown = rays[ray_ix].progress == RAY_RUNNING && front == FAR_FRONT;
    let size = (view.size_px + march.pixel_stride - 1u) / march.pixel_stride;
    let pixel = pixel_at(march.first_ray + ray_ix, size);
    fronts[pixel.x + size.x * pixel.y] = select(front, 0.0, is_unknown);
}
