// coverage: evaluates a splat at a lane's pixels. Import after `pixels`.

// These functions set or get one pixel's value. They use no variable index, because it would spill the lane's values to
// memory.
fn put(all: Px, k: u32, value: f32) -> Px {
    return select(all, Px(value), INDEX == PxU(k));
}

fn put_u(all: PxU, k: u32, value: u32) -> PxU {
    return select(all, PxU(value), INDEX == PxU(k));
}

fn pick(all: Px, k: u32) -> f32 {
    return dot(select(Px(0.0), all, INDEX == PxU(k)), Px(1.0));
}

fn pick_u(all: PxU, k: u32) -> u32 {
    return dot(select(PxU(0u), all, INDEX == PxU(k)), PxU(1u));
}

const LN_2 = 0.6931471805599453;

// Scales a conic so that its quadratic form gives the falloff as a power of 2; w: the largest power drawn.
fn halved(conic: vec4f) -> vec4f {
    return conic * vec4f(0.5, 1.0, 0.5, 0.5) / LN_2;
}

// The falloff is 2^-power. `dx` and `dy` point from the pixel to the splat.
fn power_at(half: vec4f, dx: Px, dy: f32) -> Px {
    return (half.x * dx + half.y * dy) * dx + half.z * dy * dy;
}

// Whether the power is between 0 and the maximum. The bits are compared as integers, because the bits of negative
// numbers and NaN are larger.
fn within_reach(half: vec4f, power: Px) -> PxB {
    return bitcast<PxU>(power) <= PxU(bitcast<u32>(half.w));
}

// A lane's pixels, composited up to the current splat.
struct Blend {
    red: Px,
    green: Px,
    blue: Px,
    depth: Px,
    transmittance: Px,
    past_last: PxU,    // past the last contributor, counted in the bin's list
    live: PxB,
}

fn unblended(live: PxB) -> Blend {
    return Blend(Px(0.0), Px(0.0), Px(0.0), Px(0.0), Px(1.0), PxU(0u), live);
}

// Composites a splat into the pixels of `hit`. `rank` is its position in the bin's list.
fn blended(before: Blend, hit: PxB, power: Px, opacity_and_depth: vec2f, color: vec3f, rank: u32) -> Blend {
    var after = before;
    let alpha = min(Px(MAX_ALPHA), opacity_and_depth.x * exp2(-power));
    let next = before.transmittance * (1.0 - alpha);
    let stays_live = next > Px(MIN_TRANSMITTANCE);
    let adds = hit & stays_live;
    let weight = select(Px(0.0), alpha * before.transmittance, adds);
    after.red += weight * color.x;
    after.green += weight * color.y;
    after.blue += weight * color.z;
    after.depth += weight * opacity_and_depth.y;
    after.transmittance = select(before.transmittance, next, adds);
    after.past_last = select(before.past_last, PxU(rank + 1u), adds);
    after.live = before.live & (stays_live | !hit);
    return after;
}
