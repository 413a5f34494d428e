// count_blocks: sum the tile counts of each block of 1024 splats, taken in order of depth.
//
// threads   256 per block
// reads     model, by_depth [n_splats], tile_counts [n_splats]
// writes    block_sums [n_blocks]

#import view
#import model
#import scan

@group(0) @binding(0) var<uniform> model: Model;
@group(0) @binding(1) var<storage, read> by_depth: array<u32>;
@group(0) @binding(2) var<storage, read> tile_counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> block_sums: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = folded(wg, n_wgs);
    var sum = 0u;
    for (var i = 0u; i < 4u; i++) {
        let rank = block * 1024u + lane * 4u + i;
        if rank < model.n_splats { sum += tile_counts[by_depth[rank]]; }
    }
    var total = 0u;
    exclusive_scan(lane, sum, &total);
    if lane == 0u && block * 1024u < model.n_splats { block_sums[block] = total; }
}
