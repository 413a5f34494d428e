// ssim_strips: variant of `ssim` for adapters whose lanes access memory one after another.
//
// threads   8 per color and two vertically adjacent tiles of 16 x 16 pixels (see `rows_and_columns`)
// reads     same as `ssim`
// writes    same as `ssim`
// twin      loss/reference.rs
// source    same as `ssim`

#import ssim_bindings
#import rows_and_columns

alias Value = vec4f;       // 4 pixels per lane

// Picture and keyframe, 0 outside the image and in masked areas.
fn pair_at(pixel: vec2i, channel: u32, background: f32) -> vec2f {
    if any(pixel < vec2i(0)) || any(pixel >= vec2i(view.size_px)) { return vec2f(0.0); }
    let at = u32(pixel.y) * view.size_px.x + u32(pixel.x);
    let packed = target_image[at];
    if packed < 0x01000000u { return vec2f(0.0); }
    return vec2f(gains[channel] * (image[at][channel] + image[at].w * background), rgb_of(packed)[channel]);
}

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(subgroup_invocation_id) lane: u32) {
    let strip = color_strip(folded(wg, n_wgs), lane, view.n_tiles);
    let size = vec2i(view.size_px);
    let n_pixels = view.size_px.x * view.size_px.y;
    let background = background_at(supervision, status[STEP])[strip.channel];
    var of_x: Windows;
    var of_y: Windows;
    var of_xx: Windows;
    var of_yy: Windows;
    var of_xy: Windows;
    for (var row = 0u; row < N_ROWS && strip.in_grid; row++) {
        let first = strip.corner + vec2i(0, i32(row));
        let a = pair_at(first, strip.channel, background);
        let b = pair_at(first + vec2i(1, 0), strip.channel, background);
        let c = pair_at(first + vec2i(2, 0), strip.channel, background);
        let d = pair_at(first + vec2i(3, 0), strip.channel, background);
        let x = vec4f(a.x, b.x, c.x, d.x);
        let y = vec4f(a.y, b.y, c.y, d.y);
        let gradients = similarity_gradients(
            along_row(lane, add_row(&of_x, x)),
            along_row(lane, add_row(&of_y, y)),
            along_row(lane, add_row(&of_xx, x * x)),
            along_row(lane, add_row(&of_yy, y * y)),
            along_row(lane, add_row(&of_xy, x * y)),
        );
        let middle = first - vec2i(0, i32(HALO));
        if !strip.writes || row < 2u * HALO || middle.y >= size.y { continue; }
        let at = 3u * strip.channel * n_pixels + u32(middle.y * size.x + middle.x);
        for (var k = 0u; k < 4u; k++) {
            if middle.x + i32(k) >= size.x { continue; }
            ssim_gradients[at + k] = gradients.of_mean[k];
            ssim_gradients[at + k + n_pixels] = gradients.of_square[k];
            ssim_gradients[at + k + 2u * n_pixels] = gradients.of_product[k];
        }
    }
}
