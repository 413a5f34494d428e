// occupancy_update: selects the cells of the occupancy grid to update.

struct OccupancyUpdate {
    n_cells: u32,          // along an axis, a power of two
    n_points: u32,         // one per cell
    decay: f32,        // of the previous occupancy, per update
    step: f32,             // inside the inner cube, in units of the scene radius
}

// Because the factor is odd, every cell is updated once before any cell is updated twice.
fn updated_cell(occupancy_update: OccupancyUpdate, n_updates: u32, ix: u32) -> u32 {
    return (n_updates * occupancy_update.n_points + ix) * 2654435761u % (occupancy_update.n_cells * occupancy_update.n_cells * occupancy_update.n_cells);
}
