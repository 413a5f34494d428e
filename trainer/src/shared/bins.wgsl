// bins: squares of 4 x 4 tiles. A splat is listed once a bin, with a mask of the tiles it touches there.
//
// Few lists of many entries: sorting splats into them costs a fraction of sorting them into tiles, and a tile finds its
// own in its bin's list by one bit each.

#import tiles

const BIN_TILES = 4u;
const BLOCK = 256u;        // splats of a workgroup, neighbours in depth
const WINDOW_BINS = 256u;  // bins a workgroup looks at
const GROUP = 32u;         // blocks whose counts are summed by one workgroup

fn n_bins(n_tiles: vec2u) -> vec2u {
    return (n_tiles + vec2u(BIN_TILES - 1u)) / BIN_TILES;
}

// The columns of tiles that an ellipse touches in the four rows of tiles of a row of bins.
struct BinRow {
    begin: vec4i,
    end: vec4i,
}

fn bin_row(ellipse: Ellipse, row: i32, tile_rows: vec2i, n_tiles: vec2u) -> BinRow {
    // Four by name: indexing by a variable would put them into memory.
    let a = columns_of_row(ellipse, row * 4, tile_rows, n_tiles);
    let b = columns_of_row(ellipse, row * 4 + 1, tile_rows, n_tiles);
    let c = columns_of_row(ellipse, row * 4 + 2, tile_rows, n_tiles);
    let d = columns_of_row(ellipse, row * 4 + 3, tile_rows, n_tiles);
    return BinRow(vec4i(a.x, b.x, c.x, d.x), vec4i(a.y, b.y, c.y, d.y));
}

fn columns_of_row(ellipse: Ellipse, row: i32, tile_rows: vec2i, n_tiles: vec2u) -> vec2i {
    if row < tile_rows.x || row >= tile_rows.y { return vec2i(0); }
    return tile_columns(ellipse, row, n_tiles);
}

// First and past-the-last column of bins.
fn bin_columns(row: BinRow) -> vec2i {
    let some = row.end > row.begin;
    let begin = select(vec4i(0x7fffffff), row.begin, some);
    let end = select(vec4i(0), row.end, some);
    let first = min(min(begin.x, begin.y), min(begin.z, begin.w)) / 4;
    return vec2i(first, max(first, (max(max(end.x, end.y), max(end.z, end.w)) + 3) / 4));
}

// Bit 4 row + column for each tile of the bin that is touched.
fn tiles_in_bin(row: BinRow, column: i32) -> u32 {
    let begin = vec4u(clamp(row.begin - column * 4, vec4i(0), vec4i(4)));
    let end = max(vec4u(clamp(row.end - column * 4, vec4i(0), vec4i(4))), begin);
    let bits = ((vec4u(1u) << end) - (vec4u(1u) << begin)) << vec4u(0u, 4u, 8u, 12u);
    return bits.x | bits.y | bits.z | bits.w;
}
