// ssim_upstream_strips: compute the gradient of the structural similarity with respect to every pixel's color, before
// `loss_backward`, for adapters whose lanes access memory one after another.
//
// threads   8 per color and two vertically adjacent tiles of 16 x 16 pixels (see `rows_and_columns`)
// reads     view, supervision, gains, status, image, target_image, ssim_gradients, same as `loss_backward`
// writes    upstream [n_pixels]: rgb
// twin      loss/reference.rs

#import view
#import supervision
#import status
#import rows_and_columns

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> supervision: Supervision;
@group(0) @binding(2) var<storage, read> status: array<u32>;
@group(0) @binding(3) var<storage, read> image: array<vec4f>;
@group(0) @binding(4) var<storage, read> target_image: array<u32>;
@group(0) @binding(5) var<storage, read> ssim_gradients: array<f32>;
@group(0) @binding(6) var<storage, read> gains: vec4f;
@group(0) @binding(7) var<storage, read_write> upstream: array<vec4f>;

fn gradients_at(pixel: vec2i, channel: u32) -> vec3f {
    if any(pixel < vec2i(0)) || any(pixel >= vec2i(view.size_px)) { return vec3f(0.0); }
    let n_pixels = view.size_px.x * view.size_px.y;
    let at = 3u * channel * n_pixels + u32(pixel.y) * view.size_px.x + u32(pixel.x);
    return vec3f(ssim_gradients[at], ssim_gradients[at + n_pixels], ssim_gradients[at + 2u * n_pixels]);
}

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(subgroup_invocation_id) lane: u32) {
    let strip = color_strip(folded(wg, n_wgs), lane, view.n_tiles);
    let size = vec2i(view.size_px);
    let background = background_at(supervision, status[STEP])[strip.channel];
    var of_means: Windows;
    var of_squares: Windows;
    var of_products: Windows;
    for (var row = 0u; row < N_ROWS && strip.in_grid; row++) {
        let first = strip.corner + vec2i(0, i32(row));
        let a = gradients_at(first, strip.channel);
        let b = gradients_at(first + vec2i(1, 0), strip.channel);
        let c = gradients_at(first + vec2i(2, 0), strip.channel);
        let d = gradients_at(first + vec2i(3, 0), strip.channel);
        let of_mean = along_row(lane, add_row(&of_means, vec4f(a.x, b.x, c.x, d.x)));
        let of_square = along_row(lane, add_row(&of_squares, vec4f(a.y, b.y, c.y, d.y)));
        let of_product = along_row(lane, add_row(&of_products, vec4f(a.z, b.z, c.z, d.z)));
        let middle = first - vec2i(0, i32(HALO));
        if !strip.writes || row < 2u * HALO || middle.y >= size.y { continue; }
        let at = u32(middle.y * size.x + middle.x);
        for (var k = 0u; k < 4u; k++) {
            if middle.x + i32(k) >= size.x { continue; }
            let picture = gains[strip.channel] * (image[at + k][strip.channel] + image[at + k].w * background);
            let expected = rgb_of(target_image[at + k])[strip.channel];
            upstream[at + k][strip.channel] = of_mean[k] + 2.0 * picture * of_square[k] + expected * of_product[k];
        }
    }
}
