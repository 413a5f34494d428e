// march_params: how rays are walked. After `ray_batch`.

struct March {
    step: f32,             // inside the inner cube
    max_samples: u32,     // of a ray, where there is room for so many of each; half as many where not, and so on
    n_cells: u32,          // of the occupancy along an axis
    first_ray: u32,        // of this batch among all of a picture
    max_found: u32,       // pieces of a ray that are looked for
    unused: u32,
    unused_2: vec2u,
}

// Pieces that are kept of those found: every `stride`-th from `phase` on, each standing for as many.
struct Thinning {
    stride: u32,
    phase: u32,
}

fn thinning_of(max_samples: u32, ray: Ray, n_found: u32) -> Thinning {
    let stride = max(1u, (n_found + max_samples - 1u) / max_samples);
    return Thinning(stride, min(u32(ray.jitter * f32(stride)), stride - 1u));
}
