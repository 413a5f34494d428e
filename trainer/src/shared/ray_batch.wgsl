// ray_batch: the rays of a step and their samples.

struct Batch {
    n_rays: u32,
    n_samples: u32,
    max_samples: u32,      // of a ray, so that all rays find room
    unused: u32,
}

struct Ray {
    origin: vec3f,          // in units of the scene's radius, as all lengths here
    first_sample: u32,
    direction: vec3f,       // of length 1
    n_samples: u32,
    begin: f32,             // along the ray: what lies before is not looked at
    end: f32,
    embedding: u32,              // of the image it belongs to
    target_rgb: u32,        // rgba8; a = 0: not seen
    target_distance: f32,   // along the ray; 0: unknown
    jitter: f32,             // of its samples, in steps, 0 to 1
    is_finished: u32,          // 1: of a picture, and nothing more can be seen along it
    next_segment: u32,        // of a picture's ray: the first that was not looked for yet
}

// A sample's part of a ray.
struct Span {
    begin: f32,
    end: f32,
    ray: u32,
    unused: u32,
}
