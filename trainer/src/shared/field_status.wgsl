// field_status: counters of the field, stored on the GPU.

const N_BLOCKS = 0u;       // requested so far, including blocks that did not fit
const N_VISIBLE = 1u;      // of this depth image
const FAILED = 2u;         // sticky: the pool or the table was too small; nothing is fused until the host has grown it
const TABLE_FULL = 3u;     // whether the table of chunks was too small
const N_FUSED = 4u;       // depth images fused so far
const N_OUTSIDE = 5u;      // requests (one per reading) for blocks too far out to have a key
const BOUNDS_HIGH = 6u;    // 3: largest chunk coordinate plus BOUNDS_BIAS; 0: no chunks
const BOUNDS_LOW = 9u;     // 3: BOUNDS_BIAS minus the smallest
const N_CHUNKS = 12u;
const STOPPED = 13u;       // a depth image failed: later ones are skipped until the host repeats it
const BOUNDS_BIAS = 2048;
