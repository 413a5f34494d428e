// finish: write the picture for display: color over the background in 8 bits, and depth in meters.
//
// threads   one per pixel
// reads     view, supervision, image (premultiplied rgb, transmittance), depth (premultiplied)
// writes    pixels [n_pixels] (rgba8; a: coverage), depths [n_pixels] (meters along z; 0 if coverage is at most one half)

#import view
#import supervision

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> supervision: Supervision;
@group(0) @binding(2) var<storage, read> image: array<vec4f>;
@group(0) @binding(3) var<storage, read> depth: array<f32>;
@group(0) @binding(4) var<storage, read_write> pixels: array<u32>;
@group(0) @binding(5) var<storage, read_write> depths: array<f32>;

override WG_SIZE = 256u;
@compute @workgroup_size(WG_SIZE)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = folded(wg, n_wgs) * WG_SIZE + lane;
    if at >= view.size_px.x * view.size_px.y { return; } // Allowed here: no barrier below.
    let color = image[at];
    let rgb = clamp(color.rgb + color.w * supervision.background_srgb.rgb, vec3f(0.0), vec3f(1.0));
    let bytes = vec4u(floor(vec4f(rgb, 1.0 - color.w) * 255.0 + 0.5));
    pixels[at] = bytes.x | (bytes.y << 8u) | (bytes.z << 16u) | (bytes.w << 24u);
    let coverage = 1.0 - color.w;
    depths[at] = select(0.0, depth[at] / max(coverage, 1e-6), coverage > 0.5);
}
