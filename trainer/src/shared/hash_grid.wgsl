// hash_grid: the grid entries of a level around a point.

struct Level {
    n_cells: u32,
    begin: u32,             // index of its first entry
    mask: u32,              // number of entries, a power of two, minus one; 0: one entry per corner
    unused: u32,
}

struct Cell {
    first: vec3u,           // corner with the smallest coordinates
    share: vec3f,           // position between the first corner and the opposite one, 0 to 1
}

fn cell_of(level: Level, at: vec3f) -> Cell {
    let scaled = clamp(at, vec3f(0.0), vec3f(1.0)) * f32(level.n_cells);
    let first = min(vec3u(scaled), vec3u(level.n_cells - 1u));
    return Cell(first, scaled - vec3f(first));
}

// source: Mueller et al. 2022, equation 4
fn entry_of(level: Level, corner: vec3u) -> u32 {
    if level.mask == 0u {
        let side = level.n_cells + 1u;
        return level.begin + corner.x + side * (corner.y + side * corner.z);
    }
    return level.begin + ((corner.x ^ (corner.y * 2654435761u) ^ (corner.z * 805459861u)) & level.mask);
}

fn step_of(ix: u32) -> vec3u {
    return vec3u(ix, ix >> 1u, ix >> 2u) & vec3u(1u);
}

fn weight_of(cell: Cell, step: vec3u) -> f32 {
    let parts = select(1.0 - cell.share, cell.share, step == vec3u(1u));
    return parts.x * parts.y * parts.z;
}
