// pixels: 4 neighbours in a row, handled together by one lane.

alias Px = vec4f;
alias PxU = vec4u;
alias PxB = vec4<bool>;
const PX = 4u;
const RAMP = Px(0.0, 1.0, 2.0, 3.0);

const INDEX = PxU(0u, 1u, 2u, 3u);

// With one pixel's value replaced or read: indexing by a variable would put all of a lane's values into memory.
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
