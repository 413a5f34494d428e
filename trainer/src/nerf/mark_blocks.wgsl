// mark_blocks: marks the groups and blocks that contain a marked cell, in both sets.
//
// threads   one per 32 groups or blocks of a set
// reads     occupancy_update (n_cells)
// writes    occupied (after the cells of a set: one bit per group, then one bit per block)

#import folded
#import occupancy_update
#import cell_blocks

@group(0) @binding(0) var<uniform> occupancy_update: OccupancyUpdate;
@group(0) @binding(1) var<storage, read_write> occupied: array<u32>;

fn any_in(first_word: u32, box: vec3u, side: u32) -> bool {
    for (var z = box.z * side; z < (box.z + 1u) * side; z++) {
        for (var y = box.y * side; y < (box.y + 1u) * side; y++) {
            // The cells of a row are in one word, because sides are powers of two up to 32.
            let first = box.x * side + occupancy_update.n_cells * (y + occupancy_update.n_cells * z);
            let row = occupied[first_word + first / 32u] >> (first % 32u);
            if (row & (0xffffffffu >> (32u - side))) != 0u { return true; }
        }
    }
    return false;
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let n_cells = occupancy_update.n_cells;
    let n_words = n_group_words(n_cells) + n_block_words(n_cells); // per set
    let thread = folded(wg, n_wgs) * 64u + lane;
    if thread >= 2u * n_words { return; }
    let first_word = thread / n_words * n_set_words(n_cells);
    let is_block = thread % n_words >= n_group_words(n_cells);
    let word = thread % n_words - select(0u, n_group_words(n_cells), is_block);
    let side = select(group_cells_of(n_cells), block_cells_of(n_cells), is_block);
    let n = n_cells / side;
    var bits = 0u;
    for (var bit = 0u; bit < 32u; bit++) {
        let ix = 32u * word + bit;
        if ix < n * n * n && any_in(first_word, vec3u(ix, ix / n, ix / n / n) % n, side) { bits |= 1u << bit; }
    }
    occupied[first_word + n_cell_words(n_cells) + thread % n_words] = bits;
}
