// sum_bins: count the entries of each group of 16 blocks in each bin.
//
// threads   256 per group and window of 256 bins, one lane per bin
// reads     view, model, bin_counts [n_blocks, n_bins]
// writes    group_counts [n_groups, n_bins]

#import view
#import model
#import bins

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> model: Model;
@group(0) @binding(2) var<storage, read> bin_counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> group_counts: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let bins = n_bins(view.n_tiles);
    let n_windows = (bins.x * bins.y + WINDOW_BINS - 1u) / WINDOW_BINS;
    let group = folded(wg, n_wgs) / n_windows;
    let bin = folded(wg, n_wgs) % n_windows * WINDOW_BINS + lane;
    let n_blocks = (model.n_splats + BLOCK - 1u) / BLOCK;
    if bin >= bins.x * bins.y || group * GROUP >= n_blocks { return; } // Allowed here: no barrier below.
    var sum = 0u;
    for (var i = 0u; i < GROUP; i++) {
        if group * GROUP + i < n_blocks { sum += bin_counts[(group * GROUP + i) * bins.x * bins.y + bin]; }
    }
    group_counts[group * bins.x * bins.y + bin] = sum;
}
