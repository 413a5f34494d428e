// radix_scatter_sequential: move each key and its value to its destination; equal digits keep their order.
//
// threads   one per block of 256 keys
// reads     digit, status, keys [n], values [n]
// writes    counts (overwritten), keys_out [n], values_out [n]

#import folded
#import digit

@group(0) @binding(0) var<uniform> digit: Digit;
@group(0) @binding(1) var<storage, read> status: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_out: array<u32>;

override VALUES_ARE_INDICES: bool = false; // Set in the first pass, whose values are 0, 1, 2, ...
override WG_SIZE = 8u;
@compute @workgroup_size(WG_SIZE)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let n = status[digit.counter];
    let key_range = key_range();
    let block = folded(wg, n_wgs) * WG_SIZE + lane;
    if block * 256u >= n || block >= digit.max_blocks { return; } // Allowed here: no barrier below.
    for (var at = block * 256u; at < min(block * 256u + 256u, n); at++) {
        let key = keys[at];
        let slot = block * 256u + digit_of(key, key_range);
        let destination = counts[slot];
        counts[slot] = destination + 1u;
        keys_out[destination] = key;
        if VALUES_ARE_INDICES { values_out[destination] = at; } else { values_out[destination] = values[at]; }
    }
}
