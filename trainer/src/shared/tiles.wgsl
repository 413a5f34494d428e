// tiles: the tiles of 16 x 16 pixels that an ellipse can touch, determined exactly, row by row.
//
// source    extent of an ellipse within a band, as in Speedy-Splat (Hanson et al. 2024, AccuTile); widened by a
//           hundredth of a pixel so that rounding never excludes a pixel.

#import bins

struct Ellipse {
    mean_px: vec2f,
    conic: vec3f,       // A, B, C of A dx^2 + 2 B dx dy + C dy^2
    reach: f32,         // the form is at most this inside the ellipse: 2 ln(255 opacity)
}

const TILE_MARGIN_PX = 0.01;

fn determinant_of(ellipse: Ellipse) -> f32 {
    return ellipse.conic.x * ellipse.conic.z - ellipse.conic.y * ellipse.conic.y;
}

// First and past-the-last row of tiles.
fn tile_rows(ellipse: Ellipse, n_tiles: vec2u) -> vec2i {
    let half_height = sqrt(max(ellipse.reach * ellipse.conic.x / determinant_of(ellipse), 0.0)) + TILE_MARGIN_PX;
    let first = ceil(clamp(ellipse.mean_px.y - half_height, -1e6, 1e6) - 0.5);
    let last = floor(clamp(ellipse.mean_px.y + half_height, -1e6, 1e6) - 0.5);
    let begin = clamp(i32(floor(first / 16.0)), 0, i32(n_tiles.y));
    let end = clamp(i32(floor(last / 16.0)) + 1, begin, i32(n_tiles.y));
    return vec2i(begin, select(begin, end, last >= first));
}

// Leftmost and rightmost x of the ellipse between two heights relative to its mean; at least one height is within the
// ellipse.
fn span_between(ellipse: Ellipse, top: f32, bottom: f32) -> vec2f {
    let a = ellipse.conic.x;
    let b = ellipse.conic.y;
    let c = ellipse.conic.z;
    let determinant = determinant_of(ellipse);
    let half_width = sqrt(max(ellipse.reach * c / determinant, 0.0));
    let slant = b / c * half_width;
    let at_right = clamp(-slant, top, bottom);
    let at_left = clamp(slant, top, bottom);
    let right = (-b * at_right + sqrt(max(a * ellipse.reach - determinant * at_right * at_right, 0.0))) / a + TILE_MARGIN_PX;
    let left = (-b * at_left - sqrt(max(a * ellipse.reach - determinant * at_left * at_left, 0.0))) / a - TILE_MARGIN_PX;
    return ellipse.mean_px.x + vec2f(left, right);
}

// First and past-the-last column of tiles within a row of tiles.
fn tile_columns(ellipse: Ellipse, row: i32, n_tiles: vec2u) -> vec2i {
    let top = f32(row) * 16.0 + 0.5 - TILE_MARGIN_PX - ellipse.mean_px.y;
    let span = span_between(ellipse, top, top + 15.0 + 2.0 * TILE_MARGIN_PX);
    let first = ceil(clamp(span.x, -1e6, 1e6) - 0.5);
    let last = floor(clamp(span.y, -1e6, 1e6) - 0.5);
    let begin = clamp(i32(floor(first / 16.0)), 0, i32(n_tiles.x));
    let end = clamp(i32(floor(last / 16.0)) + 1, begin, i32(n_tiles.x));
    return vec2i(begin, select(begin, end, last >= first));
}

// Bit 2 row + column for each 8 x 8 quarter of the tile that the ellipse may touch.
fn quarters_touched(ellipse: Ellipse, corner_px: vec2f) -> u32 {
    let half_height = sqrt(max(ellipse.reach * ellipse.conic.x / determinant_of(ellipse), 0.0)) + TILE_MARGIN_PX;
    var quarters = 0u;
    for (var row = 0u; row < 2u; row++) {
        let top = corner_px.y + 8.0 * f32(row) + 0.5 - TILE_MARGIN_PX - ellipse.mean_px.y;
        let bottom = top + 7.0 + 2.0 * TILE_MARGIN_PX;
        let span = span_between(ellipse, top, bottom) - corner_px.x;
        let near = top <= half_height && bottom >= -half_height;
        quarters |= select(0u, 1u, near && span.x <= 7.5 && span.y >= 0.5) << (2u * row);
        quarters |= select(0u, 2u, near && span.x <= 15.5 && span.y >= 8.5) << (2u * row);
    }
    return quarters;
}

fn tiles_touched(ellipse: Ellipse, n_tiles: vec2u) -> Touched {
    let rows = tile_rows(ellipse, n_tiles);
    if rows.x >= rows.y { return Touched(0u, 0u, 0u); }
    let half_width = sqrt(max(ellipse.reach * ellipse.conic.z / determinant_of(ellipse), 0.0)) + TILE_MARGIN_PX;
    let first = floor((clamp(ellipse.mean_px.x - half_width, -1e6, 1e6) - 0.5) / 16.0);
    let last = floor((clamp(ellipse.mean_px.x + half_width, -1e6, 1e6) - 0.5) / 16.0);
    let columns = clamp(vec2i(i32(first), i32(last) + 1), vec2i(0), vec2i(i32(n_tiles.x)));
    if columns.x >= columns.y { return Touched(0u, 0u, 0u); }
    let bin = vec2i(columns.x, rows.x) / i32(BIN_TILES);
    if columns.y > (bin.x + 2) * i32(BIN_TILES) || rows.y > (bin.y + 2) * i32(BIN_TILES) {
        return Touched(LARGE, u32(columns.x) | u32(columns.y) << 16u, u32(rows.x) | u32(rows.y) << 16u);
    }
    var out = Touched(u32(bin.x) | u32(bin.y) << 16u, 0u, 0u);
    for (var row = rows.x; row < rows.y; row++) {
        let touched = tile_columns(ellipse, row, n_tiles) - bin.x * i32(BIN_TILES);
        let bits = bits_between(u32(touched.x), u32(max(touched.y, touched.x))); // Up to eight columns.
        let in_bin = u32(row - bin.y * i32(BIN_TILES));
        let spread = ((bits & 15u) | (bits & 240u) << 12u) << (in_bin % 4u * 4u);
        if in_bin < 4u { out.first |= spread; } else { out.second |= spread; }
    }
    return out;
}
