// gradient: gradient of the loss with respect to a projected splat, for one intersection or summed over all of them.

struct Gradient {
    position: vec4f,      // mean_px.xy, depth, opacity
    conic: vec4f,      // A, B, C; w: absolute error, weighted by contribution
    color: vec4f,      // rgb; w unused
}
