// occupancy_sum: scale of the integer sum of cell occupancies.

const MAX_SUM = 4294967040.0; // The sum if all cells are opaque; the largest f32 that fits into a u32.
