// panorama_face: copies the pixels that one face of a cube shows into an equirectangular picture.
//
// Longitude increases along x from -180 to 180 degrees, latitude decreases along y from 90 to -90 degrees; the camera's z
// axis is at the center.
//
// threads   one per pixel of the panorama
// reads     face, face_pixels [edge, edge] (rgba8), face_depths [edge, edge] (meters along z)
// writes    pixels [height, width], depths [height, width] (meters from the camera's center)

#import folded

struct Face {
    right: vec4f,          // axes of the face in the camera's frame
    down: vec4f,
    forward: vec4f,
    size_px: vec2u,        // of the panorama
    edge_px: u32,
    unused: u32,
}

@group(0) @binding(0) var<uniform> face: Face;
@group(0) @binding(1) var<storage, read> face_pixels: array<u32>;
@group(0) @binding(2) var<storage, read> face_depths: array<f32>;
@group(0) @binding(3) var<storage, read_write> pixels: array<u32>;
@group(0) @binding(4) var<storage, read_write> depths: array<f32>;

const PI = 3.14159265358979;

// Axis of the face that shows a direction. Each direction has exactly one.
fn axis_of(direction: vec3f) -> vec3f {
    let size = abs(direction);
    if size.z >= max(size.x, size.y) { return vec3f(0.0, 0.0, select(-1.0, 1.0, direction.z > 0.0)); }
    if size.x >= size.y { return vec3f(select(-1.0, 1.0, direction.x > 0.0), 0.0, 0.0); }
    return vec3f(0.0, select(-1.0, 1.0, direction.y > 0.0), 0.0);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 64u + lane;
    if ix >= face.size_px.x * face.size_px.y { return; }
    let at = (vec2f(vec2u(ix % face.size_px.x, ix / face.size_px.x)) + 0.5) / vec2f(face.size_px);
    let longitude = PI * (2.0 * at.x - 1.0);
    let latitude = PI * (0.5 - at.y);
    let direction = vec3f(cos(latitude) * sin(longitude), -sin(latitude), cos(latitude) * cos(longitude));
    if dot(axis_of(direction), face.forward.xyz) < 0.5 { return; }
    let cosine = dot(direction, face.forward.xyz);
    let in_face = vec2f(dot(direction, face.right.xyz), dot(direction, face.down.xyz)) / cosine;
    let pixel = vec2u(clamp(0.5 * f32(face.edge_px) * (1.0 + in_face), vec2f(0.0), vec2f(f32(face.edge_px) - 1.0)));
    let source_ix = pixel.y * face.edge_px + pixel.x;
    pixels[ix] = face_pixels[source_ix];
    depths[ix] = face_depths[source_ix] / cosine;
}
