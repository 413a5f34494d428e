// block_bins: bit masks, in workgroup memory, of the splats of a block that reach each bin. Import after `bins`.

const WORDS = BLOCK / 32u;
var<workgroup> wg_reaching: array<atomic<u32>, 2048>; // [WINDOW_BINS, WORDS]

// The block and the window of bins that a workgroup processes.
struct BlockAndWindow {
    block: u32,
    n_blocks: u32,
    bins: vec2u,       // of the image
    first_bin: u32,    // of the window
    n_bins: u32,       // of the window
}

fn block_and_window(group: u32, n_splats: u32, n_tiles: vec2u) -> BlockAndWindow {
    let bins = n_bins(n_tiles);
    let n_windows = (bins.x * bins.y + WINDOW_BINS - 1u) / WINDOW_BINS;
    let first_bin = (group % n_windows) * WINDOW_BINS;
    let n_in_window = min(bins.x * bins.y - first_bin, WINDOW_BINS);
    return BlockAndWindow(group / n_windows, (n_splats + BLOCK - 1u) / BLOCK, bins, first_bin, n_in_window);
}

// Sets the bits of all lanes' splats. Every lane must call it. The bits may be read when it returns.
fn set_reached_bins(lane: u32, at: BlockAndWindow, touched: Touched) {
    for (var i = lane; i < at.n_bins * WORDS; i += BLOCK) { atomicStore(&wg_reaching[i], 0u); }
    workgroupBarrier(); // All bits are zero before the first is set.
    let reached = bins_of(touched);
    for (var row = reached.z; row < reached.w; row++) {
        for (var column = reached.x; column < reached.y; column++) {
            let bin = row * at.bins.x + column - at.first_bin; // Wraps around if the bin is before the window.
            if bin < at.n_bins && tiles_in_bin(touched, column, row) != 0u {
                atomicOr(&wg_reaching[bin * WORDS + lane / 32u], 1u << (lane % 32u));
            }
        }
    }
    workgroupBarrier(); // All bits are set.
}

// Number of the block's first `n` splats that reach a bin of the window.
fn n_reaching(bin: u32, n: u32) -> u32 {
    var sum = 0u;
    for (var word = 0u; word < WORDS; word++) {
        let n_bits = clamp(n, word * 32u, word * 32u + 32u) - word * 32u;
        let below = select((1u << n_bits) - 1u, 0xffffffffu, n_bits == 32u);
        sum += countOneBits(atomicLoad(&wg_reaching[bin * WORDS + word]) & below);
    }
    return sum;
}
