// status: counters that live on the GPU, one array for all kernels.

const N_SPLATS = 0u;       // written by the host
const N_ENTRIES = 1u;      // of this view's lists
const FAILED = 3u;         // sticky: a buffer was too small; nothing is learned until the host has grown it
const NEED_ENTRIES = 4u;   // most entries asked for since the host last looked
const NEED_SLOTS = 5u;     // likewise of intersections
const STEP = 6u;           // optimiser updates so far
const N_NON_FINITE = 7u;     // splats whose gradient was not finite and was dropped
const FURTHEST = 8u;       // bits of the largest depth of this view; 0: nothing is seen
const NEAREST = 9u;        // those of the smallest, inverted
