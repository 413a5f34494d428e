// capacity: sizes of buffers that can overflow.

struct Capacity {
    n_entries: u32,    // entries of the bins' lists
    n_slots: u32,      // gradients of intersections; 0 when not training, which needs no slots
    n_segments: u32,   // of lists, without the first segment of each; see `segment`
    unused: u32,
}
