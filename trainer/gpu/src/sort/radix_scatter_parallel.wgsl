// radix_scatter_parallel: move each key and its value to its destination; equal digits keep their order.
//
// threads   256 per block of 2048 keys; each subgroup owns consecutive keys
// reads     digit, status, keys [n], values [n], counts (scanned), totals [256]
// writes    keys_out [n], values_out [n]
// source    Merrill and Grimshaw 2011; ranking by ballots as in Ashkiani et al. 2016

#import folded
#import digit
#import scan
#import peers

@group(0) @binding(0) var<uniform> digit: Digit;
@group(0) @binding(1) var<storage, read> status: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
@group(0) @binding(4) var<storage, read> counts: array<u32>;
@group(0) @binding(5) var<storage, read> totals: array<u32>;
@group(0) @binding(6) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(7) var<storage, read_write> values_out: array<u32>;

override VALUES_ARE_INDICES: bool = false; // Set in the first pass, whose values are 0, 1, 2, ...
const ROUNDS = 8u;
var<workgroup> wg_ranks: array<atomic<u32>, 4096>; // [subgroup, digit]; subgroups have 16 lanes or more

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32,
    @builtin(subgroup_invocation_id) sub_lane: u32, @builtin(subgroup_size) sub_size: u32, @builtin(subgroup_id) subgroup: u32,
) {
    let n = status[digit.counter];
    let key_range = key_range();
    let block = folded(wg, n_wgs);
    let n_subgroups = 256u / sub_size;
    for (var i = 0u; i < n_subgroups; i++) { atomicStore(&wg_ranks[i * 256u + lane], 0u); }
    workgroupBarrier(); // All ranks start at zero.

    var ranks: array<u32, ROUNDS>;
    var digits: array<u32, ROUNDS>;
    let first = block * 2048u + subgroup * sub_size * ROUNDS + sub_lane;
    for (var round = 0u; round < ROUNDS; round++) {
        let at = first + round * sub_size;
        let valid = at < n;
        var key_digit = 0u;
        if valid { key_digit = digit_of(keys[at], key_range); }
        let peers = peers_of(key_digit, valid);
        let leader = lowest_lane(peers);
        var base = 0u;
        // Because of the shuffle, the leader of the next round waits for this sum. The rounds therefore count in order.
        if valid && sub_lane == leader { base = atomicAdd(&wg_ranks[subgroup * 256u + key_digit], n_bits(peers)); }
        base = subgroupShuffle(base, select(sub_lane, leader, valid));
        ranks[round] = base + n_bits(peers & lanes_below(sub_lane));
        digits[round] = key_digit;
    }
    workgroupBarrier(); // All keys are counted.

    var total = 0u;
    var offset = exclusive_scan(lane, totals[lane], &total);
    if block < digit.max_blocks { offset += counts[lane * digit.max_blocks + block]; }
    for (var i = 0u; i < n_subgroups; i++) {
        let count = atomicLoad(&wg_ranks[i * 256u + lane]);
        atomicStore(&wg_ranks[i * 256u + lane], offset);
        offset += count;
    }
    workgroupBarrier(); // Each subgroup's first destination per digit is known.

    for (var round = 0u; round < ROUNDS; round++) {
        let at = first + round * sub_size;
        if at < n {
            let destination = atomicLoad(&wg_ranks[subgroup * 256u + digits[round]]) + ranks[round];
            keys_out[destination] = keys[at];
            if VALUES_ARE_INDICES { values_out[destination] = at; } else { values_out[destination] = values[at]; }
        }
    }
}
