// radix_scan_sequential: compute the destination of the first key of each block and digit.
//
// threads   one workgroup of 256, one lane per digit
// reads     digit, status
// writes    counts (in place)

#import digit
#import scan

@group(0) @binding(0) var<uniform> digit: Digit;
@group(0) @binding(1) var<storage, read> status: array<u32>;
@group(0) @binding(2) var<storage, read_write> counts: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
    let n_blocks = min((status[digit.counter] + 255u) / 256u, digit.max_blocks);
    var sum = 0u;
    for (var block = 0u; block < n_blocks; block++) { sum += counts[block * 256u + lane]; }
    var total = 0u;
    var offset = exclusive_scan(lane, sum, &total);
    for (var block = 0u; block < n_blocks; block++) {
        let n = counts[block * 256u + lane];
        counts[block * 256u + lane] = offset;
        offset += n;
    }
}
