// ssim: compute the gradients of the structural similarity of picture and keyframe with respect to the window
// statistics.
//
// threads   one per pixel, a workgroup per 16 x 16 pixels
// reads     view, supervision, gains, status, image [n_pixels] (premultiplied rgb, transmittance), target_image [n_pixels]
//           (rgba8; a = 0: masked)
// writes    ssim_gradients [3 channels, 3, n_pixels]: with respect to E[x], E[x x], E[x y]
// twin      loss/reference.rs
// source    Wang et al. 2004; Gaussian of 11 pixels, sigma 1.5, zeros outside; one pass over shared memory as in Mallick
//           et al. 2024

#import ssim_bindings

alias Value = f32;         // one pixel per lane

var<workgroup> wg_pair: array<vec2f, 676>;        // picture, keyframe
var<workgroup> wg_means: array<vec4f, 416>;       // along rows: x, y, x x, y y
var<workgroup> wg_products: array<f32, 416>;      // along rows: x y

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let tile = folded(wg, n_wgs);
    let corner = vec2i(vec2u(tile % view.n_tiles.x, tile / view.n_tiles.x) * TILE_PX);
    let size = vec2i(view.size_px);
    let n_pixels = view.size_px.x * view.size_px.y;
    let gaussian = GAUSSIAN;
    let background = background_at(supervision, status[STEP]);
    for (var channel = 0u; channel < 3u; channel++) {
        for (var i = lane; i < SPAN * SPAN; i += 256u) {
            let pixel = corner + vec2i(vec2u(i % SPAN, i / SPAN)) - i32(HALO);
            var pair = vec2f(0.0);
            if all(pixel >= vec2i(0)) && all(pixel < size) {
                let at = u32(pixel.y * size.x + pixel.x);
                let packed = target_image[at];
                let color = image[at];
                if packed >= 0x01000000u {
                    pair = vec2f(gains[channel] * (color[channel] + color.w * background[channel]), rgb_of(packed)[channel]);
                }
            }
            wg_pair[i] = pair;
        }
        workgroupBarrier(); // The window's pixels are written.
        for (var i = lane; i < SPAN * TILE_PX; i += 256u) {
            let at = (i / TILE_PX) * SPAN + i % TILE_PX;
            var means = vec4f(0.0);
            var product = 0.0;
            for (var k = 0u; k < WINDOW; k++) {
                let pair = wg_pair[at + k];
                means += gaussian[k] * vec4f(pair, pair * pair);
                product += gaussian[k] * pair.x * pair.y;
            }
            wg_means[i] = means;
            wg_products[i] = product;
        }
        workgroupBarrier(); // The rows are written. The next channel overwrites them only after its own first barrier.
        let pixel = vec2u(corner) + vec2u(lane % TILE_PX, lane / TILE_PX);
        if pixel.x < view.size_px.x && pixel.y < view.size_px.y {
            var m = vec4f(0.0);
            var product = 0.0;
            for (var k = 0u; k < WINDOW; k++) {
                m += gaussian[k] * wg_means[lane + k * TILE_PX];
                product += gaussian[k] * wg_products[lane + k * TILE_PX];
            }
            let gradients = similarity_gradients(m.x, m.y, m.z, m.w, product);
            let at = channel * 3u * n_pixels + pixel.y * view.size_px.x + pixel.x;
            ssim_gradients[at] = gradients.of_mean;
            ssim_gradients[at + n_pixels] = gradients.of_square;
            ssim_gradients[at + 2u * n_pixels] = gradients.of_product;
        }
    }
}
