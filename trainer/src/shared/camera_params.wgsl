// camera_params: calibration parameters of cameras, optimized together with the splats.
//
// The 16 parameters of a camera, shared by all its images, and the 16 parameters of a single image have the same
// layout.

// Each parameter is a vec4f: its value, Adam's two moments, and the number of steps taken.

const ROTATION = 0u;           // rotation vector in the camera's axes, radians
const TRANSLATION = 3u;          // meters; rotation and translation are applied after camera_from_world
const TIME_OFFSET = 6u;          // seconds by which the poses lag behind the images
const LOG_FOCAL = 7u;      // two values
const PRINCIPAL = 9u;      // two values, in focal lengths
const LOG_GAIN = 11u;      // red, green and blue
const N_PARAMS = 16u;

// One image: the location of its parameters and the motion of its camera.
struct Lens {
    linear: vec4f,         // velocity of the camera in its own axes, m/s
    angular: vec4f,        // rad/s
    camera_params: u32,     // index of the first parameter of its camera
    image_params: u32,      // index of the first parameter of the image
    unused: vec2u,
}

// Parameters that are optimized, and their learning rates.
struct CameraRule {
    camera_mask: u32,        // bit i: parameter i of a camera
    image_mask: u32,         // likewise for an image
    rotation_rate: f32,        // radians
    translation_rate_m: f32,
    time_offset_rate: f32,       // seconds
    focal_rate: f32,
    gain_rate: f32,
    image_decay: f32,       // fraction by which a step decays an image's parameters toward zero
}

// Rotates `v` by a rotation vector (Rodrigues).
fn rotated(by: vec3f, v: vec3f) -> vec3f {
    let angle = length(by);
    if angle < 1e-12 { return v; }
    let axis = by / angle;
    return v * cos(angle) + cross(axis, v) * sin(angle) + axis * dot(axis, v) * (1.0 - cos(angle));
}
