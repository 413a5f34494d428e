enable f16;
enable wgpu_cooperative_matrix;
// number: the numbers that layers take and leave: f16, for cooperative matrices.

alias Four = vec4<f16>;

const MAX_HALF = 65504.0;

fn narrowed(v: vec4f) -> Four { return Four(clamp(v, vec4f(-MAX_HALF), vec4f(MAX_HALF))); }

// What slopes are multiplied by while they are such numbers, where a step has so many rays: the loss is a mean over rays, and a ray's slopes
// are at most about 1. What is left of them reaches from 2^8 times what is largest down to 2^-32 of it.
fn gradient_scale(n_rays: u32) -> f32 { return 256.0 * f32(n_rays); }
