// emit: append every splat to the lists of the bins that it reaches, in order of depth.
//
// threads   256 per block of 256 splats in order of depth, and per window of 256 bins
// reads     view, model, by_depth, touched, bin_counts, group_counts (offsets), bin_starts, slot_offsets, block_slots, status
// writes    entries [n_entries] (splat; mask of the touched tiles in the bin; first of their consecutive slots),
//           slot_begins [n_splats]

#import view
#import model
#import bins
#import block_bins
#import status

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> model: Model;
@group(0) @binding(2) var<storage, read> by_depth: array<u32>;
@group(0) @binding(3) var<storage, read> touched: array<Touched>;
@group(0) @binding(4) var<storage, read> bin_counts: array<u32>;
@group(0) @binding(5) var<storage, read> group_counts: array<u32>;
@group(0) @binding(6) var<storage, read> bin_starts: array<u32>;
@group(0) @binding(7) var<storage, read> slot_offsets: array<u32>;
@group(0) @binding(8) var<storage, read> block_slots: array<u32>;
@group(0) @binding(9) var<storage, read> status: array<u32>;
@group(0) @binding(10) var<storage, read_write> entries: array<vec4u>;
@group(0) @binding(11) var<storage, read_write> slot_begins: array<u32>;

var<workgroup> wg_begins: array<u32, WINDOW_BINS>; // start of the block's entries in each bin

@compute @workgroup_size(BLOCK)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = block_and_window(folded(wg, n_wgs), model.n_splats, view.n_tiles);
    let rank = at.block * BLOCK + lane;
    var touches = Touched(0u, 0u, 0u);
    if rank < model.n_splats { touches = touched[rank]; }
    if lane < at.n_bins && at.block < at.n_blocks {
        let n_bins = at.bins.x * at.bins.y;
        let bin = at.first_bin + lane;
        var begin = bin_starts[bin] + group_counts[at.block / GROUP * n_bins + bin];
        for (var i = 0u; i + 1u < GROUP; i++) {
            let block = min(at.block / GROUP * GROUP + i, at.block); // Later blocks are clamped to this block, which is not counted.
            begin += select(0u, bin_counts[block * n_bins + bin], block < at.block);
        }
        wg_begins[lane] = begin;
    }
    set_reached_bins(lane, at, touches);
    if status[N_ENTRIES] == 0u || rank >= model.n_splats { return; } // Past the last barrier.
    let splat_ix = by_depth[rank];
    var slot = block_slots[at.block] + slot_offsets[rank];
    if at.first_bin == 0u { slot_begins[splat_ix] = slot; }
    let reached = bins_of(touches);
    for (var row = reached.z; row < reached.w; row++) {
        for (var column = reached.x; column < reached.y; column++) {
            let tiles = tiles_in_bin(touches, column, row);
            let bin = row * at.bins.x + column - at.first_bin; // Wraps around if the bin is before the window.
            if bin < at.n_bins && tiles != 0u {
                entries[wg_begins[bin] + n_reaching(bin, lane)] = vec4u(splat_ix, tiles, slot, 0u);
            }
            slot += countOneBits(tiles);
        }
    }
}
