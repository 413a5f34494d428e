// block_bins: which splats of a block reach which bins, as bits in workgroup memory. For count_bins and emit, whose
// bindings it uses.

const WORDS = BLOCK / 32u;
var<workgroup> wg_reaching: array<atomic<u32>, 2048>; // [WINDOW_BINS, WORDS]

struct BlockAndWindow {
    block: u32,
    first_bin: u32,
    n_bins: u32,       // of the window
    row: u32,          // of the window's first bin in bin_counts
}

fn n_blocks_in_use() -> u32 {
    return (model.n_splats + BLOCK - 1u) / BLOCK;
}

fn block_and_window(group: u32) -> BlockAndWindow {
    let bins = n_bins(view.n_tiles);
    let n_windows = (bins.x * bins.y + WINDOW_BINS - 1u) / WINDOW_BINS;
    let first_bin = (group % n_windows) * WINDOW_BINS;
    let block = group / n_windows;
    return BlockAndWindow(block, first_bin, min(bins.x * bins.y - first_bin, WINDOW_BINS), block * bins.x * bins.y + first_bin);
}

// The splat of a lane and its ellipse; one that is not drawn reaches nothing.
struct Listed {
    splat_ix: u32,
    ellipse: Ellipse,
    rows: vec2i,       // of tiles
}

fn listed_splat(lane: u32, block: u32) -> Listed {
    var out: Listed;
    let rank = block * BLOCK + lane;
    if rank >= model.n_splats { return out; }
    out.splat_ix = by_depth[rank];
    if tile_counts[out.splat_ix] == 0u { return out; }
    let place = drawn[out.splat_ix].place;
    let conic = drawn[out.splat_ix].conic;
    out.ellipse = Ellipse(place.xy, conic.xyz, conic.w);
    out.rows = tile_rows(out.ellipse, view.n_tiles);
    return out;
}

fn bin_rows(listed: Listed) -> vec2i {
    return select(vec2i(0), vec2i(listed.rows.x / 4, (listed.rows.y + 3) / 4), listed.rows.y > listed.rows.x);
}

// Sets the bits of every lane's splat. Every lane must call it; the bits may be read when it returns.
fn mark_bins(lane: u32, at: BlockAndWindow) {
    for (var i = lane; i < at.n_bins * WORDS; i += BLOCK) { atomicStore(&wg_reaching[i], 0u); }
    workgroupBarrier(); // All bits are zero before the first is set.
    let listed = listed_splat(lane, at.block);
    let bin_rows = bin_rows(listed);
    let n_columns = n_bins(view.n_tiles).x;
    for (var row = bin_rows.x; row < bin_rows.y; row++) {
        let bin_row = bin_row(listed.ellipse, row, listed.rows, view.n_tiles);
        let columns = bin_columns(bin_row);
        for (var column = columns.x; column < columns.y; column++) {
            let bin = u32(row) * n_columns + u32(column) - at.first_bin; // Wraps where the bin is before the window.
            if bin < at.n_bins && tiles_in_bin(bin_row, column) != 0u {
                atomicOr(&wg_reaching[bin * WORDS + lane / 32u], 1u << (lane % 32u));
            }
        }
    }
    workgroupBarrier(); // All bits are set.
}

// How many of the block's first `n` splats reach a bin of the window.
fn n_marked(bin: u32, n: u32) -> u32 {
    var sum = 0u;
    for (var word = 0u; word < WORDS; word++) {
        let n_bits = clamp(n, word * 32u, word * 32u + 32u) - word * 32u;
        let below = select((1u << n_bits) - 1u, 0xffffffffu, n_bits == 32u);
        sum += countOneBits(atomicLoad(&wg_reaching[bin * WORDS + word]) & below);
    }
    return sum;
}
