// ssim_upstream: gradient of the structural similarity with respect to a pixel's color, as computed by
// `ssim_upstream_strips`.

fn ssim_upstream(lane: u32, corner: vec2i, at: u32, picture: vec3f, expected: vec3f) -> vec3f {
    return upstream[at].rgb;
}
