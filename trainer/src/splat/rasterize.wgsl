// rasterize: blend each tile's splats front to back.
//
// threads   32 per tile; each lane handles two pixels in each quarter of the tile
// reads     view, status, bin_starts, tile_bits, entries, projected_splats
// writes    image [n_pixels] (premultiplied rgb, transmittance), depth [n_pixels] (premultiplied), last [n_pixels]
//           (one past the last contributor, counted from the start of the bin's list)
// twin      splat/reference/rasterize.rs
// source    Kerbl et al. 2023, section 6

#import rasterize_bindings
#import pixels
#import coverage
#import tile_queue

var<workgroup> wg_tile: Tile;
var<workgroup> wg_n_done: atomic<u32>;
var<workgroup> wg_all_done: u32;

fn blend_in(blend: ptr<function, Blend>, splat: ProjectedSplat, dx: Px, dy: f32) {
    let power = power_at(splat.conic, dx, dy);
    let hit = (*blend).live & within_reach(splat.conic, power);
    *blend = blended(*blend, hit, power, splat.position.wz, splat.color.rgb, bitcast<u32>(splat.color.w));
}

fn on_image(tile: Tile, first: vec2u) -> PxB {
    return (PxU(first.x) + INDEX < PxU(view.size_px.x)) & PxB(tile.in_grid && first.y < view.size_px.y);
}

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    if lane == 0u {
        wg_tile = tile_at(folded(wg, n_wgs));
        atomicStore(&wg_n_done, 0u);
    }
    let tile = workgroupUniformLoad(&wg_tile); // Also orders the zeroing before the first `atomicAdd`.
    let first = tile.corner + lane_px(lane);
    let center_x = f32(first.x) + 0.5 + RAMP;
    let center_y = f32(first.y) + 0.5;
    // Four named variables instead of an array, because arrays with variable indices are stored in memory.
    var a = unblended(on_image(tile, first));
    var b = unblended(on_image(tile, first + vec2u(8u, 0u)));
    var c = unblended(on_image(tile, first + vec2u(0u, 8u)));
    var d = unblended(on_image(tile, first + vec2u(8u, 8u)));
    var counted = false;
    var all_done = false;
    for (var word = tile.begin / 32u; word * 32u < tile.end && !all_done; word += WORDS) {
        let n_queued = queue_words(lane, word, tile);
        for (var batch = 0u; batch < n_queued && !all_done; batch += BATCH) {
            take_batch(lane, batch, n_queued, tile);
            let n = min(n_queued - batch, BATCH);
            for (var i = 0u; i < n; i++) {
                let splat = wg_splats[i];
                let quarters = wg_quarters[i];
                let dx = splat.position.x - center_x;
                let dy = splat.position.y - center_y;
                if (quarters & 1u) != 0u { blend_in(&a, splat, dx, dy); }
                if (quarters & 2u) != 0u { blend_in(&b, splat, dx - 8.0, dy); }
                if (quarters & 4u) != 0u { blend_in(&c, splat, dx, dy - 8.0); }
                if (quarters & 8u) != 0u { blend_in(&d, splat, dx - 8.0, dy - 8.0); }
            }
            if !counted && !any(a.live | b.live | c.live | d.live) {
                counted = true;
                atomicAdd(&wg_n_done, 1u);
            }
            workgroupBarrier(); // Every finished lane has been counted.
            if lane == 0u { wg_all_done = atomicLoad(&wg_n_done); }
            all_done = workgroupUniformLoad(&wg_all_done) == LANES;
        }
    }
    write_pixels(first, on_image(tile, first), a);
    write_pixels(first + vec2u(8u, 0u), on_image(tile, first + vec2u(8u, 0u)), b);
    write_pixels(first + vec2u(0u, 8u), on_image(tile, first + vec2u(0u, 8u)), c);
    write_pixels(first + vec2u(8u, 8u), on_image(tile, first + vec2u(8u, 8u)), d);
}
