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
    var before = 0u;
    for (var first = 0u; first < packing.n_intervals; first += 256u) {
        var n_words = 0u;
        if first + lane < packing.n_intervals { n_words = n_coded[first + lane]; }
        var total = 0u;
        let offset = exclusive_scan(lane, n_words, &total);
        if first + lane < packing.n_intervals { n_coded[first + lane] = before + offset; }
        before += total;
    }
    if lane == 0u {
        packed[TOTAL_WORDS] = before;
        if before > packing.n_words { packed[OVERFLOW] = 1u; }
    }
}
