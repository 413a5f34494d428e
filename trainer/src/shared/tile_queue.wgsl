// tile_queue: the splats of a tile, 32 at a time, for a workgroup of 32 lanes in kernels that bind the bins' lists.
//
// Each lane has two neighboring pixels in each 8 x 8 quarter of the tile, so a splat is evaluated only in the quarters
// that it touches. Workgroups are small and use little memory, so that more of them run at once and hide latency.

#import tiles

const LANES = 32u;
const BATCH = LANES;
const WORDS = 8u;          // of 32 entries, searched at once
var<workgroup> wg_words: array<u32, WORDS>;
var<workgroup> wg_queue: array<u32, 256>;
var<workgroup> wg_splats: array<ProjectedSplat, BATCH>;  // conic: `halved`; color.w: bits of the rank in the bin's list
var<workgroup> wg_quarters: array<u32, BATCH>; // quarters that the splat may touch, see `quarters_touched`

// Position within a quarter of the lane's first pixel.
fn lane_px(lane: u32) -> vec2u {
    return vec2u(lane % 4u * 2u, lane / 4u);
}

// Queues the tile's entries from the next `WORDS` words in order and returns their number. Every lane must call it.
fn queue_words(lane: u32, first: u32, tile: Tile) -> u32 {
    if lane < WORDS { wg_words[lane] = entries_of(tile, first + lane); }
    workgroupBarrier(); // The words are written, and all lanes have finished reading the previous queue.
    // Four lanes per word.
    let mine = lane / 4u;
    let shift = lane % 4u * 8u;
    var n = 0u;
    var at = 0u;
    for (var word = 0u; word < WORDS; word++) {
        if word == mine { at = n; }
        n += countOneBits(wg_words[word]);
    }
    at += countOneBits(wg_words[mine] & ((1u << shift) - 1u));
    var bits = wg_words[mine] & (255u << shift);
    while bits != 0u {
        wg_queue[at] = (first + mine) * 32u + firstTrailingBit(bits);
        bits &= bits - 1u;
        at++;
    }
    workgroupBarrier(); // The queue is written.
    return n;
}

// Takes a batch from the queue, one splat per lane. Every lane must call it.
fn take_batch(lane: u32, batch: u32, n_queued: u32, tile: Tile) {
    workgroupBarrier(); // All lanes have finished reading the previous batch.
    if batch + lane < n_queued {
        let entry = wg_queue[batch + lane];
        var splat = projected_splats[entries[entry].x];
        splat.color.w = bitcast<f32>(entry - tile.begin);
        wg_quarters[lane] = quarters_touched(Ellipse(splat.position.xy, splat.conic.xyz, splat.conic.w), vec2f(tile.corner));
        splat.conic = halved(splat.conic);
        wg_splats[lane] = splat;
    }
    workgroupBarrier(); // The batch is written.
}
