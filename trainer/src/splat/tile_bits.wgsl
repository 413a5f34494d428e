// tile_bits: transpose the entries' tile masks into one bit array for each of the bin's 16 tiles.
//
// threads   256 per 512 entries
// reads     status, entries [n_entries]
// writes    tile_bits [16, n_words]: bit i of word w belongs to entry 32 w + i

#import view
#import status

@group(0) @binding(0) var<storage, read> status: array<u32>;
@group(0) @binding(1) var<storage, read> entries: array<vec4u>;
@group(0) @binding(2) var<storage, read_write> tile_bits: array<u32>;

var<workgroup> wg_masks: array<u32, 528>; // 16 rows of 32, padded by one so that the rows begin in different banks

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let n = status[N_ENTRIES];
    let first = folded(wg, n_wgs) * 512u;
    for (var i = lane; i < 512u; i += 256u) {
        var mask = 0u;
        if first + i < n { mask = entries[first + i].y; }
        wg_masks[i / 32u * 33u + i % 32u] = mask;
    }
    workgroupBarrier(); // All masks are written.
    let n_words = arrayLength(&tile_bits) / 16u;
    let word = first / 32u + lane % 16u;
    if word * 32u >= n || word >= n_words { return; } // Past the last barrier.
    var bits = 0u;
    for (var i = 0u; i < 32u; i++) {
        bits |= ((wg_masks[lane % 16u * 33u + i] >> (lane / 16u)) & 1u) << i;
    }
    tile_bits[lane / 16u * n_words + word] = bits;
}
