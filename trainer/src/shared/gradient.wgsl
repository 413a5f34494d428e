// gradient: what one intersection, or the sum of a splat's, tells about the splat as it is drawn.

struct Gradient {
    position: vec4f,      // mean_px.xy, depth, opacity
    conic: vec4f,      // A, B, C; w: absolute error seen, weighted by contribution
    color: vec4f,      // rgb; w unused
}
