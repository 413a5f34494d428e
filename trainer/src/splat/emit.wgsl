// emit: list every splat in the bins it reaches, in order of depth.
//
// threads   256 per block of 256 splats, taken in order of depth, and window of 256 bins
// reads     view, model, by_depth, drawn, bin_counts (offsets), group_counts (offsets), bin_starts, slot_offsets, block_slots, status
// writes    entry_tiles [n_entries] (mask of the bin's tiles), entry_splats [n_entries], entry_slots [n_entries] (of the
//           lowest tile; the others follow), tile_counts [n_splats] (where rounding found other tiles than `project` did)
//
// The counts of `count_bins` and `project` hold: should rounding find others here, lists are cut or filled with entries
// of no tile.

#import view
#import model
#import bins
#import block_bins
#import status

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> model: Model;
@group(0) @binding(2) var<storage, read> group_counts: array<u32>;
@group(0) @binding(3) var<storage, read> by_depth: array<u32>;
@group(0) @binding(4) var<storage, read> drawn: array<Drawn>;
@group(0) @binding(5) var<storage, read> bin_counts: array<u32>;
@group(0) @binding(6) var<storage, read> bin_starts: array<u32>;
@group(0) @binding(7) var<storage, read> slot_offsets: array<u32>;
@group(0) @binding(8) var<storage, read> block_slots: array<u32>;
@group(0) @binding(9) var<storage, read> status: array<u32>;
@group(0) @binding(10) var<storage, read_write> tile_counts: array<u32>;
@group(0) @binding(11) var<storage, read_write> entry_tiles: array<u32>;
@group(0) @binding(12) var<storage, read_write> entry_splats: array<u32>;
@group(0) @binding(13) var<storage, read_write> entry_slots: array<u32>;

var<workgroup> wg_begins: array<u32, WINDOW_BINS>; // of the block's entries of a bin
var<workgroup> wg_ends: array<u32, WINDOW_BINS>;

// Where the entries of a block begin in a bin of the window.
fn begin_of(at: BlockAndWindow, block: u32, bin: u32) -> u32 {
    let bins = n_bins(view.n_tiles);
    if block >= n_blocks_in_use() { return bin_starts[at.first_bin + bin + 1u]; }
    let group = block / GROUP * bins.x * bins.y + at.first_bin + bin;
    return bin_starts[at.first_bin + bin] + group_counts[group] + bin_counts[block * bins.x * bins.y + at.first_bin + bin];
}

// The lowest bits of a mask, no more than `n`.
fn lowest_bits(mask: u32, n: u32) -> u32 {
    var kept = mask;
    while countOneBits(kept) > n { kept &= ~(1u << firstLeadingBit(kept)); }
    return kept;
}

@compute @workgroup_size(BLOCK)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = block_and_window(folded(wg, n_wgs));
    if lane < at.n_bins && at.block < n_blocks_in_use() {
        wg_begins[lane] = begin_of(at, at.block, lane);
        wg_ends[lane] = begin_of(at, at.block + 1u, lane);
    }
    mark_bins(lane, at);
    if status[N_ENTRIES] == 0u || at.block >= n_blocks_in_use() { return; } // Past the last barrier.
    let listed = listed_splat(lane, at.block);
    let bin_rows = bin_rows(listed);
    let n_columns = n_bins(view.n_tiles).x;
    let begin = block_slots[listed.splat_ix / BLOCK] + slot_offsets[listed.splat_ix];
    let n_touched = tile_counts[listed.splat_ix];
    var n_given = 0u;
    for (var row = bin_rows.x; row < bin_rows.y; row++) {
        let bin_row = bin_row(listed.ellipse, row, listed.rows, view.n_tiles);
        let columns = bin_columns(bin_row);
        for (var column = columns.x; column < columns.y; column++) {
            let tiles = lowest_bits(tiles_in_bin(bin_row, column), n_touched - n_given);
            let slot = begin + n_given;
            n_given += countOneBits(tiles);
            let bin = u32(row) * n_columns + u32(column) - at.first_bin; // Wraps where the bin is before the window.
            if bin >= at.n_bins || tiles_in_bin(bin_row, column) == 0u { continue; }
            let entry = wg_begins[bin] + n_marked(bin, lane);
            if entry >= wg_ends[bin] { continue; }
            entry_tiles[entry] = tiles;
            entry_splats[entry] = listed.splat_ix;
            entry_slots[entry] = slot;
        }
    }
    if bin_rows.y > bin_rows.x && n_given < n_touched { tile_counts[listed.splat_ix] = n_given; }
    if lane < at.n_bins {
        for (var entry = wg_begins[lane] + n_marked(lane, BLOCK); entry < wg_ends[lane]; entry++) { entry_tiles[entry] = 0u; }
    }
}
