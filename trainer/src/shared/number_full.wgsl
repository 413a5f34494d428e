// number: the numbers that layers take and leave: f32.

alias Four = vec4f;

fn narrowed(v: vec4f) -> Four { return v; }

// What slopes are multiplied by while they are such numbers, where a step has so many rays.
fn gradient_scale(n_rays: u32) -> f32 { return 1.0; }
