// model: sizes of the splat model, and one projected splat.

struct Model {
    n_splats: u32,
    capacity: u32,     // stride between the planes of sh_rest
    sh_degree: u32,    // degrees in use, 0 to 3
    n_sh_rest: u32,    // planes of sh_rest in use: 3 ((sh_degree + 1)^2 - 1)
    is_antialiased: u32, // whether opacities are corrected for the low-pass
    unused_0: u32,
    unused_1: u32,
    unused_2: u32,
}

// Inputs of rasterization for one visible splat.
struct ProjectedSplat {
    position: vec4f,      // mean_px.xy, depth along z, opacity
    conic: vec4f,      // A, B, C; w: reach = 2 ln(255 opacity)
    color: vec4f,      // linear in display space, not below 0; w unused
}
