// picture_ray: the ray of a pixel of a view, and the conversion from depth along the view's axis to distance along the
// ray. Import after `view`.
//
// source    motion during the shutter time to first order, as in `projection`

struct PixelRay {
    origin: vec3f,
    along: vec3f,          // per unit of depth
    range: vec2f,          // of depth
}

fn rotated_to_world(v: vec3f) -> vec3f {
    return view.camera_row_0.xyz * v.x + view.camera_row_1.xyz * v.y + view.camera_row_2.xyz * v.z;
}

// Clips a range of depths to the part inside a box, in the box's frame.
fn within_box(range: vec2f, origin: vec3f, along: vec3f, low: vec3f, high: vec3f) -> vec2f {
    let safe = select(along, vec3f(1e-12), abs(along) < vec3f(1e-12));
    let a = (low - origin) / safe;
    let b = (high - origin) / safe;
    let enter = min(a, b);
    let leave = max(a, b);
    return vec2f(max(range.x, max(enter.x, max(enter.y, enter.z))), min(range.y, min(leave.x, min(leave.y, leave.z))));
}

fn ray_of_pixel(pixel: vec2u) -> PixelRay {
    let position_px = vec2f(pixel) + 0.5;
    let tau = position_px.y / f32(view.size_px.y) - 0.5;
    let direction = vec3f((position_px - view.principal_px) / view.focal_px, 1.0);
    // The motion during the shutter time moves a point by -tau (v + w x p) in the camera. The ray reverses this motion.
    let rotated = direction + tau * cross(view.shutter_angular.xyz, direction);
    let origin = view.center_in_world.xyz + rotated_to_world(tau * view.shutter_linear.xyz);
    let along = rotated_to_world(rotated);
    var range = vec2f(view.shutter_linear.w, view.shutter_angular.w);
    if view.crop_min.w != 0.0 {
        let o = vec4f(origin, 1.0);
        let d = vec4f(along, 0.0);
        let origin_in_box = vec3f(dot(view.crop_row_0, o), dot(view.crop_row_1, o), dot(view.crop_row_2, o));
        let along_in_box = vec3f(dot(view.crop_row_0, d), dot(view.crop_row_1, d), dot(view.crop_row_2, d));
        range = within_box(range, origin_in_box, along_in_box, view.crop_min.xyz, view.crop_max.xyz);
    }
    return PixelRay(origin, along, range);
}
