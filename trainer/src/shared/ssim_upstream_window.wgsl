// ssim_upstream: gradient of the structural similarity with respect to a pixel's color. A workgroup processes a tile.

var<workgroup> wg_gradients: array<vec4f, 676>;
var<workgroup> wg_rows: array<vec4f, 416>;

// Every lane must call it.
fn ssim_upstream(lane: u32, corner: vec2i, at: u32, picture: vec3f, expected: vec3f) -> vec3f {
    let size = vec2i(view.size_px);
    let n_pixels = view.size_px.x * view.size_px.y;
    let gaussian = GAUSSIAN;
    var v_color: vec3f;
    for (var channel = 0u; channel < 3u; channel++) {
        let plane = channel * 3u * n_pixels;
        for (var i = lane; i < SPAN * SPAN; i += 256u) {
            let neighbor = corner + vec2i(vec2u(i % SPAN, i / SPAN)) - i32(HALO);
            var gradient = vec4f(0.0);
            if all(neighbor >= vec2i(0)) && all(neighbor < size) {
                let source = plane + u32(neighbor.y * size.x + neighbor.x);
                gradient = vec4f(ssim_gradients[source], ssim_gradients[source + n_pixels], ssim_gradients[source + 2u * n_pixels], 0.0);
            }
            wg_gradients[i] = gradient;
        }
        workgroupBarrier(); // The window's gradients are written.
        for (var i = lane; i < SPAN * TILE_PX; i += 256u) {
            let from_ = (i / TILE_PX) * SPAN + i % TILE_PX;
            var sum = vec4f(0.0);
            for (var k = 0u; k < WINDOW; k++) { sum += gaussian[k] * wg_gradients[from_ + k]; }
            wg_rows[i] = sum;
        }
        workgroupBarrier(); // The rows are written. The next channel overwrites them only after its own first barrier.
        var sum = vec4f(0.0);
        for (var k = 0u; k < WINDOW; k++) { sum += gaussian[k] * wg_rows[lane + k * TILE_PX]; }
        v_color[channel] = sum.x + 2.0 * picture[channel] * sum.y + expected[channel] * sum.z;
    }
    return v_color;
}
