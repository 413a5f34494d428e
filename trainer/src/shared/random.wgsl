// random: hash-based random numbers from a position and a time, so that threads share no state.
//
// source    Jarzynski and Olano 2020 (PCG3D)

fn hash3(key: vec3u) -> vec3u {
    var v = key * 1664525u + 1013904223u;
    v.x += v.y * v.z; v.y += v.z * v.x; v.z += v.x * v.y;
    v ^= v >> vec3u(16u);
    v.x += v.y * v.z; v.y += v.z * v.x; v.z += v.x * v.y;
    return v;
}

// Three numbers in 0 <= x < 1.
fn uniform3(key: vec3u) -> vec3f {
    return vec3f(hash3(key) >> vec3u(8u)) / 16777216.0;
}

// Three normally distributed numbers (Box and Muller 1958).
fn normal3(key: vec3u) -> vec3f {
    let a = uniform3(key);
    let b = uniform3(key ^ vec3u(0x9e3779b9u, 0x85ebca6bu, 0xc2b2ae35u));
    let radius = sqrt(-2.0 * log(1.0 - a));
    return radius * cos(6.283185307179586 * b);
}
