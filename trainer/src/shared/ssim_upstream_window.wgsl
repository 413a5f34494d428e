// ssim_upstream: the slope of the structural similarity towards a pixel's color, for a workgroup of a tile.

var<workgroup> wg_slopes: array<vec4f, 676>;
var<workgroup> wg_rows: array<vec4f, 416>;

// Every lane must call it.
fn ssim_upstream(lane: u32, corner: vec2i, at: u32, picture: vec3f, wanted: vec3f) -> vec3f {
    let size = vec2i(view.size_px);
    let n_pixels = view.size_px.x * view.size_px.y;
    let gaussian = GAUSSIAN;
    var v_color: vec3f;
    for (var channel = 0u; channel < 3u; channel++) {
        let plane = channel * 3u * n_pixels;
        for (var i = lane; i < SPAN * SPAN; i += 256u) {
            let near = corner + vec2i(vec2u(i % SPAN, i / SPAN)) - i32(HALO);
            var slope = vec4f(0.0);
            if all(near >= vec2i(0)) && all(near < size) {
                let source = plane + u32(near.y * size.x + near.x);
                slope = vec4f(slopes[source], slopes[source + n_pixels], slopes[source + 2u * n_pixels], 0.0);
            }
            wg_slopes[i] = slope;
        }
        workgroupBarrier(); // The window's slopes are there.
        for (var i = lane; i < SPAN * TILE_PX; i += 256u) {
            let from_ = (i / TILE_PX) * SPAN + i % TILE_PX;
            var sum = vec4f(0.0);
            for (var k = 0u; k < WINDOW; k++) { sum += gaussian[k] * wg_slopes[from_ + k]; }
            wg_rows[i] = sum;
        }
        workgroupBarrier(); // The rows are there; the next channel writes them only after its own first barrier.
        var sum = vec4f(0.0);
        for (var k = 0u; k < WINDOW; k++) { sum += gaussian[k] * wg_rows[lane + k * TILE_PX]; }
        v_color[channel] = sum.x + 2.0 * picture[channel] * sum.y + wanted[channel] * sum.z;
    }
    return v_color;
}
