// occupancy_sum: unit of the sum of cell occupancies, an integer.

const MAX_SUM = 4294967040.0; // The sum if all cells are opaque; the largest f32 that is a u32.
