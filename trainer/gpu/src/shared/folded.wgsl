// folded: index of the workgroup when dispatch counts are folded to x and y.

fn folded(wg: vec3u, n_wgs: vec3u) -> u32 {
    return wg.y * n_wgs.x + wg.x;
}
