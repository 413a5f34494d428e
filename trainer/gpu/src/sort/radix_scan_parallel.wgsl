// radix_scan_parallel: for each digit, compute the number of keys in earlier blocks and in all blocks.
//
// threads   one workgroup of 256 per digit
// reads     digit, status
// writes    counts (in place), totals [256]

#import digit
#import scan

@group(0) @binding(0) var<uniform> digit: Digit;
@group(0) @binding(1) var<storage, read> status: array<u32>;
@group(0) @binding(2) var<storage, read_write> counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> totals: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(local_invocation_index) lane: u32) {
    let n_blocks = min((status[digit.counter] + 2047u) / 2048u, digit.max_blocks);
    let share = (n_blocks + 255u) / 256u;
    let begin = min(lane * share, n_blocks);
    let end = min(begin + share, n_blocks);
    let row = wg.x * digit.max_blocks;
    var sum = 0u;
    for (var block = begin; block < end; block++) { sum += counts[row + block]; }
    var total = 0u;
    var offset = exclusive_scan(lane, sum, &total);
    for (var block = begin; block < end; block++) {
        let n = counts[row + block];
        counts[row + block] = offset;
        offset += n;
    }
    if lane == 0u { totals[wg.x] = total; }
}
