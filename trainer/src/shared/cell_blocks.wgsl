// cell_blocks: the bits of occupancy cells, of groups of cells, and of blocks of groups, one after another. Two such sets
// follow each other: cells to sample, and the solid cells among them.

const MAX_BLOCKS = 16u; // along an axis
const MAX_GROUPS = 64u;

// Cells per block along an axis, for a grid of `n_cells`.
fn block_cells_of(n_cells: u32) -> u32 {
    return max(n_cells / MAX_BLOCKS, 1u);
}

// Cells per group along an axis.
fn group_cells_of(n_cells: u32) -> u32 {
    return max(n_cells / MAX_GROUPS, 1u);
}

// Number of words for one bit per box of `side` cells along an axis.
fn n_words_of(n_cells: u32, side: u32) -> u32 {
    let n = n_cells / side;
    return (n * n * n + 31u) / 32u;
}

fn n_cell_words(n_cells: u32) -> u32 {
    return n_words_of(n_cells, 1u);
}

fn n_group_words(n_cells: u32) -> u32 {
    return n_words_of(n_cells, group_cells_of(n_cells));
}

fn n_block_words(n_cells: u32) -> u32 {
    return n_words_of(n_cells, block_cells_of(n_cells));
}

fn n_set_words(n_cells: u32) -> u32 {
    return n_cell_words(n_cells) + n_group_words(n_cells) + n_block_words(n_cells);
}

// Sides of groups and blocks in cells, as log2, and the words at which their bits begin in a set.
struct Boxes {
    log2_cells: u32,
    log2_group: u32,
    log2_block: u32,
    group_word: u32,
    block_word: u32,
    set_words: u32,
}

fn boxes_of(n_cells: u32) -> Boxes {
    let group_word = n_cell_words(n_cells);
    let sides = firstTrailingBit(vec3u(n_cells, group_cells_of(n_cells), block_cells_of(n_cells)));
    return Boxes(sides.x, sides.y, sides.z, group_word, group_word + n_group_words(n_cells), n_set_words(n_cells));
}
