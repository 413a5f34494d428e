// depth_view: one depth image, the matching color image, and the poses of both cameras.

struct DepthView {
    depth_row_0: vec4f,       // depth_from_field, upper three rows
    depth_row_1: vec4f,
    depth_row_2: vec4f,
    field_row_0: vec4f,       // field_from_depth
    field_row_1: vec4f,
    field_row_2: vec4f,
    color_row_0: vec4f,       // color_from_field
    color_row_1: vec4f,
    color_row_2: vec4f,
    depth_focal_px: vec2f,
    depth_principal_px: vec2f,
    color_focal_px: vec2f,
    color_principal_px: vec2f,
    depth_size_px: vec2u,
    color_size_px: vec2u,
}

fn depth_from_field(depth_view: DepthView, point: vec3f) -> vec3f {
    let p = vec4f(point, 1.0);
    return vec3f(dot(depth_view.depth_row_0, p), dot(depth_view.depth_row_1, p), dot(depth_view.depth_row_2, p));
}

fn field_from_depth(depth_view: DepthView, point: vec3f) -> vec3f {
    let p = vec4f(point, 1.0);
    return vec3f(dot(depth_view.field_row_0, p), dot(depth_view.field_row_1, p), dot(depth_view.field_row_2, p));
}

fn color_from_field(depth_view: DepthView, point: vec3f) -> vec3f {
    let p = vec4f(point, 1.0);
    return vec3f(dot(depth_view.color_row_0, p), dot(depth_view.color_row_1, p), dot(depth_view.color_row_2, p));
}

// Ray through a position in the depth image, scaled to z = 1.
fn ray_of(depth_view: DepthView, position_px: vec2f) -> vec3f {
    return vec3f((position_px - depth_view.depth_principal_px) / depth_view.depth_focal_px, 1.0);
}
