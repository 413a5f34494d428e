// backward: compute the gradient of every intersection of a splat with a tile.
//
// threads   32 per segment of a tile's list; each lane handles two pixels in each quarter of the tile
// reads     view, status, bin_starts, tile_bits, entries, projected_splats, upstream [n_pixels] (gradient with respect to rgb
//           and depth), pixel_totals [n_pixels] (color . v_color + depth v_depth + transmittance v_transmittance of the finished
//           pixel; y: absolute error), last, capacity, segments, segment_counts, segment_states (see `segments_stored`)
// writes    gradients [n_slots]: each slot is written only by its owner
// twin      splat/reference/rasterize.rs
// source    Kerbl et al. 2023, appendix A; segments as the buckets of Mallick et al. 2024
//
// Splats are processed front to back, in the same order as in `rasterize`. Lanes recompute the state of their pixels from
// the beginning of the segment. The contributions of all pixels to a splat are summed in a fixed order (`sums`), and segments
// only determine which workgroup computes a gradient.

#import backward_bindings
#import pixels
#import coverage
#import tile_queue
#import sums
#import segment
#import capacity

@group(0) @binding(10) var<uniform> capacity: Capacity;
@group(0) @binding(11) var<storage, read> segments: array<Segment>;
@group(0) @binding(12) var<storage, read> segment_counts: array<u32>;
@group(0) @binding(13) var<storage, read> segment_states: array<vec2f>;

const LANES = 32u;
const NONE = 0xffffffffu;

var<workgroup> wg_tile: Tile;
var<workgroup> wg_past_last: atomic<u32>;
var<workgroup> wg_past: u32;
var<workgroup> wg_slots: array<u32, BATCH>;

fn pass_over(pixels: ptr<function, Pixels>, sum: ptr<function, Gradient>, splat: ProjectedSplat, dx: Px, dy: f32) {
    let power = power_at(splat.conic, dx, dy);
    let hit = (PxU(bitcast<u32>(splat.color.w)) < (*pixels).last) & within_reach(splat.conic, power);
    if any(hit) {
        let part = passed(pixels, hit, power, dx, dy, splat);
        (*sum).position += part.position;
        (*sum).conic += part.conic;
        (*sum).color += part.color;
    }
}

fn max_last(last: PxU) -> u32 {
    return max(pick_u(last, 0u), pick_u(last, 1u));
}

// A lane's pixels at the beginning of further segment `later`; with NONE, of the tile's first segment.
fn pixels_at_segment(tile: Tile, lane: u32, quarter: u32, later: u32) -> Pixels {
    var pixels = pixels_at(tile, tile.corner + 8u * vec2u(quarter % 2u, quarter / 2u) + lane_px(lane));
    if later != NONE {
        let at = later * N_STATE_PARTS * STATE_PAIRS + 32u * quarter + lane;
        pixels.behind -= segment_states[at] * pixels.v_red + segment_states[at + STATE_PAIRS] * pixels.v_green
            + segment_states[at + 2u * STATE_PAIRS] * pixels.v_blue + segment_states[at + 3u * STATE_PAIRS] * pixels.v_depth;
        pixels.transmittance = segment_states[at + 4u * STATE_PAIRS];
    }
    return pixels;
}

// The entries of a segment.
fn tile_of(segment: Segment) -> Tile {
    var tile = tile_at(segment.tile);
    tile.begin = segment.begin;
    tile.end = segment.end;
    return tile;
}

// Writes the zeros of `n` hidden splats to `wg_slots`, because `update` reads them. Neighboring lanes write neighboring words.
fn write_zeros(lane: u32, n: u32) {
    for (var at = lane; at < n * N_PARTS_OF_GRADIENT; at += LANES) {
        write_gradient(wg_slots[at / N_PARTS_OF_GRADIENT], at % N_PARTS_OF_GRADIENT, 0.0);
    }
}

// Writes zeros for a hidden piece of a list. Every lane must call it.
fn write_hidden(lane: u32, segment: u32) {
    if lane == 0u { wg_tile = tile_of(segments[segment]); }
    let tile = workgroupUniformLoad(&wg_tile);
    for (var word = tile.begin / 32u; word * 32u < tile.end; word += WORDS) {
        let n_queued = queue_words(lane, word, tile, 0u);
        for (var batch = 0u; batch < n_queued; batch += BATCH) {
            if batch + lane < n_queued { wg_slots[lane] = slot_of(wg_queue[batch + lane], tile); }
            workgroupBarrier(); // The slots are known.
            write_zeros(lane, min(n_queued - batch, BATCH));
            workgroupBarrier(); // All lanes have read the slots and the queue.
        }
    }
}

fn backward(workgroup: u32, lane: u32) {
    let n_tiles = view.n_tiles.x * view.n_tiles.y;
    let hidden = workgroup - n_tiles - capacity.n_segments; // The number wraps around for segments that are not hidden.
    if workgroup >= n_tiles + capacity.n_segments {
        if hidden < segment_counts[1] { write_hidden(lane, workgroup); }
        return; // A return is allowed here, because the condition is the same for all lanes.
    }
    let later = select(workgroup - n_tiles, NONE, workgroup < n_tiles);
    if later != NONE && later >= segment_counts[0] { return; } // Likewise.
    if lane == 0u {
        wg_tile = tile_of(segments[workgroup]);
        atomicStore(&wg_past_last, 0u);
    }
    let tile = workgroupUniformLoad(&wg_tile); // This barrier also orders the zeroing before the first `atomicMax`.
    let first = tile.corner + lane_px(lane);
    let center_x = f32(first.x) + 0.5 + RAMP;
    let center_y = f32(first.y) + 0.5;
    // Four named variables instead of an array, because arrays with variable indices are stored in memory.
    var a = pixels_at_segment(tile, lane, 0u, later);
    var b = pixels_at_segment(tile, lane, 1u, later);
    var c = pixels_at_segment(tile, lane, 2u, later);
    var d = pixels_at_segment(tile, lane, 3u, later);
    atomicMax(&wg_past_last, max(max(max_last(a.last), max_last(b.last)), max(max_last(c.last), max_last(d.last))));
    workgroupBarrier(); // Every lane has contributed its `last`.
    if lane == 0u { wg_past = atomicLoad(&wg_past_last); }
    let past_last = workgroupUniformLoad(&wg_past);
    var n_queued = 0u;
    var word = tile.begin / 32u;
    while word * 32u < tile.end {
        while n_queued < BATCH && word * 32u < tile.end {
            n_queued = queue_words(lane, word, tile, n_queued);
            word += WORDS;
        }
        let n_complete = select(n_queued / BATCH * BATCH, n_queued, word * 32u >= tile.end);
        for (var batch = 0u; batch < n_complete; batch += BATCH) {
            workgroupBarrier(); // No lane reads the slots of the previous batch anymore.
            if batch + lane < n_queued { wg_slots[lane] = slot_of(wg_queue[batch + lane], tile); }
            take_batch(lane, batch, n_queued, tile);
            let n = min(n_queued - batch, BATCH);
            if bitcast<u32>(wg_splats[0].color.w) >= past_last {
                write_zeros(lane, n); // All splats of the batch are hidden in this tile.
                continue;
            }
            for (var i = 0u; i < n; i++) {
                let splat = wg_splats[i];
                let quarters = wg_quarters[i];
                let dx = splat.position.x - center_x;
                let dy = splat.position.y - center_y;
                var sum: Gradient;
                if (quarters & 1u) != 0u { pass_over(&a, &sum, splat, dx, dy); }
                if (quarters & 2u) != 0u { pass_over(&b, &sum, splat, dx - 8.0, dy); }
                if (quarters & 4u) != 0u { pass_over(&c, &sum, splat, dx, dy - 8.0); }
                if (quarters & 8u) != 0u { pass_over(&d, &sum, splat, dx - 8.0, dy - 8.0); }
                write_gradient_sum(lane, wg_slots[i], finished(sum, splat.conic));
            }
        }
        n_queued = keep_rest(lane, n_complete, n_queued);
    }
}
