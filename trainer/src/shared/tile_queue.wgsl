// tile_queue: the entries of a bin's list that a tile of 128 lanes must look at, and which of its quarters each touches.
//
// Each lane has two neighbouring pixels; 32 lanes share a quarter of 8 x 8.

const LANES = 128u;
const CHUNK = 1024u;       // entries looked through at once
var<workgroup> wg_keep: array<atomic<u32>, 32>;
var<workgroup> wg_queue: array<u32, CHUNK>;
var<workgroup> wg_touching: array<atomic<u32>, 16>;  // bits of the batch's splats [quarter, BATCH / 32]

// Where in its tile the lane's first pixel lies.
fn lane_px(lane: u32) -> vec2u {
    let quarter = lane / 32u;
    let in_quarter = lane % 32u;
    return vec2u(quarter % 2u, quarter / 2u) * 8u + vec2u(in_quarter % 4u * 2u, in_quarter / 4u);
}

// Queues the tile's entries out of the next `CHUNK`, in order; returns how many. Every lane must call it.
fn queue_chunk(lane: u32, first: u32, end: u32, tile_bit: u32) -> u32 {
    if lane < CHUNK / 32u { atomicStore(&wg_keep[lane], 0u); }
    workgroupBarrier(); // All bits are zero, and nobody reads the queue any more.
    for (var word = lane / 32u; word < CHUNK / 32u; word += LANES / 32u) {
        let entry = first + word * 32u + lane % 32u;
        if entry < end && (entry_tiles[entry] & tile_bit) != 0u { atomicOr(&wg_keep[word], 1u << (lane % 32u)); }
    }
    workgroupBarrier(); // All bits are set.
    var n = 0u;
    for (var word = 0u; word < CHUNK / 32u; word++) {
        let bits = atomicLoad(&wg_keep[word]);
        let mine = 1u << (lane % 32u);
        if word % (LANES / 32u) == lane / 32u && (bits & mine) != 0u {
            wg_queue[n + countOneBits(bits & (mine - 1u))] = first + word * 32u + lane % 32u;
        }
        n += countOneBits(bits);
    }
    workgroupBarrier(); // The queue is there.
    return n;
}

// Notes which quarters the lane's splat of the batch touches.
fn mark_quarters(lane: u32, splat: Drawn, corner: vec2u) {
    let touched = quarters_touched(Ellipse(splat.place.xy, splat.conic.xyz, splat.conic.w), vec2f(corner));
    for (var quarter = 0u; quarter < 4u; quarter++) {
        if (touched & (1u << quarter)) != 0u { atomicOr(&wg_touching[quarter * 4u + lane / 32u], 1u << (lane % 32u)); }
    }
}
