// backward: the gradient of every intersection of splat and tile.
//
// threads   128 per tile, two pixels a lane
// reads     view, status, bin_starts, entry_tiles, entry_splats, entry_slots, drawn, upstream [n_pixels] (slope towards rgb
//           and depth), rest [n_pixels] (color . v_color + depth v_depth + transmittance v_transmittance of the finished
//           pixel; y: absolute error), last
// writes    gradients [n_slots]: every slot by its only owner
// twin      splat/reference/rasterize.rs
// source    Kerbl et al. 2023, appendix A
//
// The splats pass front to back, as they were blended, over lanes that keep the state of their pixels: nothing is stored
// between the two kernels but `last`. A splat's sums over the pixels meet in a fixed order: within a subgroup by shuffles
// (`sums`), then over the subgroups in order.

#import backward_bindings
#import pixels
#import coverage
#import tile
#import tile_queue
#import sums

const BATCH = 64u;
var<workgroup> wg_drawn: array<Drawn, BATCH>;
var<workgroup> wg_tile: Tile;
var<workgroup> wg_past_last: atomic<u32>;
var<workgroup> wg_past: u32;

// Writes nothing but zeros: these splats are hidden in this tile.
fn hide(lane: u32, batch: u32, n: u32, tile_bit: u32) {
    for (var i = lane; i < n * N_PARTS_OF_GRADIENT; i += LANES) {
        let slot = slot_of(wg_queue[batch + i / N_PARTS_OF_GRADIENT], tile_bit);
        gradients[slot * N_PARTS_OF_GRADIENT + i % N_PARTS_OF_GRADIENT] = 0.0;
    }
}

fn backward(wg_ix: u32, lane: u32) {
    if lane == 0u {
        wg_tile = tile_at(wg_ix);
        atomicStore(&wg_past_last, 0u);
    }
    let tile = workgroupUniformLoad(&wg_tile); // Also orders the zeroing before anyone raises it.
    let first = tile.corner + lane_px(lane);
    let center_x = f32(first.x) + 0.5 + RAMP;
    let center_y = f32(first.y) + 0.5;
    var pixels = pixels_at(tile, first);
    for (var k = 0u; k < PX; k++) { atomicMax(&wg_past_last, pixels.last[k]); }
    workgroupBarrier(); // All have told their last.
    if lane == 0u { wg_past = atomicLoad(&wg_past_last); }
    let past_last = workgroupUniformLoad(&wg_past);
    for (var chunk = tile.begin; chunk < tile.end; chunk += CHUNK) {
        let n_queued = queue_chunk(lane, chunk, tile.end, tile.bit);
        for (var batch = 0u; batch < n_queued; batch += BATCH) {
            let n = min(n_queued - batch, BATCH);
            if wg_queue[batch] - tile.begin >= past_last {
                hide(lane, batch, n_queued - batch, tile.bit);
                break;
            }
            workgroupBarrier(); // All have read the last batch.
            if lane < 16u { atomicStore(&wg_touching[lane], 0u); }
            workgroupBarrier(); // All bits are zero before the first is set.
            if lane < n {
                let entry = wg_queue[batch + lane];
                var splat = drawn[entry_splats[entry]];
                splat.color.w = bitcast<f32>(entry - tile.begin);
                wg_drawn[lane] = splat;
                if entry - tile.begin < past_last { mark_quarters(lane, splat, tile.corner); }
            }
            workgroupBarrier(); // The batch is there before anyone reads it.
            for (var word = 0u; word < BATCH / 32u; word++) {
                var bits = shared_bits(lane, word);
                while bits != 0u {
                    let i = word * 32u + firstTrailingBit(bits);
                    bits &= bits - 1u;
                    let splat = wg_drawn[i];
                    let dx = splat.place.x - center_x;
                    let dy = splat.place.y - center_y;
                    let power = power_at(splat.conic, dx, dy);
                    let hit = (PxU(bitcast<u32>(splat.color.w)) < pixels.last) & within_reach(splat.conic, power);
                    var sum: Gradient;
                    if anyone(any(hit)) { sum = finished(passed(&pixels, hit, power, dx, dy, splat), splat.conic); }
                    hand_in(lane, i, sum);
                }
            }
            workgroupBarrier(); // All parts of the sums are there.
            for (var at = lane; at < n * N_PARTS_OF_GRADIENT; at += LANES) {
                let i = at / N_PARTS_OF_GRADIENT;
                let slot = slot_of(wg_queue[batch + i], tile.bit);
                gradients[slot * N_PARTS_OF_GRADIENT + at % N_PARTS_OF_GRADIENT] = sum_of_parts(i, at % N_PARTS_OF_GRADIENT);
            }
        }
    }
}
