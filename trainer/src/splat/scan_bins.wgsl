// scan_bins: per bin, how many entries come from earlier blocks; and how many there are in all.
//
// threads   one workgroup of 256 per bin
// reads     model, capacity
// writes    bin_counts [n_bins, n_blocks] (in place), bin_totals [n_bins]

#import view
#import model
#import scan
#import capacity

@group(0) @binding(0) var<uniform> model: Model;
@group(0) @binding(1) var<uniform> capacity: Capacity;
@group(0) @binding(2) var<storage, read_write> bin_counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> bin_totals: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let bin = folded(wg, n_wgs);
    let n_blocks = (model.n_splats + 255u) / 256u;
    var before = 0u;
    // Neighbouring lanes take neighbouring blocks.
    for (var first = 0u; first < n_blocks; first += 256u) {
        let at = bin * capacity.n_blocks + first + lane;
        var n = 0u;
        if first + lane < n_blocks { n = bin_counts[at]; }
        var total = 0u;
        let offset = exclusive_scan(lane, n, &total);
        if first + lane < n_blocks { bin_counts[at] = before + offset; }
        before += total;
    }
    if lane == 0u { bin_totals[bin] = before; }
}
