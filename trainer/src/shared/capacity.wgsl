// capacity: how many intersections and buckets there is memory for.

struct Capacity {
    n_isect: u32,
    n_buckets: u32,
    unused: vec2u,
}
