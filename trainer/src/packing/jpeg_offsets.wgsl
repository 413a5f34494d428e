// jpeg_offsets: where the words of each restart interval begin in the file.
//
// threads   one workgroup of 256
// reads     packing
// writes    n_coded [n_intervals] (numbers become offsets, in place), packed (TOTAL_WORDS, OVERFLOW)

#import packing
#import scan

@group(0) @binding(0) var<uniform> packing: Packing;
@group(0) @binding(1) var<storage, read_write> n_coded: array<u32>;
@group(0) @binding(2) var<storage, read_write> packed: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
    // Each lane handles neighboring intervals, so that one scan suffices.
    let n_per_lane = (packing.n_intervals + 255u) / 256u;
    let first = min(lane * n_per_lane, packing.n_intervals);
    let end = min(first + n_per_lane, packing.n_intervals);
    var n_words = 0u;
    for (var interval = first; interval < end; interval++) { n_words += n_coded[interval]; }
    var total = 0u;
    var offset = exclusive_scan(lane, n_words, &total);
    for (var interval = first; interval < end; interval++) {
        let n = n_coded[interval];
        n_coded[interval] = offset;
        offset += n;
    }
    if lane == 0u {
        packed[TOTAL_WORDS] = total;
        if total > packing.n_words { packed[OVERFLOW] = 1u; }
    }
}
