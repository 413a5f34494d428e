// camera_terms: what may be wrong about a camera, learned along with the splats.
//
// Terms of a camera, shared by all its images, and of a single image are stored alike: 16 a camera, 16 an image.

// A term is a vec4f: its value, Adam's two moments, and how many steps it has taken.

const ROTATION = 0u;           // rotation vector of the camera's own axes, radians
const TRANSLATION = 3u;          // metres: camera_from_world becomes turn and shift after camera_from_world
const TIME_OFFSET = 6u;          // seconds that the poses lag behind the images
const LOG_FOCAL = 7u;      // two
const PRINCIPAL = 9u;      // two, focal lengths
const LOG_GAIN = 11u;      // of red, green and blue
const N_PARAMS = 16u;

// One image: where its terms lie, and how its camera moved.
struct Lens {
    linear: vec4f,         // velocity of the camera in its own axes, m/s
    angular: vec4f,        // rad/s
    camera_params: u32,     // first term of its camera
    image_params: u32,      // first of its own
    unused: vec2u,
}

// Which terms are learned, and how fast.
struct CameraRule {
    camera_mask: u32,        // bit i: term i of a camera
    image_mask: u32,         // likewise of an image
    rotation_rate: f32,        // radians
    translation_rate_m: f32,
    time_offset_rate: f32,       // seconds
    focal_rate: f32,
    gain_rate: f32,
    image_decay: f32,       // share by which a step pulls an image's own terms towards nothing
}

// The rotation by a rotation vector (Rodrigues).
fn rotated(by: vec3f, v: vec3f) -> vec3f {
    let angle = length(by);
    if angle < 1e-12 { return v; }
    let axis = by / angle;
    return v * cos(angle) + cross(axis, v) * sin(angle) + axis * dot(axis, v) * (1.0 - cos(angle));
}
