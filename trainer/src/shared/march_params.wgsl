// march_params: parameters for walking rays. Import after `ray_batch`.

struct March {
    step: f32,             // inside the inner cube
    max_samples: u32,     // per ray; halved until the samples of all rays fit into the buffers
    n_cells: u32,          // cells of the occupancy grid along an axis
    first_ray: u32,        // index of this batch's first ray within a picture
    max_found: u32,       // maximum number of segments to find per ray
    pixel_stride: u32,     // of a picture: 4 to find the distances at which its surfaces begin, then 1
    unused: vec2u,
}

// Selects every `stride`-th found segment, starting at `phase`. Each selected segment represents `stride` segments.
struct Thinning {
    stride: u32,
    phase: u32,
}

fn thinning_of(max_samples: u32, ray: Ray, n_found: u32) -> Thinning {
    let stride = max(1u, (n_found + max_samples - 1u) / max_samples);
    return Thinning(stride, min(u32(ray.jitter * f32(stride)), stride - 1u));
}
