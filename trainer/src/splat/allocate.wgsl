// allocate: compute where each bin's list and each block's intersections begin, and whether they fit in the buffers.
//
// threads   one workgroup of 256
// reads     view, model, capacity, bin_totals [n_bins]
// writes    bin_starts [n_bins + 1], block_slots [n_blocks] (counts become offsets, in place), status, segment_counts [2]
//           (zeros)

#import view
#import model
#import scan
#import status
#import capacity
#import bins

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> model: Model;
@group(0) @binding(2) var<uniform> capacity: Capacity;
@group(0) @binding(3) var<storage, read> bin_totals: array<u32>;
@group(0) @binding(4) var<storage, read_write> bin_starts: array<u32>;
@group(0) @binding(5) var<storage, read_write> block_slots: array<u32>;
@group(0) @binding(6) var<storage, read_write> status: array<u32>;
@group(0) @binding(7) var<storage, read_write> segment_counts: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
    let bins = n_bins(view.n_tiles);
    let n_entries = scan_totals(lane, bins.x * bins.y);
    let n_slots = scan_slots(lane, (model.n_splats + BLOCK - 1u) / BLOCK);
    if lane == 0u {
        bin_starts[bins.x * bins.y] = n_entries;
        status[NEED_ENTRIES] = max(status[NEED_ENTRIES], n_entries);
        status[NEED_SLOTS] = max(status[NEED_SLOTS], n_slots);
        let fits = n_entries <= capacity.n_entries && (n_slots <= capacity.n_slots || capacity.n_slots == 0u);
        status[FURTHEST] = 0u; // This is reset for the next view, because this view is sorted already.
        status[NEAREST] = 0u;
        status[N_SLOTS] = n_slots;
        segment_counts[0] = 0u;
        segment_counts[1] = 0u;
        status[N_ENTRIES] = select(0u, n_entries, fits);
        if !fits { status[FAILED] = 1u; }
    }
}

fn scan_totals(lane: u32, n: u32) -> u32 {
    var before = 0u;
    for (var first = 0u; first < n; first += 256u) {
        var count = 0u;
        if first + lane < n { count = bin_totals[first + lane]; }
        var total = 0u;
        let offset = exclusive_scan(lane, count, &total);
        if first + lane < n { bin_starts[first + lane] = before + offset; }
        before += total;
    }
    return before;
}

// Each lane handles four blocks, because there are thousands of blocks.
fn scan_slots(lane: u32, n: u32) -> u32 {
    var before = 0u;
    for (var first = 0u; first < n; first += 1024u) {
        let at = first + 4u * lane;
        var counts = vec4u(0u);
        for (var i = 0u; i < 4u; i++) {
            if at + i < n { counts[i] = block_slots[at + i]; }
        }
        var total = 0u;
        var offset = before + exclusive_scan(lane, counts.x + counts.y + counts.z + counts.w, &total);
        for (var i = 0u; i < 4u; i++) {
            if at + i < n { block_slots[at + i] = offset; }
            offset += counts[i];
        }
        before += total;
    }
    return before;
}
