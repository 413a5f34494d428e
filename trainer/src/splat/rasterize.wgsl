// rasterize: blend each tile's splats front to back.
//
// threads   128 per tile, 32 per quarter of 8 x 8 pixels; each lane handles two pixels
// reads     view, status, bin_starts, tile_bits, entries, projected_splats
// writes    image [n_pixels] (premultiplied rgb, transmittance), depth [n_pixels] (premultiplied), last [n_pixels]
//           (one past the last contributor, counted from the start of the bin's list); in training, see `segments`
// twin      splat/reference/rasterize.rs
// source    Kerbl et al. 2023, section 6

#import rasterize_bindings
#import pixels
#import coverage
#import tile_queue
#import segments
#import clips

const LANES = 128u;

var<workgroup> wg_tile: Tile;
var<workgroup> wg_reaching: array<atomic<u32>, 16>; // [quarters, BATCH / 32]: the splats of the batch that may touch the quarter
var<workgroup> wg_n_done: atomic<u32>;
var<workgroup> wg_all_done: u32;

// Sets `wg_reaching`. Every lane must call it.
fn assign_to_quarters(lane: u32, n: u32) {
    if lane < n {
        for (var quarter = 0u; quarter < 4u; quarter++) {
            if (wg_quarters[lane] & (1u << quarter)) != 0u { atomicOr(&wg_reaching[quarter * 4u + lane / 32u], 1u << (lane % 32u)); }
        }
    }
    workgroupBarrier(); // All splats are assigned.
}

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let tile_ix = folded(wg, n_wgs);
    if lane == 0u {
        wg_tile = tile_at(tile_ix);
        atomicStore(&wg_n_done, 0u);
    }
    let tile = workgroupUniformLoad(&wg_tile); // Also orders the zeroing before the first `atomicAdd`.
    begin_segments(lane, tile_ix, tile);
    let quarter = lane / 32u;
    let first = tile.corner + 8u * vec2u(quarter % 2u, quarter / 2u) + lane_px(lane % 32u);
    let center_x = f32(first.x) + 0.5 + RAMP;
    let center_y = f32(first.y) + 0.5;
    let on_image = (PxU(first.x) + INDEX < PxU(view.size_px.x)) & PxB(tile.in_grid && first.y < view.size_px.y);
    var blend = unblended(on_image);
    var counted = false;
    var all_done = false;
    var n_batches = 0u;
    var n_queued = 0u;
    var end = tile.end;
    var word = tile.begin / 32u;
    while word * 32u < tile.end && !all_done {
        while n_queued < BATCH && word * 32u < tile.end {
            n_queued = queue_words(lane, word, tile, n_queued);
            word += WORDS;
        }
        let n_complete = select(n_queued / BATCH * BATCH, n_queued, word * 32u >= tile.end);
        var batch = 0u;
        while batch < n_complete && !all_done {
            begin_segment(lane, n_batches, tile_ix, tile, wg_queue[batch], blend);
            n_batches++;
            if lane < 16u { atomicStore(&wg_reaching[lane], 0u); }
            take_batch(lane, batch, n_queued, tile);
            queue_clips(lane, batch, n_queued);
            assign_to_quarters(lane, n_queued - batch);
            for (var part = 0u; part < BATCH / 32u; part++) {
                var bits = atomicLoad(&wg_reaching[quarter * 4u + part]);
                while bits != 0u && any(blend.live) {
                    // Two at once, so that their latencies overlap.
                    let i = 32u * part + firstTrailingBit(bits);
                    bits &= bits - 1u;
                    let has_second = bits != 0u;
                    let j = select(i, 32u * part + firstTrailingBit(bits), has_second);
                    bits &= bits - 1u;
                    let splat = wg_splats[i];
                    let second = wg_splats[j];
                    let dx = splat.position.x - center_x;
                    let dy = splat.position.y - center_y;
                    let dx_2 = second.position.x - center_x;
                    let dy_2 = second.position.y - center_y;
                    let power = power_at(splat.conic, dx, dy);
                    let power_2 = power_at(second.conic, dx_2, dy_2);
                    let hit = clipped(blend.live & within_reach(splat.conic, power), queued_clip(i), dx, dy);
                    blend = blended(blend, hit, power, splat.position.wz, splat.color.rgb, bitcast<u32>(splat.color.w));
                    let reached_2 = PxB(has_second) & blend.live & within_reach(second.conic, power_2);
                    let hit_2 = clipped(reached_2, queued_clip(j), dx_2, dy_2);
                    blend = blended(blend, hit_2, power_2, second.position.wz, second.color.rgb, bitcast<u32>(second.color.w));
                }
            }
            if !counted && !any(blend.live) {
                counted = true;
                atomicAdd(&wg_n_done, 1u);
            }
            workgroupBarrier(); // Every finished lane has been counted.
            if lane == 0u { wg_all_done = atomicLoad(&wg_n_done); }
            all_done = workgroupUniformLoad(&wg_all_done) == LANES;
            batch += BATCH;
        }
        if all_done {
            end = wg_queue[min(batch, n_queued) - 1u] + 1u;
        } else {
            n_queued = keep_rest(lane, batch, n_queued);
        }
    }
    end_segments(lane, tile_ix, tile, end);
    write_pixels(first, on_image, blend);
}
