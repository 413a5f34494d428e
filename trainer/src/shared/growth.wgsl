// growth: how the splat count changes.

struct Growth {
    n_before: u32,
    n_after: u32,
    key: u32,             // seed of the random numbers
    capacity: u32,        // stride between planes
    n_sh_rest: u32,       // allocated planes of sh_rest
    child_spread: f32,    // of a child's position, in standard deviations of its parent
    min_opacity: f32,     // splats below it are dead
    unused: f32,
}

const NO_PARENT = 0xffffffffu;

// Whether a splat is dead: nearly transparent, or non-finite. Dead splats are replaced by children of others.
fn is_dead(mean: vec4f, shape: vec4f, min_opacity: f32) -> bool {
    let alive = 1.0 / (1.0 + exp(-shape.w)) >= min_opacity && all(abs(mean.xyz) < vec3f(1e6)) && all(abs(shape.xyz) < vec3f(50.0));
    return !alive;
}
