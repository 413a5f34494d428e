// visit: which cells of the occupancy are looked at.

struct OccupancyUpdate {
    n_cells: u32,          // along an axis, a power of two
    n_points: u32,         // one a cell
    decay: f32,        // of what was known, at each visit
    step: f32,             // inside the inner cube, in units of the scene's radius
}

// An odd factor visits every cell once before any cell twice.
fn updated_cell(occupancy_update: OccupancyUpdate, n_updates: u32, ix: u32) -> u32 {
    return (n_updates * occupancy_update.n_points + ix) * 2654435761u % (occupancy_update.n_cells * occupancy_update.n_cells * occupancy_update.n_cells);
}
