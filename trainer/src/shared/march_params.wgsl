// march_params: how rays are walked. After `ray_batch`.

struct March {
    step: f32,             // inside the inner cube
    most_samples: u32,     // of a ray, where there is room for so many of each; half as many where not, and so on
    n_cells: u32,          // of the occupancy along an axis
    first_ray: u32,        // of this batch among all of a picture
    most_found: u32,       // pieces of a ray that are looked for
    unused: u32,
    unused_too: vec2u,
}

// Pieces that are kept of those found: every `stride`-th from `phase` on, each standing for as many.
struct Thinning {
    stride: u32,
    phase: u32,
}

fn thinning_of(most_samples: u32, ray: Ray, n_found: u32) -> Thinning {
    let stride = max(1u, (n_found + most_samples - 1u) / most_samples);
    return Thinning(stride, min(u32(ray.shift * f32(stride)), stride - 1u));
}
