// show_rays: composites one more round of samples into the pixels of rays, and marks rays that are finished.
//
// threads   one per ray
// reads     batch, march (first_ray: the first pixel; max_found: samples per round), view, backdrop, spans, log_density
//           [n_samples], colors [n_samples]
// writes    rays (is_finished), light [n_rays, 2] (rgb and transmittance; distance), pixels [n_pixels] (rgba8; a:
//           coverage), depths [n_pixels] (meters along z, weighted mean; 0 for pixels without coverage)
// twin      nerf/reference/ray.rs

#import view
#import picture_ray
#import ray_batch
#import march_params
#import density
#import sample

struct Backdrop {
    srgb: vec3f,
    radius_m: f32,         // of the scene: meters per unit
}

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<uniform> march: March;
@group(0) @binding(2) var<uniform> view: View;
@group(0) @binding(3) var<uniform> backdrop: Backdrop;
@group(0) @binding(4) var<storage, read_write> rays: array<Ray>;
@group(0) @binding(5) var<storage, read> spans: array<Span>;
@group(0) @binding(6) var<storage, read> log_density: array<f32>;
@group(0) @binding(7) var<storage, read> colors: array<vec4f>;
@group(0) @binding(8) var<storage, read_write> pixels: array<u32>;
@group(0) @binding(9) var<storage, read_write> depths: array<f32>;
@group(0) @binding(10) var<storage, read_write> light: array<vec4f>;

const MIN_COVERAGE = 1e-3;
// Rays with less transmittance are finished. This is half of the smallest difference between 8-bit colors.
const MIN_TRANSMITTANCE = 1.0 / 512.0;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ray_ix = folded(wg, n_wgs) * 64u + lane;
    if ray_ix >= batch.n_rays { return; }
    let ray = rays[ray_ix];
    if ray.is_finished == 1u { return; }
    var rgb = light[2u * ray_ix].rgb;
    var transmittance = light[2u * ray_ix].a;
    var distance = light[2u * ray_ix + 1u].x;
    let end = ray.first_sample + ray.n_samples;
    for (var ix = ray.first_sample; ix < end; ix++) {
        let sample = sample_at(ix);
        let weight = transmittance * (1.0 - sample.transmitted);
        rgb += weight * sample.rgb;
        distance += weight * 0.5 * (sample.begin + sample.end);
        transmittance *= sample.transmitted;
    }
    light[2u * ray_ix] = vec4f(rgb, transmittance);
    light[2u * ray_ix + 1u] = vec4f(distance, 0.0, 0.0, 0.0);
    let is_unfinished = ray.n_samples == march.max_found && transmittance > MIN_TRANSMITTANCE;
    if !is_unfinished { rays[ray_ix].is_finished = 1u; }
    let pixel_ix = march.first_ray + ray_ix;
    let pixel = ray_of_pixel(vec2u(pixel_ix % view.size_px.x, pixel_ix / view.size_px.x));
    let coverage = 1.0 - transmittance;
    let depth_m = distance / max(coverage, MIN_COVERAGE) / length(pixel.along) * backdrop.radius_m;
    pixels[pixel_ix] = pack4x8unorm(vec4f(rgb + transmittance * backdrop.srgb, coverage));
    depths[pixel_ix] = select(0.0, depth_m, coverage >= MIN_COVERAGE);
}
