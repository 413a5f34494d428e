// emit: list the tiles of every splat, splats in order of depth; a splat's intersections are neighbours.
//
// threads   256 per block of 1024 splats
// reads     view, model, by_depth, tile_counts, drawn, block_sums (offsets), status
// writes    tile_keys [n_isect], slots [n_isect] (0, 1, 2, ...), slot_splats [n_isect], slot_offsets [n_splats]
//
// The count of `project` holds: should rounding find other tiles here, the list is cut, or filled with a tile past the last.

#import view
#import model
#import tiles
#import scan
#import status

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> model: Model;
@group(0) @binding(2) var<storage, read> by_depth: array<u32>;
@group(0) @binding(3) var<storage, read> tile_counts: array<u32>;
@group(0) @binding(4) var<storage, read> drawn: array<Drawn>;
@group(0) @binding(5) var<storage, read> block_sums: array<u32>;
@group(0) @binding(6) var<storage, read> status: array<u32>;
@group(0) @binding(7) var<storage, read_write> tile_keys: array<u32>;
@group(0) @binding(8) var<storage, read_write> slots: array<u32>;
@group(0) @binding(9) var<storage, read_write> slot_splats: array<u32>;
@group(0) @binding(10) var<storage, read_write> slot_offsets: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = folded(wg, n_wgs);
    let first_rank = block * 1024u + lane * 4u;
    var sum = 0u;
    for (var i = 0u; i < 4u; i++) {
        if first_rank + i < model.n_splats { sum += tile_counts[by_depth[first_rank + i]]; }
    }
    var total = 0u;
    let before = exclusive_scan(lane, sum, &total);
    if first_rank >= model.n_splats || status[N_ISECT] == 0u { return; } // Past the last barrier.
    var slot = block_sums[block] + before;
    for (var i = 0u; i < 4u; i++) {
        if first_rank + i >= model.n_splats { break; }
        let splat_ix = by_depth[first_rank + i];
        let end = slot + tile_counts[splat_ix];
        slot_offsets[splat_ix] = slot;
        if slot == end { continue; }
        let splat = drawn[splat_ix];
        let ellipse = Ellipse(splat.place.xy, splat.conic.xyz, splat.conic.w);
        let rows = tile_rows(ellipse, view.n_tiles);
        for (var row = rows.x; row < rows.y; row++) {
            let columns = tile_columns(ellipse, row, view.n_tiles);
            for (var column = columns.x; column < columns.y && slot < end; column++) {
                tile_keys[slot] = u32(row) * view.n_tiles.x + u32(column);
                slots[slot] = slot;
                slot_splats[slot] = splat_ix;
                slot++;
            }
        }
        for (; slot < end; slot++) {
            tile_keys[slot] = view.n_tiles.x * view.n_tiles.y;
            slots[slot] = slot;
            slot_splats[slot] = splat_ix;
        }
    }
}
