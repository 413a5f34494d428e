// number: number type of layer inputs and outputs: f32.

alias Four = vec4f;

fn narrowed(v: vec4f) -> Four { return v; }

// Factor by which gradients are multiplied while stored in this type, for a step with this many rays.
fn gradient_scale(n_rays: u32) -> f32 { return 1.0; }
