// backward: the gradient of every intersection, one lane a splat, handing each pixel's state to the next splat's lane.
//
// threads   LANES per bucket of 32 intersections, taken LANES at a time
// reads     view, status, tile_ranges, bucket_starts, bucket_tiles, tile_last, sorted_splats, slots, drawn,
//           bucket_color, bucket_depth, upstream [n_pixels] (gradient of rgb and depth), rest [n_pixels] (see below), last
// writes    gradients [n_isect]: every slot by its only owner
// twin      splat/reference/rasterize.rs
// source    Mallick et al. 2024 (Taming 3DGS), section 4; Kerbl et al. 2023, appendix A
//
// rest = color . v_color + depth v_depth + transmittance v_transmittance of the finished pixel: what lies behind a splat is
// that minus what lies in front, so one number a pixel travels from lane to lane beside the transmittance.
// Lane l works on pixel i - l in round i. The state comes from lane l - 1 by SHUFFLE.

#import view
#import model
#import projection
#import status

struct Gradient {
    place: vec4f,      // mean_px.xy, depth, opacity
    conic: vec4f,      // A, B, C; w: absolute error seen, weighted by contribution
    color: vec4f,      // rgb; w: contribution, summed over pixels
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> status: array<u32>;
@group(0) @binding(2) var<storage, read> tile_ranges: array<vec2u>;
@group(0) @binding(3) var<storage, read> bucket_starts: array<u32>;
@group(0) @binding(4) var<storage, read> bucket_tiles: array<u32>;
@group(0) @binding(5) var<storage, read> tile_last: array<u32>;
@group(0) @binding(6) var<storage, read> sorted_splats: array<u32>;
@group(0) @binding(7) var<storage, read> slots: array<u32>;
@group(0) @binding(8) var<storage, read> drawn: array<Drawn>;
@group(0) @binding(9) var<storage, read> bucket_color: array<vec4f>;
@group(0) @binding(10) var<storage, read> bucket_depth: array<f32>;
@group(0) @binding(11) var<storage, read> upstream: array<vec4f>;
@group(0) @binding(12) var<storage, read> rest: array<vec2f>;
@group(0) @binding(13) var<storage, read> last: array<u32>;
@group(0) @binding(14) var<storage, read_write> gradients: array<Gradient>;

override LANES = 32u;
const BUCKET = 32u;
var<workgroup> wg_upstream: array<vec4f, 256>;
var<workgroup> wg_state: array<vec2f, 256>;   // transmittance in front, rest still behind
var<workgroup> wg_error: array<f32, 256>;
var<workgroup> wg_last: array<u32, 256>;
#import handover

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let bucket = folded(wg, n_wgs);
    var n_in_tile = 0u;
    var first = 0u;
    var tile = 0u;
    var past_last = 0u;
    if bucket < status[N_BUCKETS] && status[FAILED] == 0u {
        tile = bucket_tiles[bucket];
        let range = tile_ranges[tile];
        first = (bucket - bucket_starts[tile]) * BUCKET;
        n_in_tile = range.y - range.x;
        past_last = tile_last[tile];
    }
    let range_begin = tile_ranges[tile].x;
    let reached = first < past_last;
    let corner = vec2u(tile % view.n_tiles.x, tile / view.n_tiles.x) * TILE_PX;
    for (var i = lane; i < 256u; i += LANES) {
        let pixel = corner + vec2u(i % TILE_PX, i / TILE_PX);
        wg_last[i] = 0u;
        if reached && pixel.x < view.size_px.x && pixel.y < view.size_px.y {
            let at = pixel.y * view.size_px.x + pixel.x;
            let front = bucket_color[bucket * 256u + i];
            let slope = upstream[at];
            wg_upstream[i] = slope;
            wg_state[i] = vec2f(front.w, rest[at].x - dot(front.rgb, slope.rgb) - bucket_depth[bucket * 256u + i] * slope.w);
            wg_error[i] = rest[at].y;
            wg_last[i] = last[at];
        }
    }
    workgroupBarrier(); // The tile's pixels are there.

    for (var part = 0u; part < BUCKET; part += LANES) {
        let rank = first + part + lane;   // of this lane's splat within the tile
        let owned = rank < n_in_tile;
        var splat: Drawn;
        if owned { splat = drawn[sorted_splats[range_begin + rank]]; }
        var gradient: Gradient;
        var state = vec2f(0.0);
        for (var round = 0u; round < 255u + LANES; round++) {
            state = handed_over(lane, round, state);
            let i = round - lane; // Wraps past 256 before the lane's first pixel.
            if i < 256u {
                if lane == 0u { state = wg_state[i]; }
                if owned && rank < wg_last[i] {
                    let center_px = vec2f(corner + vec2u(i % TILE_PX, i / TILE_PX)) + 0.5;
                    let offset = splat.place.xy - center_px;
                    let power = 0.5 * (splat.conic.x * offset.x * offset.x + splat.conic.z * offset.y * offset.y) + splat.conic.y * offset.x * offset.y;
                    let falloff = exp(-power);
                    let unclamped = splat.place.w * falloff;
                    let alpha = min(MAX_ALPHA, unclamped);
                    if power >= 0.0 && alpha >= MIN_ALPHA {
                        let slope = wg_upstream[i];
                        let weight = alpha * state.x;
                        let value = dot(splat.color.rgb, slope.rgb) + splat.place.z * slope.w;
                        let behind = state.y - weight * value;
                        let v_alpha = state.x * value - behind / (1.0 - alpha);
                        gradient.color += weight * vec4f(slope.rgb, 1.0);
                        gradient.place.z += weight * slope.w;
                        gradient.conic.w += weight * wg_error[i];
                        if unclamped <= MAX_ALPHA {
                            let v_power = -alpha * v_alpha;
                            gradient.place.w += falloff * v_alpha;
                            gradient.conic += v_power * vec4f(0.5 * offset.x * offset.x, offset.x * offset.y, 0.5 * offset.y * offset.y, 0.0);
                            gradient.place.x += v_power * (splat.conic.x * offset.x + splat.conic.y * offset.y);
                            gradient.place.y += v_power * (splat.conic.y * offset.x + splat.conic.z * offset.y);
                        }
                        state = vec2f(state.x * (1.0 - alpha), behind);
                    }
                }
                if lane == LANES - 1u { wg_state[i] = state; }
            }
        }
        if owned { gradients[slots[range_begin + rank]] = gradient; }
        workgroupBarrier(); // The states behind this part are there for the next.
    }
}
