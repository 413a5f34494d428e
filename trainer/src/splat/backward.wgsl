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
// In round i lane l works on group i - l of PX pixels; the state comes from lane l - 1 (`handover`).

#import view
#import model
#import projection
#import pixels
#import status
#import gradient

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
const GROUPS = 256u / PX;
const GROUPS_PER_ROW = TILE_PX / PX;

struct Pixels {
    v_red: Px,
    v_green: Px,
    v_blue: Px,
    v_depth: Px,
    error: Px,
    last: PxU,
}

var<workgroup> wg_pixels: array<Pixels, GROUPS>;
#import handover
var<workgroup> wg_states: array<State, GROUPS>;

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let bucket = folded(wg, n_wgs);
    var n_in_tile = 0u;
    var first = 0u;
    var tile = 0u;
    var past_last = 0u;
    var begin = 0u;
    if bucket < status[N_BUCKETS] && status[FAILED] == 0u {
        tile = bucket_tiles[bucket];
        let range = tile_ranges[tile];
        begin = range.x;
        first = (bucket - bucket_starts[tile]) * BUCKET;
        n_in_tile = range.y - range.x;
        past_last = tile_last[tile];
    }
    let reached = first < past_last;
    let corner = vec2u(tile % view.n_tiles.x, tile / view.n_tiles.x) * TILE_PX;
    for (var group = lane; group < GROUPS; group += LANES) {
        var pixels: Pixels;
        var state: State;
        let place = corner + vec2u((group % GROUPS_PER_ROW) * PX, group / GROUPS_PER_ROW);
        for (var k = 0u; k < PX; k++) {
            if reached && place.x + k < view.size_px.x && place.y < view.size_px.y {
                let at = place.y * view.size_px.x + place.x + k;
                let front = bucket_color[bucket * 256u + group * PX + k];
                let slope = upstream[at];
                let end = rest[at];
                pixels.v_red[k] = slope.x;
                pixels.v_green[k] = slope.y;
                pixels.v_blue[k] = slope.z;
                pixels.v_depth[k] = slope.w;
                pixels.error[k] = end.y;
                pixels.last[k] = last[at];
                state.transmittance[k] = front.w;
                state.behind[k] = end.x - dot(front.rgb, slope.rgb) - bucket_depth[bucket * 256u + group * PX + k] * slope.w;
            }
        }
        wg_pixels[group] = pixels;
        wg_states[group] = state;
    }
    workgroupBarrier(); // The tile's pixels are there.

    for (var part = 0u; part < BUCKET; part += LANES) {
        let rank = first + part + lane;   // of this lane's splat within the tile
        let owned = rank < n_in_tile;
        var place = vec4f(0.0);
        var conic = vec4f(0.0, 0.0, 0.0, -1.0); // Reaches nothing.
        var color = vec3f(0.0);
        if owned && reached {
            let splat = drawn[sorted_splats[begin + rank]];
            place = splat.place;
            conic = splat.conic;
            color = splat.color.rgb;
        }
        var v_x = Px(0.0);
        var v_y = Px(0.0);
        var v_z = Px(0.0);
        var v_opacity = Px(0.0);
        var v_a = Px(0.0);
        var v_b = Px(0.0);
        var v_c = Px(0.0);
        var v_red = Px(0.0);
        var v_green = Px(0.0);
        var v_blue = Px(0.0);
        var error = Px(0.0);
        var state: State;
        if reached { // The same for all lanes of the workgroup.
            for (var round = 0u; round < GROUPS + LANES - 1u; round++) {
                state = handed_over(lane, round, state);
                let group = round - lane; // Wraps past GROUPS before the lane's first group.
                if group < GROUPS {
                    if lane == 0u { state = wg_states[group]; }
                    let corner_px = vec2f(corner + vec2u((group % GROUPS_PER_ROW) * PX, group / GROUPS_PER_ROW)) + 0.5;
                    let dx = place.x - corner_px.x - RAMP;
                    let dy = place.y - corner_px.y;
                    let power = 0.5 * (conic.x * dx * dx + conic.z * dy * dy) + conic.y * dy * dx;
                    let hit = (PxU(rank) < wg_pixels[group].last) & (power >= Px(0.0)) & (power <= Px(0.5 * conic.w));
                    if any(hit) {
                        let falloff = select(Px(0.0), exp(-power), hit);
                        let unclamped = place.w * falloff;
                        let alpha = min(Px(MAX_ALPHA), unclamped);
                        let weight = alpha * state.transmittance;
                        let value = color.x * wg_pixels[group].v_red + color.y * wg_pixels[group].v_green + color.z * wg_pixels[group].v_blue + place.z * wg_pixels[group].v_depth;
                        let behind = state.behind - weight * value;
                        let v_alpha = state.transmittance * value - behind / (1.0 - alpha);
                        v_red += weight * wg_pixels[group].v_red;
                        v_green += weight * wg_pixels[group].v_green;
                        v_blue += weight * wg_pixels[group].v_blue;
                        v_z += weight * wg_pixels[group].v_depth;
                        error += weight * wg_pixels[group].error;
                        let v_free = select(v_alpha, Px(0.0), unclamped > Px(MAX_ALPHA));
                        let v_power = -alpha * v_free;
                        v_opacity += falloff * v_free;
                        v_a += v_power * dx * dx;
                        v_b += v_power * dx * dy;
                        v_c += v_power * dy * dy;
                        v_x += v_power * dx;
                        v_y += v_power * dy;
                        state = State(state.transmittance * (1.0 - alpha), behind);
                    }
                    if LANES < BUCKET && lane == LANES - 1u { wg_states[group] = state; }
                }
            }
        }
        if owned {
            let x = dot(v_x, Px(1.0));
            let y = dot(v_y, Px(1.0));
            gradients[slots[begin + rank]] = Gradient(
                vec4f(conic.x * x + conic.y * y, conic.y * x + conic.z * y, dot(v_z, Px(1.0)), dot(v_opacity, Px(1.0))),
                vec4f(0.5 * dot(v_a, Px(1.0)), dot(v_b, Px(1.0)), 0.5 * dot(v_c, Px(1.0)), dot(error, Px(1.0))),
                vec4f(dot(v_red, Px(1.0)), dot(v_green, Px(1.0)), dot(v_blue, Px(1.0)), 0.0),
            );
        }
        workgroupBarrier(); // The states behind this part are there for the next.
    }
}
