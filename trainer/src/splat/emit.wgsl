// emit: list the tiles of every splat, splats in order of depth; a splat's intersections are neighbours.
//
// threads   256 per block of 1024 splats
// reads     view, model, by_depth, tile_counts, drawn, block_sums (offsets), status
// writes    tile_keys [n_isect], slot_splats [n_isect], slot_offsets [n_splats]
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
@group(0) @binding(8) var<storage, read_write> slot_splats: array<u32>;
@group(0) @binding(9) var<storage, read_write> slot_offsets: array<u32>;

const BLOCK = 1024u;
var<workgroup> wg_splats: array<u32, BLOCK>;
var<workgroup> wg_begins: array<u32, BLOCK>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = folded(wg, n_wgs);
    let n_in_block = min(BLOCK, max(model.n_splats, block * BLOCK) - block * BLOCK);
    var begins = vec4u(0u);
    var sum = 0u;
    for (var i = 0u; i < 4u; i++) {
        let rank = lane * 4u + i;
        begins[i] = sum;
        if rank < n_in_block {
            let splat_ix = by_depth[block * BLOCK + rank];
            wg_splats[rank] = splat_ix;
            sum += tile_counts[splat_ix];
        }
    }
    var total = 0u;
    let before = exclusive_scan(lane, sum, &total);
    for (var i = 0u; i < 4u; i++) { wg_begins[lane * 4u + i] = before + begins[i]; }
    workgroupBarrier(); // The block's list is there; from here on neighbouring lanes take neighbouring splats.
    if status[N_ISECT] == 0u { return; } // Past the last barrier.
    for (var rank = lane; rank < n_in_block; rank += 256u) {
        let splat_ix = wg_splats[rank];
        var slot = block_sums[block] + wg_begins[rank];
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
                slot_splats[slot] = splat_ix;
                slot++;
            }
        }
        for (; slot < end; slot++) {
            tile_keys[slot] = view.n_tiles.x * view.n_tiles.y;
            slot_splats[slot] = splat_ix;
        }
    }
}
