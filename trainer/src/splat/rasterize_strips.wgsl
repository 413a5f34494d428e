// rasterize_strips: `rasterize` for software adapters, whose lanes access memory sequentially.
//
// threads   a workgroup of 8 per tile, which processes strips one after another (see `strips`)
// reads     same as `rasterize`
// writes    same as `rasterize`
// twin      splat/reference/rasterize.rs
// source    same as `rasterize`

#import rasterize_bindings
#import strips
#import coverage
#import clips

var<workgroup> wg_blends: array<Blend, 64>; // [N_STRIPS, LANES], state between two queues

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(subgroup_invocation_id) lane: u32) {
    let tile = tile_at(folded(wg, n_wgs));
    var next = tile.begin / 32u;
    var unfinished = true;
    for (var round = 0u; unfinished; round++) {
        let queued = queue_entries(lane, next, tile);
        next = queued.y;
        var live_strips = 0u;
        for (var strip = 0u; strip < N_STRIPS; strip++) {
            let first = tile.corner + strip_px(strip, lane);
            let center_x = f32(first.x) + 0.5 + RAMP;
            let center_y = f32(first.y) + 0.5;
            let top = f32(tile.corner.y + strip * 2u) + 0.5;
            let on_image = (center_x < Px(f32(view.size_px.x))) & PxB(tile.in_grid && first.y < view.size_px.y);
            var blend = unblended(on_image);
            if round > 0u { blend = wg_blends[strip * LANES + lane]; }
            var any_live = queued.x > 0u && or_of_lanes(select(0u, 1u, any(blend.live))) != 0u;
            for (var part = 0u; part < queued.x && any_live; part += LANES) {
                let entry = wg_queue[min(part + lane, queued.x - 1u)];
                let splat_ix = entries[entry].x;
                let position = projected_splats[splat_ix].position;
                let conic = projected_splats[splat_ix].conic;
                let color = projected_splats[splat_ix].color;
                let half = halved(conic);
                let clip = clip_of(splat_ix);
                let owned = part + lane < queued.x;
                var reaching = or_of_lanes(select(0u, 1u << lane, owned && reaches_strip(position, conic, top)));
                loop {
                    let some = reaching != 0u; // The loop body runs even if no splat reaches the strip.
                    let i = firstTrailingBit(reaching) & 7u;
                    reaching &= reaching - 1u;
                    let at = subgroupShuffle(position, i);
                    let shape = subgroupShuffle(half, i);
                    let dx = at.x - center_x;
                    let dy = at.y - center_y;
                    let power = power_at(shape, dx, dy);
                    let reached = blend.live & within_reach(shape, power) & PxB(some);
                    let hit = clipped(reached, shuffled_clip(clip, i), dx, dy);
                    blend = blended(blend, hit, power, at.wz, subgroupShuffle(color, i).rgb, subgroupShuffle(entry, i) - tile.begin);
                    continuing {
                        break if reaching == 0u;
                    }
                }
                any_live = or_of_lanes(select(0u, 1u, any(blend.live))) != 0u;
            }
            live_strips |= select(0u, 1u, any_live);
            unfinished = next * 32u < tile.end && live_strips != 0u;
            if next * 32u < tile.end { wg_blends[strip * LANES + lane] = blend; }
            write_pixels(first, on_image, blend);
        }
    }
}
