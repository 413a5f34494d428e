// picture_rays: generates the rays for a range of pixels of a view.
//
// The first pass renders every fourth pixel along x and y, which gives the distances of surfaces. In the second pass,
// rays skip the haze in front of these surfaces. They do not skip solid cells, because a thin object may lie between
// the rays of the first pass.
//
// threads   one per ray
// reads     batch, march (first_ray: the first pixel in `pixel_order`; pixel_stride), view (in units of the scene radius around its
//           center), fronts (of the first pass)
// writes    rays, light [n_rays, 2] (reset: nothing accumulated)

#import view
#import picture_ray
#import pixel_order
#import ray_batch
#import march_params

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<uniform> march: March;
@group(0) @binding(2) var<uniform> view: View;
@group(0) @binding(3) var<storage, read_write> rays: array<Ray>;
@group(0) @binding(4) var<storage, read_write> light: array<vec4f>;
@group(0) @binding(5) var<storage, read> fronts: array<f32>;

override PICTURE_EMBEDDING_IX: u32;

const FRONT_STRIDE = 4u;
// Distance kept before a front, once relative to the distance of the front, and once in steps.
const FRONT_MARGIN = 0.005;
const FRONT_MARGIN_STEPS = 1.5;

// Distance beyond which all occupied cells are sampled. Before this distance, only solid cells are sampled.
fn start_of(pixel: vec2u) -> f32 {
    let size = (view.size_px + FRONT_STRIDE - 1u) / FRONT_STRIDE;
    let at = vec2i(pixel / FRONT_STRIDE);
    var front = FAR_FRONT;
    for (var y = -1; y <= 1; y++) {
        for (var x = -1; x <= 1; x++) {
            let neighbor = vec2u(clamp(at + vec2i(x, y), vec2i(0), vec2i(size) - 1));
            front = min(front, fronts[neighbor.y * size.x + neighbor.x]);
        }
    }
    return max(front * (1.0 - FRONT_MARGIN) - FRONT_MARGIN_STEPS * march.step, 0.0);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ray_ix = folded(wg, n_wgs) * 64u + lane;
    if ray_ix >= batch.n_rays { return; }
    light[2u * ray_ix] = vec4f(0.0, 0.0, 0.0, 1.0);
    light[2u * ray_ix + 1u] = vec4f(0.0, 0.0, FAR_FRONT, 0.0);
    let stride = march.pixel_stride;
    let low_pixel = pixel_at(march.first_ray + ray_ix, (view.size_px + stride - 1u) / stride);
    let at = min(stride * low_pixel + stride / 2u, view.size_px - 1u);
    let pixel = ray_of_pixel(at);
    var start = 0.0;
    if stride == 1u { start = start_of(at); }
    let speed = length(pixel.along);
    let range = pixel.range * speed;
    rays[ray_ix] = Ray(pixel.origin, 0u, pixel.along / speed, 0u, range.x, range.y, PICTURE_EMBEDDING_IX, 0u, start, 0.5, RAY_RUNNING, 0u);
}
