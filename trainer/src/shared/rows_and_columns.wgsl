// rows_and_columns: windows of 11 x 11 pixels for a workgroup of 8 lanes in one subgroup. They are for adapters whose
// lanes access memory one after another. The workgroup reads each value once and shares it between windows by shuffles.
//
// A lane holds 4 neighboring pixels of a row, and the workgroup moves down the rows. The two outer lanes on each side
// only supply the border; the inner lanes cover the width of a tile. Import after `supervision`.

const LANES = 8u;
const STRIP_TILES = 2u;    // tiles per workgroup, one below the other
const N_ROWS = STRIP_TILES * TILE_PX + 2u * HALO; // rows to read

// The strip that a workgroup processes.
struct ColorStrip {
    in_grid: bool,
    channel: u32,
    corner: vec2i,     // of the lane's pixels in the first row that is read
    writes: bool,      // false for lanes that only supply the border
}

fn color_strip(group: u32, lane: u32, n_tiles: vec2u) -> ColorStrip {
    let strip = group / 3u;
    let column = strip % n_tiles.x * TILE_PX;
    let row = strip / n_tiles.x * STRIP_TILES * TILE_PX;
    let corner = vec2i(vec2u(column + 4u * lane, row)) - vec2i(8, i32(HALO));
    let in_grid = row < n_tiles.y * TILE_PX;
    let writes = lane >= 2u && lane < 6u;
    return ColorStrip(in_grid, group % 3u, corner, writes);
}

const G = GAUSSIAN;

// Partial sums of the windows that end one, two, ... rows further down.
struct Windows {
    in_1: vec4f,
    in_2: vec4f,
    in_3: vec4f,
    in_4: vec4f,
    in_5: vec4f,
    in_6: vec4f,
    in_7: vec4f,
    in_8: vec4f,
    in_9: vec4f,
    in_10: vec4f,
}

// Adds a row to the windows and returns the vertical sums of the window that ends at this row.
fn add_row(windows: ptr<function, Windows>, row: vec4f) -> vec4f {
    let before = *windows;
    let finished = before.in_1 + G[10] * row;
    *windows = Windows(
        before.in_2 + G[9] * row,
        before.in_3 + G[8] * row,
        before.in_4 + G[7] * row,
        before.in_5 + G[6] * row,
        before.in_6 + G[5] * row,
        before.in_7 + G[4] * row,
        before.in_8 + G[3] * row,
        before.in_9 + G[2] * row,
        before.in_10 + G[1] * row,
        G[0] * row,
    );
    return finished;
}

// Horizontal sums around each of the lane's pixels. The Gaussian is symmetric.
fn along_row(lane: u32, own: vec4f) -> vec4f {
    let left = subgroupShuffle(own, (lane - 1u) & 7u);
    let right = subgroupShuffle(own, (lane + 1u) & 7u);
    let far_left = subgroupShuffle(own.w, (lane - 2u) & 7u);
    let far_right = subgroupShuffle(own.x, (lane + 2u) & 7u);
    return G[5] * own
        + G[4] * (vec4f(left.w, own.xyz) + vec4f(own.yzw, right.x))
        + G[3] * (vec4f(left.zw, own.xy) + vec4f(own.zw, right.xy))
        + G[2] * (vec4f(left.yzw, own.x) + vec4f(own.w, right.xyz))
        + G[1] * (left + right)
        + G[0] * (vec4f(far_left, left.xyz) + vec4f(right.yzw, far_right));
}
