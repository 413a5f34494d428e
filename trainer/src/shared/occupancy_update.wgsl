// visit: which cells of the occupancy are looked at.

struct Visit {
    n_cells: u32,          // along an axis, a power of two
    n_points: u32,         // one a cell
    kept_frac: f32,        // of what was known, at each visit
    step: f32,             // inside the inner cube, in units of the scene's radius
}

// An odd factor visits every cell once before any cell twice.
fn visited_cell(visit: Visit, n_before: u32, ix: u32) -> u32 {
    return (n_before * visit.n_points + ix) * 2654435761u % (visit.n_cells * visit.n_cells * visit.n_cells);
}
