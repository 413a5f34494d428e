// segment: a part of a tile's list, which one workgroup of `backward` processes.
//
// The longest lists are about ten times the average, and a step would wait for them. `rasterize` therefore divides
// lists into segments. At the start of every segment except the first, it stores the state of the tile's pixels.

struct Segment {
    tile: u32,
    begin: u32,     // entries
    end: u32,
    unused: u32,
}

const SEGMENT_SPLATS = 128u;      // minimum length; a batch of `rasterize`
const TARGET_SEGMENTS = 16384u;   // lengths are rounded down to whole batches, so there can be twice as many
const N_STATE_PARTS = 5u;         // red, green, blue, depth, transmittance
const STATE_PAIRS = 128u;         // pairs of pixels in a tile: 32 quarter + lane
const HIDDEN_ENTRIES = 1024u;     // entries per piece of a list's hidden end

// Length of segments in batches, if the view has this many intersections.
fn batches_per_segment(n_slots: u32) -> u32 {
    return max(n_slots / (SEGMENT_SPLATS * TARGET_SEGMENTS), 1u);
}
