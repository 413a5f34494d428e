// segments: divides the list of a tile into segments for `backward`. Every lane must call each function.
//
// writes    segments [n_tiles, capacity.n_segments, rest]: the first segment of each tile; further segments, in any order;
//           pieces of the hidden ends of lists, in any order
//           segment_counts [2]: further segments; pieces of hidden ends
//           segment_states [capacity.n_segments, N_STATE_PARTS, STATE_PAIRS]: state at the beginning of further segments

#import segment
#import capacity

@group(0) @binding(9) var<uniform> capacity: Capacity;
@group(0) @binding(10) var<storage, read_write> segments: array<Segment>;
@group(0) @binding(11) var<storage, read_write> segment_counts: array<atomic<u32>>;
@group(0) @binding(12) var<storage, read_write> segment_states: array<vec2f>;

var<workgroup> wg_segment: u32; // the open segment

fn begin_segments(lane: u32, tile_ix: u32, tile: Tile) {
    if lane == 0u && tile.in_grid {
        segments[tile_ix] = Segment(tile_ix, tile.begin, tile.end, 0u);
        wg_segment = tile_ix;
    }
}

// Begins a segment at `entry`, if the current segment is full after `n_batches` batches of the tile.
fn begin_segment(lane: u32, n_batches: u32, tile_ix: u32, tile: Tile, entry: u32, blend: Blend) {
    if n_batches == 0u || n_batches % batches_per_segment(status[N_SLOTS]) != 0u { return; }
    let n_tiles = view.n_tiles.x * view.n_tiles.y;
    if lane == 0u {
        segments[wg_segment].end = entry;
        wg_segment = n_tiles + atomicAdd(&segment_counts[0], 1u);
        segments[wg_segment] = Segment(tile_ix, entry, tile.end, 0u);
    }
    let at = (workgroupUniformLoad(&wg_segment) - n_tiles) * N_STATE_PARTS * STATE_PAIRS + lane;
    segment_states[at] = blend.red;
    segment_states[at + STATE_PAIRS] = blend.green;
    segment_states[at + 2u * STATE_PAIRS] = blend.blue;
    segment_states[at + 3u * STATE_PAIRS] = blend.depth;
    segment_states[at + 4u * STATE_PAIRS] = blend.transmittance;
}

// Ends the last segment. The entries from `end` on are hidden in this tile.
fn end_segments(lane: u32, tile_ix: u32, tile: Tile, end: u32) {
    if lane != 0u || !tile.in_grid { return; } // Allowed here: no barrier below.
    segments[wg_segment].end = end;
    if end >= tile.end { return; }
    let first = end / HIDDEN_ENTRIES;
    let n_pieces = (tile.end - 1u) / HIDDEN_ENTRIES - first + 1u;
    let at = view.n_tiles.x * view.n_tiles.y + capacity.n_segments + atomicAdd(&segment_counts[1], n_pieces);
    for (var piece = 0u; piece < n_pieces; piece++) {
        let begin = (first + piece) * HIDDEN_ENTRIES;
        segments[at + piece] = Segment(tile_ix, max(begin, end), min(begin + HIDDEN_ENTRIES, tile.end), 0u);
    }
}
