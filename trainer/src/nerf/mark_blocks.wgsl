// mark_blocks: marks the blocks that contain an occupied cell.
//
// threads   one per 32 blocks
// reads     occupancy_update (n_cells)
// writes    occupied (after the cells: one bit per block)

#import folded
#import occupancy_update
#import cell_blocks

@group(0) @binding(0) var<uniform> occupancy_update: OccupancyUpdate;
@group(0) @binding(1) var<storage, read_write> occupied: array<u32>;

fn any_in(block: vec3u, size: u32) -> bool {
    for (var z = block.z * size; z < (block.z + 1u) * size; z++) {
        for (var y = block.y * size; y < (block.y + 1u) * size; y++) {
            // The cells of a row are in one word, because block sizes are powers of two up to 32.
            let first = block.x * size + occupancy_update.n_cells * (y + occupancy_update.n_cells * z);
            let row = occupied[first / 32u] >> (first % 32u);
            if (row & (0xffffffffu >> (32u - size))) != 0u { return true; }
        }
    }
    return false;
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let size = block_cells_of(occupancy_update.n_cells);
    let n_blocks = occupancy_update.n_cells / size;
    let word = folded(wg, n_wgs) * 64u + lane;
    if 32u * word >= n_blocks * n_blocks * n_blocks { return; }
    var bits = 0u;
    for (var bit = 0u; bit < 32u; bit++) {
        let ix = 32u * word + bit;
        let block = vec3u(ix, ix / n_blocks, ix / n_blocks / n_blocks) % n_blocks;
        if any_in(block, size) { bits |= 1u << bit; }
    }
    occupied[occupancy_update.n_cells * occupancy_update.n_cells * occupancy_update.n_cells / 32u + word] = bits;
}
