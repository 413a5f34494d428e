// rasterize_bindings: bindings and code shared by both variants of `rasterize`.

#import tile

@group(0) @binding(6) var<storage, read_write> image: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> depth: array<f32>;
@group(0) @binding(8) var<storage, read_write> last: array<u32>;

// Writes a lane's pixels, starting at `first`.
fn write_pixels(first: vec2u, on_image: PxB, blend: Blend) {
    for (var k = 0u; k < PX; k++) {
        if !any(on_image & (INDEX == PxU(k))) { continue; }
        let at = first.y * view.size_px.x + first.x + k;
        image[at] = vec4f(pick(blend.red, k), pick(blend.green, k), pick(blend.blue, k), pick(blend.transmittance, k));
        depth[at] = pick(blend.depth, k);
        last[at] = pick_u(blend.past_last, k);
    }
}
