// bins: squares of 4 x 4 tiles. A splat is listed once per bin, with a mask of the tiles that it touches there.
//
// There are few lists with many entries. Sorting splats into bins is much faster than sorting them into tiles. A tile
// finds its splats by testing one bit per entry of its bin's list. `count_bins` determines the tiles of each splat once
// and stores the result as integers.

const BIN_TILES = 4u;
const BLOCK = 256u;        // splats per workgroup, consecutive in depth order
const WINDOW_BINS = 256u;  // bins that a workgroup processes
const GROUP = 16u;         // blocks whose counts one workgroup sums

// The tiles that a splat touches.
struct Touched {
    bin: u32,              // column and row (high 16 bits) of its first bin
    first: u32,            // bit 4 row + column of the tiles in that bin; high 16 bits: in the bin to the right
    second: u32,           // the same, one row of bins below
}

// A larger splat touches all tiles of a rectangle: `first` and `second` hold its first and past-the-last column and
// row.
const LARGE = 0xffffffffu; // value of `bin`

fn n_bins(n_tiles: vec2u) -> vec2u {
    return (n_tiles + vec2u(BIN_TILES - 1u)) / BIN_TILES;
}

// First and past-the-last column (x, y) and row (z, w) of the bins.
fn bins_of(touched: Touched) -> vec4u {
    if touched.bin == LARGE {
        let columns = vec2u(touched.first & 0xffffu, touched.first >> 16u);
        let rows = vec2u(touched.second & 0xffffu, touched.second >> 16u);
        return vec4u(columns.x / BIN_TILES, (columns.y + 3u) / BIN_TILES, rows.x / BIN_TILES, (rows.y + 3u) / BIN_TILES);
    }
    if (touched.first | touched.second) == 0u { return vec4u(0u); }
    let bin = vec2u(touched.bin & 0xffffu, touched.bin >> 16u);
    let n_columns = select(1u, 2u, ((touched.first | touched.second) >> 16u) != 0u);
    return vec4u(bin.x, bin.x + n_columns, bin.y, bin.y + select(1u, 2u, touched.second != 0u));
}

fn bits_between(begin: u32, end: u32) -> u32 {
    return (1u << end) - (1u << min(begin, end));
}

// Mask of the tiles that the splat touches in one of these bins.
fn tiles_in_bin(touched: Touched, column: u32, row: u32) -> u32 {
    if touched.bin == LARGE {
        let corner = vec2u(column, row) * BIN_TILES;
        let from_ = max(vec2u(touched.first & 0xffffu, touched.second & 0xffffu), corner) - corner;
        let to = min(max(vec2u(touched.first >> 16u, touched.second >> 16u), corner) - corner, vec2u(BIN_TILES));
        let columns = bits_between(from_.x, to.x);
        let rows = bits_between(from_.y, to.y);
        return columns * ((rows & 1u) | (rows & 2u) << 3u | (rows & 4u) << 6u | (rows & 8u) << 9u);
    }
    let pair = select(touched.second, touched.first, row == touched.bin >> 16u);
    return select(pair >> 16u, pair & 0xffffu, column == (touched.bin & 0xffffu));
}

fn n_tiles_of(touched: Touched) -> u32 {
    if touched.bin != LARGE { return countOneBits(touched.first) + countOneBits(touched.second); }
    return ((touched.first >> 16u) - (touched.first & 0xffffu)) * ((touched.second >> 16u) - (touched.second & 0xffffu));
}
