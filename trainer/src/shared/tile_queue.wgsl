// tile_queue: the splats of a tile in batches, for kernels that bind the bins' lists. The kernel defines LANES, the size of
// its workgroups, as a multiple of 32.
//
// A lane has two neighboring pixels in an 8 x 8 quarter of the tile, so a splat is evaluated only in the quarters that it
// touches. Workgroups use little memory, so that more of them run at once and hide latency.

#import tiles

const BATCH = LANES;       // splats
const WORDS = LANES / 4u;  // of 32 entries, searched at once
var<workgroup> wg_words: array<u32, WORDS>;
var<workgroup> wg_n_found: array<u32, LANES / 32u>;      // entries found by each 32 lanes
var<workgroup> wg_queue: array<u32, 32u * WORDS + BATCH>;
var<workgroup> wg_splats: array<ProjectedSplat, BATCH>;  // conic: `halved`; color.w: bits of the rank in the bin's list
var<workgroup> wg_quarters: array<u32, BATCH>; // quarters that the splat may touch, see `quarters_touched`

// Position within a quarter of the first pixel of one of its 32 lanes.
fn lane_px(lane: u32) -> vec2u {
    return vec2u(lane % 4u * 2u, lane / 4u);
}

// Appends the tile's entries from the next `WORDS` words, in order, to a queue of fewer than BATCH entries. Returns the new
// number. Every lane must call it.
fn queue_words(lane: u32, first: u32, tile: Tile, n_queued: u32) -> u32 {
    if lane < WORDS { wg_words[lane] = entries_of(tile, first + lane); }
    workgroupBarrier(); // The words are written.
    // Four lanes per word, eight words per 32 lanes.
    let mine = lane / 4u;
    let shift = lane % 4u * 8u;
    var n = 0u;
    var at = n_queued;
    for (var word = lane / 32u * 8u; word < lane / 32u * 8u + 8u; word++) {
        if word == mine { at += n; }
        n += countOneBits(wg_words[word]);
    }
    if lane % 32u == 0u { wg_n_found[lane / 32u] = n; }
    workgroupBarrier(); // The numbers are written.
    var n_after = n_queued;
    for (var group = 0u; group < LANES / 32u; group++) {
        if group == lane / 32u { at += n_after - n_queued; }
        n_after += wg_n_found[group];
    }
    at += countOneBits(wg_words[mine] & ((1u << shift) - 1u));
    var bits = wg_words[mine] & (255u << shift);
    while bits != 0u {
        wg_queue[at] = (first + mine) * 32u + firstTrailingBit(bits);
        bits &= bits - 1u;
        at++;
    }
    workgroupBarrier(); // The queue is written, and all lanes have finished reading the words.
    return n_after;
}

// Moves the entries from `begin` on, fewer than BATCH, to the front of the queue. Returns their number. Every lane must call
// it.
fn keep_rest(lane: u32, begin: u32, n_queued: u32) -> u32 {
    var entry = 0u;
    if begin + lane < n_queued { entry = wg_queue[begin + lane]; }
    workgroupBarrier(); // All lanes have read their entries.
    if begin + lane < n_queued { wg_queue[lane] = entry; }
    workgroupBarrier(); // The entries are at the front.
    return n_queued - min(begin, n_queued);
}

// Takes a batch from the queue, one splat per lane. Every lane must call it.
fn take_batch(lane: u32, batch: u32, n_queued: u32, tile: Tile) {
    workgroupBarrier(); // All lanes have finished reading the previous batch.
    if batch + lane < n_queued {
        let entry = wg_queue[batch + lane];
        var splat = projected_splats[entries[entry].x];
        splat.color.w = bitcast<f32>(entry - tile.list_begin);
        wg_quarters[lane] = quarters_touched(Ellipse(splat.position.xy, splat.conic.xyz, splat.conic.w), vec2f(tile.corner));
        splat.conic = halved(splat.conic);
        wg_splats[lane] = splat;
    }
    workgroupBarrier(); // The batch is written.
}
