// backward: compute the gradient of every intersection of a splat with a tile.
//
// threads   32 per tile; each lane handles two pixels in each quarter of the tile
// reads     view, status, bin_starts, tile_bits, entries, projected_splats, upstream [n_pixels] (gradient with respect to rgb
//           and depth), pixel_totals [n_pixels] (color . v_color + depth v_depth + transmittance v_transmittance of the finished
//           pixel; y: absolute error), last
// writes    gradients [n_slots]: each slot is written only by its owner
// twin      splat/reference/rasterize.rs
// source    Kerbl et al. 2023, appendix A
//
// Splats are processed front to back, in the same order as in `rasterize`. Lanes recompute the state of their pixels,
// so `rasterize` only needs to store `last`. The contributions of all pixels to a splat are summed in a fixed order
// (`sums`).

#import backward_bindings
#import pixels
#import coverage
#import tile_queue
#import sums

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

fn backward(tile_ix: u32, lane: u32) {
    if lane == 0u {
        wg_tile = tile_at(tile_ix);
        atomicStore(&wg_past_last, 0u);
    }
    let tile = workgroupUniformLoad(&wg_tile); // Also orders the zeroing before the first `atomicMax`.
    let first = tile.corner + lane_px(lane);
    let center_x = f32(first.x) + 0.5 + RAMP;
    let center_y = f32(first.y) + 0.5;
    // Four named variables instead of an array, because arrays with variable indices are stored in memory.
    var a = pixels_at(tile, first);
    var b = pixels_at(tile, first + vec2u(8u, 0u));
    var c = pixels_at(tile, first + vec2u(0u, 8u));
    var d = pixels_at(tile, first + vec2u(8u, 8u));
    atomicMax(&wg_past_last, max(max(max_last(a.last), max_last(b.last)), max(max_last(c.last), max_last(d.last))));
    workgroupBarrier(); // Every lane has contributed its `last`.
    if lane == 0u { wg_past = atomicLoad(&wg_past_last); }
    let past_last = workgroupUniformLoad(&wg_past);
    for (var word = tile.begin / 32u; word * 32u < tile.end; word += WORDS) {
        let n_queued = queue_words(lane, word, tile);
        for (var batch = 0u; batch < n_queued; batch += BATCH) {
            workgroupBarrier(); // No lane reads the slots of the previous batch anymore.
            if batch + lane < n_queued { wg_slots[lane] = slot_of(wg_queue[batch + lane], tile); }
            take_batch(lane, batch, n_queued, tile);
            let n = min(n_queued - batch, BATCH);
            if bitcast<u32>(wg_splats[0].color.w) >= past_last {
                // All splats of the batch are hidden in this tile. Write zeros, because `update` reads their slots.
                for (var at = lane; at < n * N_PARTS_OF_GRADIENT; at += LANES) {
                    write_gradient(wg_slots[at / N_PARTS_OF_GRADIENT], at % N_PARTS_OF_GRADIENT, 0.0);
                }
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
    }
}
