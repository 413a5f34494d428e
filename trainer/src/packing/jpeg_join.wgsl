// jpeg_join: join the words of the restart intervals.
//
// threads   32 per interval, 256 per workgroup
// reads     packing, coded [n_intervals, words_per_interval], n_coded [n_intervals] (offsets)
// writes    packed (coded words)

#import packing
#import folded

@group(0) @binding(0) var<uniform> packing: Packing;
@group(0) @binding(1) var<storage, read> coded: array<u32>;
@group(0) @binding(2) var<storage, read> n_coded: array<u32>;
@group(0) @binding(3) var<storage, read_write> packed: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let interval = folded(wg, n_wgs) * 8u + lane / 32u;
    if interval >= packing.n_intervals || packed[OVERFLOW] != 0u { return; } // Allowed here: no barrier below.
    let begin = n_coded[interval];
    var end = packed[TOTAL_WORDS];
    if interval + 1u < packing.n_intervals { end = n_coded[interval + 1u]; }
    for (var word = lane % 32u; word < end - begin; word += 32u) {
        packed[HEADER_WORDS + begin + word] = coded[interval * packing.words_per_interval + word];
    }
}
