// radix_count_sequential: count the occurrences of each digit in each block of 256 keys, one thread per block.
//
// threads   one per block
// reads     digit, status, keys [n]
// writes    counts [max_blocks, 256 digits]
//
// Uses no barriers or subgroup operations: for adapters without them, and for CPUs, where barriers are expensive.

#import folded
#import digit

@group(0) @binding(0) var<uniform> digit: Digit;
@group(0) @binding(1) var<storage, read> status: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;

override WG_SIZE = 8u;
@compute @workgroup_size(WG_SIZE)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let n = status[digit.counter];
    let key_range = key_range();
    let block = folded(wg, n_wgs) * WG_SIZE + lane;
    if block * 256u >= n || block >= digit.max_blocks { return; } // Allowed here: no barrier below.
    for (var i = 0u; i < 256u; i++) { counts[block * 256u + i] = 0u; }
    for (var at = block * 256u; at < min(block * 256u + 256u, n); at++) {
        counts[block * 256u + digit_of(keys[at], key_range)] += 1u;
    }
}
