// view: one virtual or real camera and its pose.
//
// source    conventions of ARCHITECTURE.md: x right, y down, z forward; pixel centers at + 0.5

struct View {
    camera_row_0: vec4f,       // camera_from_world, upper three rows
    camera_row_1: vec4f,
    camera_row_2: vec4f,
    center_in_world: vec4f,    // of the camera; w: low-pass on the image plane, pixels squared
    focal_px: vec2f,
    principal_px: vec2f,
    size_px: vec2u,
    n_tiles: vec2u,
    shutter_linear: vec4f,     // twist of the camera times the readout time, meters; w: near_m
    shutter_angular: vec4f,    // radians; w: far_m
    crop_row_0: vec4f,         // box_from_world, upper three rows
    crop_row_1: vec4f,
    crop_row_2: vec4f,
    crop_min: vec4f,           // w: 1 when there is a crop box, else 0
    crop_max: vec4f,
}

const TILE_PX = 16u;

fn camera_from_world(view: View, point_in_world: vec3f) -> vec3f {
    let point = vec4f(point_in_world, 1.0);
    return vec3f(dot(view.camera_row_0, point), dot(view.camera_row_1, point), dot(view.camera_row_2, point));
}

// Index of the workgroup when dispatch counts are folded to x and y.
fn folded(wg: vec3u, n_wgs: vec3u) -> u32 {
    return wg.y * n_wgs.x + wg.x;
}
