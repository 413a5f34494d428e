// count_bins: how many splats of each block reach each bin.
//
// threads   256 per block of 256 splats, taken in order of depth, and window of 256 bins
// reads     view, model, by_depth, tile_counts, drawn
// writes    bin_counts [n_blocks, n_bins]

#import view
#import model
#import bins
#import block_bins

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> model: Model;
@group(0) @binding(2) var<storage, read> by_depth: array<u32>;
@group(0) @binding(3) var<storage, read> tile_counts: array<u32>;
@group(0) @binding(4) var<storage, read> drawn: array<Drawn>;
@group(0) @binding(5) var<storage, read_write> bin_counts: array<u32>;

@compute @workgroup_size(BLOCK)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = block_and_window(folded(wg, n_wgs));
    mark_bins(lane, at);
    if at.block >= n_blocks_in_use() { return; } // Past the last barrier.
    if lane < at.n_bins { bin_counts[at.row + lane] = n_marked(lane, BLOCK); }
}
