// tile: where a tile lies, and the list of its bin. For kernels that bind view, status and bin_starts.

struct Tile {
    in_grid: bool,
    corner: vec2u,     // pixels
    bit: u32,          // its own in entry_tiles
    begin: u32,        // of the bin's list
    end: u32,
}

fn tile_at(tile: u32) -> Tile {
    var out: Tile;
    out.in_grid = tile < view.n_tiles.x * view.n_tiles.y;
    let place = vec2u(tile % view.n_tiles.x, tile / view.n_tiles.x);
    out.corner = place * TILE_PX;
    out.bit = 1u << (place.y % BIN_TILES * BIN_TILES + place.x % BIN_TILES);
    if out.in_grid && status[FAILED] == 0u {
        let bin = place.y / BIN_TILES * n_bins(view.n_tiles).x + place.x / BIN_TILES;
        out.begin = bin_starts[bin];
        out.end = bin_starts[bin + 1u];
    }
    return out;
}
