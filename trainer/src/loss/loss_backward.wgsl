// loss_backward: compute the gradient of the loss with respect to every pixel's color, transmittance and depth.
//
// threads   one per pixel, a workgroup per 16 x 16 pixels
// reads     view, supervision, gains (applied to the picture before the comparison), status, image, depth [n_pixels]
//           (premultiplied), target_image, target_depth [n_pixels] (meters, 0: none), ssim_gradients
// writes    upstream [n_pixels] (v of rgb; w: v of depth), pixel_totals [n_pixels] (see backward.wgsl; y: absolute error),
//           gain_sums [n_tiles] (gradient with respect to the logarithms of the gains; w: sum of the absolute errors)
// twin      loss/reference.rs

#import view
#import supervision
#import status

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> supervision: Supervision;
@group(0) @binding(2) var<storage, read> status: array<u32>;
@group(0) @binding(3) var<storage, read> image: array<vec4f>;
@group(0) @binding(4) var<storage, read> depth: array<f32>;
@group(0) @binding(5) var<storage, read> target_image: array<u32>;
@group(0) @binding(6) var<storage, read> target_depth: array<f32>;
@group(0) @binding(7) var<storage, read> ssim_gradients: array<f32>;
@group(0) @binding(8) var<storage, read_write> upstream: array<vec4f>;
@group(0) @binding(9) var<storage, read_write> pixel_totals: array<vec2f>;
@group(0) @binding(10) var<storage, read_write> gain_sums: array<vec4f>;
@group(0) @binding(11) var<storage, read> gains: vec4f;

override SSIM: bool = true;
override DEPTH: bool = true;
var<workgroup> wg_gains: array<vec4f, 256>;

#import ssim_upstream

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let tile = folded(wg, n_wgs);
    let in_grid = tile < view.n_tiles.x * view.n_tiles.y;
    let corner = vec2i(vec2u(tile % view.n_tiles.x, tile / view.n_tiles.x) * TILE_PX);
    let n_pixels = view.size_px.x * view.size_px.y;
    let pixel = vec2u(corner) + vec2u(lane % TILE_PX, lane / TILE_PX);
    let on_image = in_grid && pixel.x < view.size_px.x && pixel.y < view.size_px.y;
    let at = min(pixel.y * view.size_px.x + pixel.x, n_pixels - 1u);
    let packed = target_image[at];
    let color = image[at];
    let visible = on_image && packed >= 0x01000000u;
    let background = background_at(supervision, status[STEP]);
    let picture = gains.rgb * (color.rgb + color.w * background);
    let expected = rgb_of(packed);
    let per_value = 1.0 / (3.0 * f32(n_pixels));
    var v_color = (1.0 - supervision.dssim_frac) * per_value * sign(picture - expected);
    if SSIM {
        v_color -= supervision.dssim_frac * per_value * ssim_upstream(lane, corner, at, picture, expected);
    }
    var error = 0.0;
    if visible { error = dot(abs(picture - expected), vec3f(1.0 / 3.0)); } else { v_color = vec3f(0.0); }
    let v_log_gain = v_color * picture;
    v_color *= gains.rgb;
    var v_transmittance = dot(v_color, background);
    var v_depth = 0.0;
    let depth_sum = depth[at];
    if DEPTH && on_image {
        let expected_m = target_depth[at];
        let residual_m = depth_sum - (1.0 - color.w) * expected_m;
        if expected_m > 0.0 && abs(residual_m) < supervision.depth_clip_m {
            v_depth = supervision.depth_weight / f32(n_pixels) * sign(residual_m);
            v_transmittance += v_depth * expected_m;
        }
    }
    if on_image {
        upstream[at] = vec4f(v_color, v_depth);
        pixel_totals[at] = vec2f(dot(color.rgb, v_color) + depth_sum * v_depth + color.w * v_transmittance, error);
    }
    wg_gains[lane] = vec4f(v_log_gain, error);
    workgroupBarrier(); // All values are written.
    if lane < 16u {
        var sum = vec4f(0.0);
        for (var i = 0u; i < 16u; i++) { sum += wg_gains[lane * 16u + i]; }
        wg_gains[lane * 16u] = sum; // Each lane writes only the first of the values that it has read.
    }
    workgroupBarrier(); // All 16 partial sums are written.
    if lane == 0u && in_grid {
        var sum = vec4f(0.0);
        for (var i = 0u; i < 16u; i++) { sum += wg_gains[i * 16u]; }
        gain_sums[tile] = sum;
    }
}
