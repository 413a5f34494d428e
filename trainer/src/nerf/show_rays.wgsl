// show_rays: adds the colors of one more round of selected samples to the pixels of rays.
//
// threads   one per ray
// reads     batch, march (first_ray: the first pixel in `pixel_order`), view, backdrop, selected_weights, colors
//           [n_selected]
// writes    rays (progress), light [n_rays, 2] (rgb), pixels [n_pixels] (rgba8; a:
//           coverage), depths [n_pixels] (meters along z, weighted mean; 0 for pixels without coverage)
// twin      nerf/reference/ray.rs

#import view
#import picture_ray
#import pixel_order
#import ray_batch
#import march_params

struct Backdrop {
    srgb: vec3f,
    radius_m: f32,         // of the scene: meters per unit
}

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<uniform> march: March;
@group(0) @binding(2) var<uniform> view: View;
@group(0) @binding(3) var<uniform> backdrop: Backdrop;
@group(0) @binding(4) var<storage, read_write> rays: array<Ray>;
@group(0) @binding(5) var<storage, read> selected_weights: array<f32>;
@group(0) @binding(6) var<storage, read> colors: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> pixels: array<u32>;
@group(0) @binding(8) var<storage, read_write> depths: array<f32>;
@group(0) @binding(9) var<storage, read_write> light: array<vec4f>;

const MIN_COVERAGE = 1e-3;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ray_ix = folded(wg, n_wgs) * 64u + lane;
    if ray_ix >= batch.n_rays { return; }
    let progress = rays[ray_ix].progress;
    if progress == RAY_SHOWN { return; }
    let first = rays[ray_ix].first_sample;
    let end = first + rays[ray_ix].n_samples;
    let transmittance = light[2u * ray_ix].a;
    var rgb = light[2u * ray_ix].rgb;
    for (var ix = first; ix < end; ix++) { rgb += selected_weights[ix] / (1.0 + exp(-colors[ix].rgb)); }
    light[2u * ray_ix] = vec4f(rgb, transmittance);
    if progress == RAY_RUNNING { return; }
    rays[ray_ix].progress = RAY_SHOWN;
    let distance = light[2u * ray_ix + 1u].x;
    let at = pixel_at(march.first_ray + ray_ix, view.size_px);
    let pixel_ix = at.x + view.size_px.x * at.y;
    let pixel = ray_of_pixel(at);
    let coverage = 1.0 - transmittance;
    // Samples after the last selected sample have the color of that sample.
    let pending = light[2u * ray_ix + 1u].y;
    if pending < 0.5 * coverage { rgb *= coverage / (coverage - pending); }
    let depth_m = distance / max(coverage, MIN_COVERAGE) / length(pixel.along) * backdrop.radius_m;
    pixels[pixel_ix] = pack4x8unorm(vec4f(rgb + transmittance * backdrop.srgb, coverage));
    depths[pixel_ix] = select(0.0, depth_m, coverage >= MIN_COVERAGE);
}
