// correct_view: the view of an image as its camera's terms have it now, and the gain of its colors.
//
// threads   one
// reads     base (the view as the input has it), lens, rule, terms
// writes    corrected (a `View`), gains

#import view
#import camera_terms

@group(0) @binding(0) var<uniform> base: View;
@group(0) @binding(1) var<uniform> lens: Lens;
@group(0) @binding(2) var<storage, read> terms: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> corrected: View;
@group(0) @binding(4) var<storage, read_write> gains: vec4f;
@group(0) @binding(5) var<uniform> rule: CameraRule;

fn of_camera(term: u32) -> f32 {
    return select(0.0, terms[lens.camera_terms + term].x, (rule.of_camera & (1u << term)) != 0u);
}

fn of_image(term: u32) -> f32 {
    return select(0.0, terms[lens.image_terms + term].x, (rule.of_image & (1u << term)) != 0u);
}

struct Frame {
    x: vec3f,          // columns of camera_from_world
    y: vec3f,
    z: vec3f,
    origin: vec3f,
}

fn moved(frame: Frame, turn: vec3f, shift: vec3f) -> Frame {
    return Frame(turned(turn, frame.x), turned(turn, frame.y), turned(turn, frame.z), turned(turn, frame.origin) + shift);
}

@compute @workgroup_size(1)
fn main() {
    let rows = mat4x3f(
        vec3f(base.camera_row_0.x, base.camera_row_1.x, base.camera_row_2.x),
        vec3f(base.camera_row_0.y, base.camera_row_1.y, base.camera_row_2.y),
        vec3f(base.camera_row_0.z, base.camera_row_1.z, base.camera_row_2.z),
        vec3f(base.camera_row_0.w, base.camera_row_1.w, base.camera_row_2.w),
    );
    let delay = of_camera(DELAY);
    var frame = Frame(rows[0], rows[1], rows[2], rows[3]);
    frame = moved(frame, -delay * lens.angular.xyz, -delay * lens.linear.xyz);
    frame = moved(frame, vec3f(of_image(TURN), of_image(TURN + 1u), of_image(TURN + 2u)), vec3f(of_image(SHIFT), of_image(SHIFT + 1u), of_image(SHIFT + 2u)));
    frame = moved(frame, vec3f(of_camera(TURN), of_camera(TURN + 1u), of_camera(TURN + 2u)), vec3f(of_camera(SHIFT), of_camera(SHIFT + 1u), of_camera(SHIFT + 2u)));
    corrected.camera_row_0 = vec4f(frame.x.x, frame.y.x, frame.z.x, frame.origin.x);
    corrected.camera_row_1 = vec4f(frame.x.y, frame.y.y, frame.z.y, frame.origin.y);
    corrected.camera_row_2 = vec4f(frame.x.z, frame.y.z, frame.z.z, frame.origin.z);
    corrected.center_in_world = vec4f(-dot(frame.x, frame.origin), -dot(frame.y, frame.origin), -dot(frame.z, frame.origin), base.center_in_world.w);
    corrected.focal_px = base.focal_px * exp(vec2f(of_camera(LOG_FOCAL), of_camera(LOG_FOCAL + 1u)));
    corrected.principal_px = base.principal_px + base.focal_px * vec2f(of_camera(PRINCIPAL), of_camera(PRINCIPAL + 1u));
    corrected.size_px = base.size_px;
    corrected.n_tiles = base.n_tiles;
    corrected.shutter_linear = base.shutter_linear;
    corrected.shutter_angular = base.shutter_angular;
    corrected.crop_row_0 = base.crop_row_0;
    corrected.crop_row_1 = base.crop_row_1;
    corrected.crop_row_2 = base.crop_row_2;
    corrected.crop_min = base.crop_min;
    corrected.crop_max = base.crop_max;
    gains = exp(vec4f(of_image(LOG_GAIN), of_image(LOG_GAIN + 1u), of_image(LOG_GAIN + 2u), 0.0));
}
