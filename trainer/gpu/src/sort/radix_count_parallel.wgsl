// radix_count_parallel: count the occurrences of each digit in each block of 2048 keys.
//
// threads   256 per block
// reads     digit, status, keys [n]
// writes    counts [256 digits, max_blocks]

#import folded
#import digit

@group(0) @binding(0) var<uniform> digit: Digit;
@group(0) @binding(1) var<storage, read> status: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;

var<workgroup> wg_counts: array<atomic<u32>, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let n = status[digit.counter];
    let key_range = key_range();
    let block = folded(wg, n_wgs);
    atomicStore(&wg_counts[lane], 0u);
    workgroupBarrier(); // All counts are zero before the first `atomicAdd`.
    for (var i = 0u; i < 8u; i++) {
        let at = block * 2048u + i * 256u + lane;
        if at < n { atomicAdd(&wg_counts[digit_of(keys[at], key_range)], 1u); } // Integer sums: the order does not matter.
    }
    workgroupBarrier(); // All keys are counted.
    if block < digit.max_blocks { counts[lane * digit.max_blocks + block] = atomicLoad(&wg_counts[lane]); }
}
