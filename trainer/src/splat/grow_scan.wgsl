// grow_scan: compute inclusive prefix sums of the blocks' weights.
//
// threads   one workgroup of 256
// reads     growth
// writes    block_weights (inclusive sums, in place)

#import growth
#import scan_f32

@group(0) @binding(0) var<uniform> growth: Growth;
@group(0) @binding(1) var<storage, read_write> block_weights: array<f32>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
    let n_blocks = (growth.n_before + 255u) / 256u;
    let blocks_per_lane = (n_blocks + 255u) / 256u;
    let begin = min(lane * blocks_per_lane, n_blocks);
    let end = min(begin + blocks_per_lane, n_blocks);
    var sum = 0.0;
    for (var block = begin; block < end; block++) { sum += block_weights[block]; }
    var running = inclusive_scan_f32(lane, sum) - sum;
    for (var block = begin; block < end; block++) {
        running += block_weights[block];
        block_weights[block] = running;
    }
}
