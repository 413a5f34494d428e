// status: counters stored on the GPU, one array for all kernels.

const N_SPLATS = 0u;       // written by the host
const N_ENTRIES = 1u;      // of this view's lists
const N_SLOTS = 2u;        // intersections of splats with tiles in this view
const FAILED = 3u;         // sticky: a buffer was too small; training stops until the host has grown it
const NEED_ENTRIES = 4u;   // maximum number of entries requested since the host last read this counter
const NEED_SLOTS = 5u;     // likewise for intersections
const STEP = 6u;           // optimizer updates so far
const N_NON_FINITE = 7u;     // splats whose gradient was dropped because it was non-finite
const FURTHEST = 8u;       // bits of the largest depth of this view; 0: nothing is visible
const NEAREST = 9u;        // bits of the smallest depth, inverted
const DROP_FRAC = 10u;     // written by the host: bits of the fraction of splats that a training step leaves out
const DROP_SEED = 11u;     // written by the host
