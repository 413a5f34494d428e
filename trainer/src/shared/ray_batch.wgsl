// ray_batch: the rays of a step and their samples.

struct Batch {
    n_rays: u32,
    n_samples: u32,
}

struct Ray {
    origin_m: vec3f,
    first_sample: u32,
    direction: vec3f,       // of length 1
    n_samples: u32,
    code: u32,              // of the image it belongs to
    target_rgb: u32,        // rgba8; a = 0: not seen
    target_m: f32,          // distance along the ray, metres; 0: unknown
    unused: u32,
}

// A piece of a ray.
struct Span {
    begin_m: f32,
    end_m: f32,
    ray: u32,
    unused: u32,
}

fn folded(wg: vec3u, n_wgs: vec3u) -> u32 {
    return wg.y * n_wgs.x + wg.x;
}

fn middle_of(ray: Ray, span: Span) -> vec3f {
    return ray.origin_m + 0.5 * (span.begin_m + span.end_m) * ray.direction;
}
