// tile_queue: the splats of a tile, 32 at a time, for a workgroup of 32 lanes. For kernels that bind the bins' lists.
//
// A lane has two neighbouring pixels in each quarter of 8 x 8 of the tile, so that a splat is looked at only in the
// quarters it touches. Small workgroups with little memory: more of them hide each other's waiting.

const LANES = 32u;
const BATCH = LANES;
const CHUNK = 256u;        // entries looked through at once
var<workgroup> wg_keep: array<atomic<u32>, 8>; // [CHUNK / 32]
var<workgroup> wg_queue: array<u32, CHUNK>;
var<workgroup> wg_drawn: array<Drawn, BATCH>;  // color.w: bits of the rank in the bin's list
var<workgroup> wg_quarters: array<u32, BATCH>; // that the splat may touch, see `quarters_touched`

// Where in its quarter the lane's first pixel lies.
fn lane_px(lane: u32) -> vec2u {
    return vec2u(lane % 4u * 2u, lane / 4u);
}

// Queues the tile's entries out of the next `CHUNK`, in order; returns how many. Every lane must call it.
fn queue_chunk(lane: u32, first: u32, tile: Tile) -> u32 {
    if lane < CHUNK / 32u { atomicStore(&wg_keep[lane], 0u); }
    workgroupBarrier(); // All bits are zero, and nobody reads the queue any more.
    for (var word = 0u; word < CHUNK / 32u; word++) {
        let entry = first + word * 32u + lane;
        if entry < tile.end && (entry_tiles[entry] & tile.bit) != 0u { atomicOr(&wg_keep[word], 1u << lane); }
    }
    workgroupBarrier(); // All bits are set.
    var n = 0u;
    for (var word = 0u; word < CHUNK / 32u; word++) {
        let bits = atomicLoad(&wg_keep[word]);
        let mine = 1u << lane;
        if (bits & mine) != 0u { wg_queue[n + countOneBits(bits & (mine - 1u))] = first + word * 32u + lane; }
        n += countOneBits(bits);
    }
    workgroupBarrier(); // The queue is there.
    return n;
}

// Takes a batch from the queue, a splat a lane. Every lane must call it.
fn take_batch(lane: u32, batch: u32, n_queued: u32, tile: Tile) {
    workgroupBarrier(); // Nobody reads the last batch any more.
    if batch + lane < n_queued {
        let entry = wg_queue[batch + lane];
        var splat = drawn[entry_splats[entry]];
        splat.color.w = bitcast<f32>(entry - tile.begin);
        wg_drawn[lane] = splat;
        wg_quarters[lane] = quarters_touched(Ellipse(splat.place.xy, splat.conic.xyz, splat.conic.w), vec2f(tile.corner));
    }
    workgroupBarrier(); // The batch is there.
}
