// scan_blocks: turn the blocks' sums into offsets and decide whether the intersections fit.
//
// threads   one workgroup of 256
// reads     model, block_sums [n_blocks]
// writes    block_sums (offsets, in place), status

#import model
#import scan
#import status
#import capacity

@group(0) @binding(0) var<uniform> model: Model;
@group(0) @binding(1) var<uniform> capacity: Capacity;
@group(0) @binding(2) var<storage, read_write> block_sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> status: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
    let n_blocks = (model.n_splats + 1023u) / 1024u;
    let share = (n_blocks + 255u) / 256u;
    let begin = min(lane * share, n_blocks);
    let end = min(begin + share, n_blocks);
    var sum = 0u;
    for (var block = begin; block < end; block++) { sum += block_sums[block]; }
    var total = 0u;
    var offset = exclusive_scan(lane, sum, &total);
    for (var block = begin; block < end; block++) {
        let n = block_sums[block];
        block_sums[block] = offset;
        offset += n;
    }
    if lane == 0u {
        status[NEED_ISECT] = max(status[NEED_ISECT], total);
        let fits = total <= capacity.n_isect;
        status[N_ISECT] = select(0u, total, fits);
        if !fits { status[FAILED] |= 1u; }
    }
}
