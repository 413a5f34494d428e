// thickness_sum: the unit of the sum of what cells hold back, a whole number.

const MAX_SUM = 4294967040.0; // All cells hold back everything; the largest f32 that is a u32.
