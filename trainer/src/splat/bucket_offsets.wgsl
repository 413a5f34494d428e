// bucket_offsets: cut every tile's list into buckets of 32 and number them.
//
// threads   one workgroup of 256
// reads     view, capacity, tile_ranges [n_tiles]
// writes    bucket_starts [n_tiles], status

#import view
#import scan
#import status
#import capacity

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> capacity: Capacity;
@group(0) @binding(2) var<storage, read> tile_ranges: array<vec2u>;
@group(0) @binding(3) var<storage, read_write> bucket_starts: array<u32>;
@group(0) @binding(4) var<storage, read_write> status: array<u32>;

fn n_buckets_of(tile: u32) -> u32 {
    let range = tile_ranges[tile];
    return (range.y - range.x + 31u) / 32u;
}

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
    let n_tiles = view.n_tiles.x * view.n_tiles.y;
    let share = (n_tiles + 255u) / 256u;
    let begin = min(lane * share, n_tiles);
    let end = min(begin + share, n_tiles);
    var sum = 0u;
    for (var tile = begin; tile < end; tile++) { sum += n_buckets_of(tile); }
    var total = 0u;
    var offset = exclusive_scan(lane, sum, &total);
    for (var tile = begin; tile < end; tile++) {
        bucket_starts[tile] = offset;
        offset += n_buckets_of(tile);
    }
    if lane == 0u {
        status[NEED_BUCKETS] = max(status[NEED_BUCKETS], total);
        let fits = total <= capacity.n_buckets;
        status[N_BUCKETS] = select(0u, total, fits);
        if !fits { status[FAILED] |= 2u; }
    }
}
