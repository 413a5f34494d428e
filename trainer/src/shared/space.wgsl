// space: the world in the unit cube.

struct Space {
    center_m: vec3f,
    radius_m: f32,          // half an edge of the inner cube
}

// twin: nerf/reference/space.rs
fn contract(space: Space, world_m: vec3f) -> vec3f {
    let scaled = (world_m - space.center_m) / space.radius_m;
    let size = abs(scaled);
    let largest = max(size.x, max(size.y, size.z));
    let drawn_in = scaled * select(1.0, (2.0 - 1.0 / largest) / largest, largest > 1.0);
    return (drawn_in + 2.0) / 4.0;
}
