// tile: the position of a tile, the list of its bin, and bindings shared by all kernels that run per tile.

#import view
#import model
#import projection
#import bins
#import status

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> status: array<u32>;
@group(0) @binding(2) var<storage, read> bin_starts: array<u32>;
@group(0) @binding(3) var<storage, read> tile_bits: array<u32>;
@group(0) @binding(4) var<storage, read> entries: array<vec4u>; // splat, tiles, slot
@group(0) @binding(5) var<storage, read> projected_splats: array<ProjectedSplat>;

struct Tile {
    in_grid: bool,
    corner: vec2u,     // pixels
    in_bin: u32,       // the tile's bit in the entries' masks and its plane of tile_bits
    list_begin: u32,   // of the bin's list
    begin: u32,        // of the entries to process
    end: u32,
}

fn tile_at(tile: u32) -> Tile {
    var out: Tile;
    out.in_grid = tile < view.n_tiles.x * view.n_tiles.y;
    let position = vec2u(tile % view.n_tiles.x, tile / view.n_tiles.x);
    out.corner = position * TILE_PX;
    out.in_bin = position.y % BIN_TILES * BIN_TILES + position.x % BIN_TILES;
    if out.in_grid && status[FAILED] == 0u {
        let bin = position.y / BIN_TILES * n_bins(view.n_tiles).x + position.x / BIN_TILES;
        out.list_begin = bin_starts[bin];
        out.begin = out.list_begin;
        out.end = bin_starts[bin + 1u];
    }
    return out;
}

// Mask of the entries 32 word to 32 word + 31 that the tile must process.
fn entries_of(tile: Tile, word: u32) -> u32 {
    if word * 32u >= tile.end { return 0u; }
    var bits = tile_bits[arrayLength(&tile_bits) / 16u * tile.in_bin + word];
    if word * 32u < tile.begin { bits &= 0xffffffffu << (tile.begin - word * 32u); }
    if tile.end - word * 32u < 32u { bits &= (1u << (tile.end - word * 32u)) - 1u; }
    return bits;
}
