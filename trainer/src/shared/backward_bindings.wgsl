// backward_bindings: bindings and code shared by both variants of `backward`.

#import tile
#import gradient

@group(0) @binding(6) var<storage, read> upstream: array<vec4f>;
@group(0) @binding(7) var<storage, read> pixel_totals: array<vec2f>;
@group(0) @binding(8) var<storage, read> last: array<u32>;
// Each intersection of splat and tile has its own slot, which is written once. `update` sums the slots of a splat in
// order.
@group(0) @binding(9) var<storage, read_write> gradients: array<f32>; // 12 per slot, see `Gradient`

const N_PARTS_OF_GRADIENT = 12u;

// Slot for the gradient of a tile's entry.
fn slot_of(entry: u32, tile: Tile) -> u32 {
    return entries[entry].z + countOneBits(entries[entry].y & ((1u << tile.in_bin) - 1u));
}

fn write_gradient(slot: u32, part: u32, value: f32) {
    gradients[slot * N_PARTS_OF_GRADIENT + part] = value;
}

// Upstream gradients of a lane's pixels, and their compositing state around the current splat.
struct Pixels {
    v_red: Px,
    v_green: Px,
    v_blue: Px,
    v_depth: Px,
    error: Px,
    last: PxU,
    transmittance: Px, // in front of the current splat
    behind: Px,        // color behind the current splat, times its gradient
}

fn pixels_at(tile: Tile, first: vec2u) -> Pixels {
    var out: Pixels;
    out.transmittance = Px(1.0);
    for (var k = 0u; k < PX; k++) {
        if !tile.in_grid || first.x + k >= view.size_px.x || first.y >= view.size_px.y { continue; }
        let at = first.y * view.size_px.x + first.x + k;
        let gradient = upstream[at];
        let totals = pixel_totals[at];
        out.v_red = put(out.v_red, k, gradient.x);
        out.v_green = put(out.v_green, k, gradient.y);
        out.v_blue = put(out.v_blue, k, gradient.z);
        out.v_depth = put(out.v_depth, k, gradient.w);
        out.behind = put(out.behind, k, totals.x);
        out.error = put(out.error, k, totals.y);
        out.last = put_u(out.last, k, last[at]);
    }
    return out;
}

// Contribution of a lane's pixels to the gradient of the current splat. Also composites the splat into the pixels.
//
// The color behind a splat is `pixel_totals` minus the color up to and including the splat, so each pixel carries only
// one number in addition to its transmittance.
fn passed(pixels: ptr<function, Pixels>, hit: PxB, power: Px, dx: Px, dy: f32, splat: ProjectedSplat) -> Gradient {
    let falloff = select(Px(0.0), exp2(-power), hit);
    let unclamped = splat.position.w * falloff;
    let alpha = min(Px(MAX_ALPHA), unclamped);
    let weight = alpha * (*pixels).transmittance;
    let value = splat.color.x * (*pixels).v_red + splat.color.y * (*pixels).v_green + splat.color.z * (*pixels).v_blue + splat.position.z * (*pixels).v_depth;
    let behind = (*pixels).behind - weight * value;
    let v_alpha = (*pixels).transmittance * value - behind / (1.0 - alpha);
    let v_unclamped = select(v_alpha, Px(0.0), unclamped > Px(MAX_ALPHA));
    let v_power = -alpha * v_unclamped;
    (*pixels).transmittance *= 1.0 - alpha;
    (*pixels).behind = behind;
    let one = Px(1.0);
    let v_dx = v_power * dx;
    let v_0 = dot(v_power, one);
    let v_x = dot(v_dx, one);
    return Gradient(
        vec4f(v_x, v_0 * dy, dot(weight, (*pixels).v_depth), dot(falloff, v_unclamped)),
        vec4f(dot(v_dx, dx), v_x * dy, v_0 * dy * dy, dot(weight, (*pixels).error)),
        vec4f(dot(weight, (*pixels).v_red), dot(weight, (*pixels).v_green), dot(weight, (*pixels).v_blue), 0.0),
    );
}

// Converts the sums of `passed` to the gradient with respect to the unscaled conic; see `halved`.
fn finished(sum: Gradient, half: vec4f) -> Gradient {
    let moved = LN_2 * sum.position.xy;
    return Gradient(
        vec4f(2.0 * half.x * moved.x + half.y * moved.y, half.y * moved.x + 2.0 * half.z * moved.y, sum.position.zw),
        vec4f(0.5 * sum.conic.x, sum.conic.y, 0.5 * sum.conic.z, sum.conic.w),
        sum.color,
    );
}
