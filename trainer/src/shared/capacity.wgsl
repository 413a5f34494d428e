// capacity: how much there is memory for.

struct Capacity {
    n_entries: u32,    // of the bins' lists
    n_slots: u32,      // gradients of intersections; 0: nothing is learned, and they need no memory
    unused: vec2u,
}
