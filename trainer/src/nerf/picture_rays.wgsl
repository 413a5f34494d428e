// picture_rays: generates the rays for a range of pixels of a view.
//
// threads   one per ray
// reads     batch, march (first_ray: the first pixel), view (in units of the scene radius around its center)
// writes    rays, light [n_rays, 2] (reset: nothing accumulated)

#import view
#import picture_ray
#import ray_batch
#import march_params

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<uniform> march: March;
@group(0) @binding(2) var<uniform> view: View;
@group(0) @binding(3) var<storage, read_write> rays: array<Ray>;
@group(0) @binding(4) var<storage, read_write> light: array<vec4f>;

override PICTURE_EMBEDDING_IX: u32;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ray_ix = folded(wg, n_wgs) * 64u + lane;
    if ray_ix >= batch.n_rays { return; }
    light[2u * ray_ix] = vec4f(0.0, 0.0, 0.0, 1.0);
    light[2u * ray_ix + 1u] = vec4f(0.0);
    let pixel_ix = march.first_ray + ray_ix;
    let pixel = ray_of_pixel(vec2u(pixel_ix % view.size_px.x, pixel_ix / view.size_px.x));
    let speed = length(pixel.along);
    let range = pixel.range * speed;
    rays[ray_ix] = Ray(pixel.origin, 0u, pixel.along / speed, 0u, range.x, range.y, PICTURE_EMBEDDING_IX, 0u, 0.0, 0.5, 0u, 0u);
}
