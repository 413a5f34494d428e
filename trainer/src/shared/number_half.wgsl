enable f16;
enable wgpu_cooperative_matrix;
// number: number type of layer inputs and outputs: f16, for cooperative matrices.

alias Four = vec4<f16>;

const MAX_HALF = 65504.0;

fn narrowed(v: vec4f) -> Four { return Four(clamp(v, vec4f(-MAX_HALF), vec4f(MAX_HALF))); }

// Factor by which gradients are multiplied while stored in this type, for a step with this many rays. The loss is a
// mean over rays, and the gradients of a ray are at most about 1. With this factor, the representable range extends
// from 2^8 times the largest gradient down to 2^-32 times the largest gradient.
fn gradient_scale(n_rays: u32) -> f32 { return 256.0 * f32(n_rays); }
