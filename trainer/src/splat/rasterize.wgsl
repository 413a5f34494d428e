// rasterize: blend each tile's splats front to back.
//
// threads   128 per tile, two pixels a lane
// reads     view, status, bin_starts, entry_tiles, entry_splats, drawn
// writes    image [n_pixels] (premultiplied rgb, transmittance), depth [n_pixels] (premultiplied), last [n_pixels]
//           (past the last contributor, counted from the first of the bin's list)
// twin      splat/reference/rasterize.rs
// source    Kerbl et al. 2023, section 6
//
// Each quarter of the tile walks only over the splats that touch it: half the pairs of pixel and splat, or fewer.

#import rasterize_bindings
#import pixels
#import coverage
#import tile
#import tile_queue

const BATCH = 128u;
var<workgroup> wg_drawn: array<Drawn, BATCH>;
var<workgroup> wg_tile: Tile;
var<workgroup> wg_n_done: atomic<u32>;
var<workgroup> wg_all_done: u32;

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    if lane == 0u {
        wg_tile = tile_at(folded(wg, n_wgs));
        atomicStore(&wg_n_done, 0u);
    }
    let tile = workgroupUniformLoad(&wg_tile); // Also orders the zeroing before anyone adds.
    let first = tile.corner + lane_px(lane);
    let center_x = f32(first.x) + 0.5 + RAMP;
    let center_y = f32(first.y) + 0.5;
    let on_image = (center_x < Px(f32(view.size_px.x))) & PxB(tile.in_grid && first.y < view.size_px.y);
    var blend = unblended(on_image);
    var counted = !any(on_image);
    if counted { atomicAdd(&wg_n_done, 1u); }
    for (var chunk = tile.begin; chunk < tile.end; chunk += CHUNK) {
        let n_queued = queue_chunk(lane, chunk, tile.end, tile.bit);
        for (var batch = 0u; batch < n_queued; batch += BATCH) {
            workgroupBarrier(); // All have counted themselves done, and read the last batch.
            if lane == 0u { wg_all_done = atomicLoad(&wg_n_done); }
            if lane < 16u { atomicStore(&wg_touching[lane], 0u); }
            if workgroupUniformLoad(&wg_all_done) == LANES { break; }
            if batch + lane < n_queued {
                let entry = wg_queue[batch + lane];
                var splat = drawn[entry_splats[entry]];
                splat.color.w = bitcast<f32>(entry - tile.begin);
                wg_drawn[lane] = splat;
                mark_quarters(lane, splat, tile.corner);
            }
            workgroupBarrier(); // The batch is there before anyone reads it.
            for (var word = 0u; word < BATCH / 32u && !counted; word++) {
                var bits = atomicLoad(&wg_touching[lane / 32u * 4u + word]);
                while bits != 0u {
                    let i = word * 32u + firstTrailingBit(bits);
                    bits &= bits - 1u;
                    let place = wg_drawn[i].place;
                    let conic = wg_drawn[i].conic;
                    let dx = place.x - center_x;
                    let dy = place.y - center_y;
                    let power = power_at(conic, dx, dy);
                    let hit = blend.live & within_reach(conic, power);
                    if !any(hit) { continue; }
                    let color = wg_drawn[i].color;
                    blend = blended(blend, hit, power, place.wz, color.rgb, bitcast<u32>(color.w));
                    if !any(blend.live) { break; }
                }
                if !any(blend.live) {
                    counted = true;
                    atomicAdd(&wg_n_done, 1u);
                }
            }
        }
        if lane == 0u { wg_all_done = atomicLoad(&wg_n_done); }
        if workgroupUniformLoad(&wg_all_done) == LANES { break; }
    }
    write_pixels(first, on_image, blend);
}
