// ray_batch: the rays of a step and their samples.

struct Batch {
    n_rays: u32,
    n_samples: u32,
    max_samples: u32,      // per ray, limited so that all rays fit
    unused: u32,
}

struct Ray {
    origin: vec3f,          // in units of the scene radius, like all lengths here
    first_sample: u32,
    direction: vec3f,       // of length 1
    n_samples: u32,
    begin: f32,             // start of the visible range along the ray
    end: f32,
    embedding: u32,              // embedding index of the ray's image
    target_rgb: u32,        // rgba8; a = 0: no observation
    target_distance: f32,   // along the ray; 0: unknown
    jitter: f32,             // offset of the samples, in steps, 0 to 1
    progress: u32,          // of a ray of a picture
    next_segment: u32,        // for a ray of a picture: first segment not searched yet
}

// Interval of a ray that a sample covers.
struct Span {
    begin: f32,
    end: f32,
    ray: u32,
    sample: u32,           // index of the sample, of which another list may hold a selection
}

// Progress of a ray of a picture. It has ended when it is opaque or past the scene.
const RAY_RUNNING = 0u;
const RAY_ENDED = 1u;
const RAY_SHOWN = 2u;
// Front distance of a ray that hits no surface.
const FAR_FRONT = 1e9;
