// correct_view: apply the current camera parameters to the view of an image, and compute its color gains.
//
// threads   one
// reads     base (uncorrected view), lens, rule, params
// writes    corrected (a `View`), gains

#import view
#import camera_params

@group(0) @binding(0) var<uniform> base: View;
@group(0) @binding(1) var<uniform> lens: Lens;
@group(0) @binding(2) var<storage, read> params: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> corrected: View;
@group(0) @binding(4) var<storage, read_write> gains: vec4f;
@group(0) @binding(5) var<uniform> rule: CameraRule;

fn camera_value(param: u32) -> f32 {
    return select(0.0, params[lens.camera_params + param].x, (rule.camera_mask & (1u << param)) != 0u);
}

fn image_value(param: u32) -> f32 {
    return select(0.0, params[lens.image_params + param].x, (rule.image_mask & (1u << param)) != 0u);
}

struct Pose {
    x: vec3f,          // columns of camera_from_world
    y: vec3f,
    z: vec3f,
    origin: vec3f,
}

fn transformed(pose: Pose, rotation: vec3f, translation: vec3f) -> Pose {
    return Pose(rotated(rotation, pose.x), rotated(rotation, pose.y), rotated(rotation, pose.z), rotated(rotation, pose.origin) + translation);
}

@compute @workgroup_size(1)
fn main() {
    let rows = mat4x3f(
        vec3f(base.camera_row_0.x, base.camera_row_1.x, base.camera_row_2.x),
        vec3f(base.camera_row_0.y, base.camera_row_1.y, base.camera_row_2.y),
        vec3f(base.camera_row_0.z, base.camera_row_1.z, base.camera_row_2.z),
        vec3f(base.camera_row_0.w, base.camera_row_1.w, base.camera_row_2.w),
    );
    let time_offset = camera_value(TIME_OFFSET);
    var pose = Pose(rows[0], rows[1], rows[2], rows[3]);
    pose = transformed(pose, -time_offset * lens.angular.xyz, -time_offset * lens.linear.xyz);
    pose = transformed(pose, vec3f(image_value(ROTATION), image_value(ROTATION + 1u), image_value(ROTATION + 2u)), vec3f(image_value(TRANSLATION), image_value(TRANSLATION + 1u), image_value(TRANSLATION + 2u)));
    pose = transformed(pose, vec3f(camera_value(ROTATION), camera_value(ROTATION + 1u), camera_value(ROTATION + 2u)), vec3f(camera_value(TRANSLATION), camera_value(TRANSLATION + 1u), camera_value(TRANSLATION + 2u)));
    corrected.camera_row_0 = vec4f(pose.x.x, pose.y.x, pose.z.x, pose.origin.x);
    corrected.camera_row_1 = vec4f(pose.x.y, pose.y.y, pose.z.y, pose.origin.y);
    corrected.camera_row_2 = vec4f(pose.x.z, pose.y.z, pose.z.z, pose.origin.z);
    corrected.center_in_world = vec4f(-dot(pose.x, pose.origin), -dot(pose.y, pose.origin), -dot(pose.z, pose.origin), base.center_in_world.w);
    corrected.focal_px = base.focal_px * exp(vec2f(camera_value(LOG_FOCAL), camera_value(LOG_FOCAL + 1u)));
    corrected.principal_px = base.principal_px + base.focal_px * vec2f(camera_value(PRINCIPAL), camera_value(PRINCIPAL + 1u));
    corrected.size_px = base.size_px;
    corrected.n_tiles = base.n_tiles;
    corrected.shutter_linear = base.shutter_linear;
    corrected.shutter_angular = base.shutter_angular;
    corrected.crop_row_0 = base.crop_row_0;
    corrected.crop_row_1 = base.crop_row_1;
    corrected.crop_row_2 = base.crop_row_2;
    corrected.crop_min = base.crop_min;
    corrected.crop_max = base.crop_max;
    gains = exp(vec4f(image_value(LOG_GAIN), image_value(LOG_GAIN + 1u), image_value(LOG_GAIN + 2u), 0.0));
}
