// status: counters that live on the GPU, one array for all kernels.

const N_SPLATS = 0u;       // written by the host
const N_ISECT = 1u;        // intersections of this view
const N_BUCKETS = 2u;      // buckets of this view
const FAILED = 3u;         // sticky: a buffer was too small; nothing is learned until the host has grown it
const NEED_ISECT = 4u;     // most intersections asked for since the host last looked
const NEED_BUCKETS = 5u;   // likewise
const STEP = 6u;           // optimiser updates so far
const N_POISONED = 7u;     // splats whose gradient was not finite and was dropped
