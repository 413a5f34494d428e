// backward_strips: what `backward` does, on adapters whose lanes read memory one after the other.
//
// threads   a workgroup of 8 per bucket of 32 intersections (see `strips`); a lane owns four of them
// reads     as `backward`
// writes    gradients [n_isect]: every slot by its only owner
// twin      splat/reference/rasterize.rs
// source    as `backward`
//
// Strip after strip, the pixels' state stays in their lanes while the bucket's splats pass in order; each splat's
// gradient is summed over the strip's pixels by shuffles and kept by its owner.

#import view
#import model
#import projection
#import strips
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

const BUCKET = 32u;

// The lane's pixels of the strip at hand.
struct Pixels {
    center_x: Px,
    center_y: f32,
    top: f32,          // centre of the strip's first row
    v_red: Px,
    v_green: Px,
    v_blue: Px,
    v_depth: Px,
    error: Px,
    last: PxU,
    past_last: u32,    // the largest `last` of the strip
    transmittance: Px, // in front of the splat at hand
    behind: Px,        // what lies behind it, times its gradient
}

// Eight of the bucket's splats, one a lane, and the sum of their gradients so far.
struct Owned {
    rank: u32,         // within the tile
    place: vec4f,
    conic: vec4f,
    color: vec4f,
    v_place: vec4f,    // x, y still before the product with the conic
    v_conic: vec4f,
    v_color: vec4f,
}

fn owned_splat(rank: u32, n_in_tile: u32, begin: u32) -> Owned {
    var own: Owned;
    own.rank = rank;
    own.conic.w = -1.0; // Reaches nothing.
    if rank < n_in_tile {
        let splat = drawn[sorted_splats[begin + rank]];
        own.place = splat.place;
        own.conic = splat.conic;
        own.color = splat.color;
    }
    return own;
}

// Lets eight splats pass the strip's pixels, in order.
fn pass_strip(lane: u32, own: ptr<function, Owned>, pixels: ptr<function, Pixels>) {
    let place = (*own).place;
    let conic = (*own).conic;
    let color = (*own).color;
    let first = (*own).rank - lane;
    let reaches = (*own).rank < (*pixels).past_last && reaches_strip(place, conic, (*pixels).top);
    var reaching = or_of_lanes(select(0u, 1u << lane, conic.w >= 0.0 && reaches));
    loop {
        let some = reaching != 0u; // The loop's body runs at least once.
        let i = firstTrailingBit(reaching) & 7u;
        reaching &= reaching - 1u;
        let at = subgroupShuffle(place, i);
        let shape = subgroupShuffle(conic, i);
        let shade = subgroupShuffle(color, i);
        let dx = at.x - (*pixels).center_x;
        let dy = at.y - (*pixels).center_y;
        let power = 0.5 * (shape.x * dx * dx + shape.z * dy * dy) + shape.y * dy * dx;
        let hit = (PxU(first + i) < (*pixels).last) & (power >= Px(0.0)) & (power <= Px(0.5 * shape.w)) & PxB(some);
        let falloff = select(Px(0.0), exp(-power), hit);
        let unclamped = at.w * falloff;
        let alpha = min(Px(MAX_ALPHA), unclamped);
        let weight = alpha * (*pixels).transmittance;
        let value = shade.x * (*pixels).v_red + shade.y * (*pixels).v_green + shade.z * (*pixels).v_blue + at.z * (*pixels).v_depth;
        let behind = (*pixels).behind - weight * value;
        let v_alpha = (*pixels).transmittance * value - behind / (1.0 - alpha);
        let v_free = select(v_alpha, Px(0.0), unclamped > Px(MAX_ALPHA));
        let v_power = -alpha * v_free;
        (*pixels).transmittance *= 1.0 - alpha;
        (*pixels).behind = behind;
        let one = Px(1.0);
        let v_place = sum_of_lanes(vec4f(
            dot(v_power * dx, one), dot(v_power, one) * dy, dot(weight * (*pixels).v_depth, one), dot(falloff * v_free, one)));
        let v_conic = sum_of_lanes(vec4f(
            dot(v_power * dx * dx, one), dot(v_power * dx, one) * dy, dot(v_power, one) * dy * dy, dot(weight * (*pixels).error, one)));
        let v_color = sum_of_lanes(vec4f(
            dot(weight * (*pixels).v_red, one), dot(weight * (*pixels).v_green, one), dot(weight * (*pixels).v_blue, one), 0.0));
        let mine = select(0.0, 1.0, some && lane == i);
        (*own).v_place += mine * v_place;
        (*own).v_conic += mine * v_conic;
        (*own).v_color += mine * v_color;
        continuing {
            break if reaching == 0u;
        }
    }
}

fn hand_in(own: Owned, n_in_tile: u32, begin: u32) {
    if own.rank < n_in_tile {
        let moved = own.v_place.xy;
        gradients[slots[begin + own.rank]] = Gradient(
            vec4f(own.conic.x * moved.x + own.conic.y * moved.y, own.conic.y * moved.x + own.conic.z * moved.y, own.v_place.zw),
            vec4f(0.5 * own.v_conic.x, own.v_conic.y, 0.5 * own.v_conic.z, own.v_conic.w),
            own.v_color,
        );
    }
}

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(subgroup_invocation_id) lane: u32) {
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
    // Four by name and not an array: the compiler then keeps them out of memory that is read lane after lane.
    var a = owned_splat(first + lane, n_in_tile, begin);
    var b = owned_splat(first + lane + LANES, n_in_tile, begin);
    var c = owned_splat(first + lane + 2u * LANES, n_in_tile, begin);
    var d = owned_splat(first + lane + 3u * LANES, n_in_tile, begin);
    for (var strip = 0u; strip < N_STRIPS && reached; strip++) {
        let in_tile = strip_px(strip, lane);
        let place = corner + in_tile;
        var pixels: Pixels;
        pixels.center_x = f32(place.x) + 0.5 + RAMP;
        pixels.center_y = f32(place.y) + 0.5;
        pixels.top = f32(corner.y + strip * 2u) + 0.5;
        let state_at = bucket * 256u + in_tile.y * TILE_PX + in_tile.x;
        for (var k = 0u; k < PX; k++) {
            if place.x + k < view.size_px.x && place.y < view.size_px.y {
                let at = place.y * view.size_px.x + place.x + k;
                let front = bucket_color[state_at + k];
                let slope = upstream[at];
                let end = rest[at];
                pixels.v_red[k] = slope.x;
                pixels.v_green[k] = slope.y;
                pixels.v_blue[k] = slope.z;
                pixels.v_depth[k] = slope.w;
                pixels.error[k] = end.y;
                pixels.last[k] = last[at];
                pixels.transmittance[k] = front.w;
                pixels.behind[k] = end.x - dot(front.rgb, slope.rgb) - bucket_depth[state_at + k] * slope.w;
            }
        }
        pixels.past_last = max_of_lanes(max(max(pixels.last.x, pixels.last.y), max(pixels.last.z, pixels.last.w)));
        pass_strip(lane, &a, &pixels);
        pass_strip(lane, &b, &pixels);
        pass_strip(lane, &c, &pixels);
        pass_strip(lane, &d, &pixels);
    }
    hand_in(a, n_in_tile, begin);
    hand_in(b, n_in_tile, begin);
    hand_in(c, n_in_tile, begin);
    hand_in(d, n_in_tile, begin);
}
