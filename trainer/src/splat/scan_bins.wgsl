// scan_bins: for each bin, sum the entries of all earlier groups (exclusive prefix sums) and of all groups (total).
//
// threads   one workgroup of 256 per bin
// reads     view, model
// writes    group_counts [n_groups, n_bins] (in place), bin_totals [n_bins]

#import view
#import model
#import bins
#import scan

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> model: Model;
@group(0) @binding(2) var<storage, read_write> group_counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> bin_totals: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let bin = folded(wg, n_wgs);
    let bins = n_bins(view.n_tiles);
    let n_groups = (model.n_splats + BLOCK * GROUP - 1u) / (BLOCK * GROUP);
    var before = 0u;
    for (var first = 0u; first < n_groups; first += 256u) {
        let at = (first + lane) * bins.x * bins.y + bin;
        var n = 0u;
        if first + lane < n_groups { n = group_counts[at]; }
        var total = 0u;
        let offset = exclusive_scan(lane, n, &total);
        if first + lane < n_groups { group_counts[at] = before + offset; }
        before += total;
    }
    if lane == 0u { bin_totals[bin] = before; }
}
