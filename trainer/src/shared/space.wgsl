// space: contracts the world to the unit cube. World coordinates are in units of the scene radius around its center.

// twin: model-files/src/contraction.rs
fn contract(at: vec3f) -> vec3f {
    let size = abs(at);
    let largest = max(size.x, max(size.y, size.z));
    let drawn_in = at * select(1.0, (2.0 - 1.0 / largest) / largest, largest > 1.0);
    return (drawn_in + 2.0) / 4.0;
}
