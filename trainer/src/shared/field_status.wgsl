// field_status: counters of the field that live on the GPU.

const N_BLOCKS = 0u;       // asked for so far, those included that found no room
const N_VISIBLE = 1u;      // of this frame
const FAILED = 2u;         // sticky: the pool or the table was too small; nothing is fused until the host has grown it
const TABLE_FULL = 3u;     // whether it was the table of chunks
const N_FUSED = 4u;       // fused so far
const N_OUTSIDE = 5u;      // blocks asked for, once a reading, that lie too far out to have a key
const BOUNDS_HIGH = 6u;    // 3: largest chunk coordinate plus BOUNDS_BIAS; 0: there is no chunk
const BOUNDS_LOW = 9u;     // 3: BOUNDS_BIAS minus the smallest
const N_CHUNKS = 12u;
const STOPPED = 13u;       // a frame failed: those after it do nothing, so that each finds what it should
const BOUNDS_BIAS = 2048;
