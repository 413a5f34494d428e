// readings: determines the valid pixels of a depth image, and the orientation of their surface.
//
// threads   one per pixel of the depth image
// reads     field, depth_view, depth [n_pixels] (bits of meters along z)
// writes    readings [n_pixels]: depth in meters, 0 for invalid pixels; and the dot product of the ray (z = 1) and the
//           unit surface normal, which converts a difference in z to a distance along the normal
// twin      tsdf/reference/readings.rs
// source    normals by differences: Newcombe et al. 2011 (KinectFusion), section 3.2; the slope limit, and wider
//           differences on flat surfaces, are ours

#import field
#import depth_view
#import folded

@group(0) @binding(0) var<uniform> field: Field;
@group(0) @binding(1) var<uniform> depth_view: DepthView;
@group(0) @binding(2) var<storage, read> depth: array<u32>;
@group(0) @binding(3) var<storage, read_write> readings: array<vec2f>;

const MIN_DEPTH_M = 0.01;
// Wide differences for normals use pixels this far apart on each side, to reduce noise.
const WIDE_STEP = 3;
// Maximum second difference of depths on a flat surface, in units of the noise: 2.45 standard deviations.
const MAX_FLAT_NOISES = 6.0;
// Maximum slope of a valid surface: change of depth over lateral distance. Steeper surfaces count as edges.
const MAX_SLOPE = 6.0;

// Depth of a pixel; 0 if invalid. Finiteness is tested on the bits, because the compiler may assume that there is no
// NaN.
fn depth_at(pixel: vec2i) -> f32 {
    if any(pixel < vec2i(0)) || any(pixel >= vec2i(depth_view.depth_size_px)) { return 0.0; }
    let bits = depth[u32(pixel.y) * depth_view.depth_size_px.x + u32(pixel.x)];
    if bits == 0u || bits >= 0x7f800000u { return 0.0; } // Zero, negative, infinite or NaN.
    let depth_m = bitcast<f32>(bits);
    return select(0.0, depth_m, depth_m >= MIN_DEPTH_M && depth_m <= field.max_depth_m);
}

fn point_at(pixel: vec2i, depth_m: f32) -> vec3f {
    return ray_of(depth_view, vec2f(pixel) + 0.5) * depth_m;
}

struct Side {
    has_neighbor: bool,
    is_edge: bool,
    along: vec3f,             // change of the point per pixel
}

fn tangent_along(pixel: vec2i, step: vec2i, center_m: f32, focal_px: f32) -> Side {
    let high_m = depth_at(pixel + step);
    let low_m = depth_at(pixel - step);
    let noise_m = field.noise_per_m2 * center_m * center_m;
    let limit = MAX_SLOPE * center_m / focal_px + 6.0 * noise_m;
    let has_high = high_m > 0.0;
    let has_low = low_m > 0.0;
    let is_edge = (has_high && abs(high_m - center_m) > limit) || (has_low && abs(low_m - center_m) > limit);
    // On a surface that is flat within its noise, wider differences reduce the noise of the normal.
    let far_high_m = depth_at(pixel + WIDE_STEP * step);
    let far_low_m = depth_at(pixel - WIDE_STEP * step);
    let is_flat = min(far_high_m, far_low_m) > 0.0
        && abs(far_high_m - 2.0 * center_m + far_low_m) <= MAX_FLAT_NOISES * noise_m;
    let reach = select(select(vec2i(0), vec2i(1), vec2<bool>(has_high, has_low)), vec2i(WIDE_STEP), is_flat);
    let high = point_at(pixel + reach.x * step, select(select(center_m, high_m, has_high), far_high_m, is_flat));
    let low = point_at(pixel - reach.y * step, select(select(center_m, low_m, has_low), far_low_m, is_flat));
    return Side(has_high || has_low, is_edge, high - low);
}

override WG_SIZE = 64u;
@compute @workgroup_size(WG_SIZE)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = folded(wg, n_wgs) * WG_SIZE + lane;
    if at >= depth_view.depth_size_px.x * depth_view.depth_size_px.y { return; } // No barrier follows this return.
    let pixel = vec2i(vec2u(at % depth_view.depth_size_px.x, at / depth_view.depth_size_px.x));
    let center_m = depth_at(pixel);
    let x = tangent_along(pixel, vec2i(1, 0), center_m, depth_view.depth_focal_px.x);
    let y = tangent_along(pixel, vec2i(0, 1), center_m, depth_view.depth_focal_px.y);
    let normal = cross(x.along, y.along);
    let ray = ray_of(depth_view, vec2f(pixel) + 0.5);
    let ray_dot_normal = dot(ray, normal) / max(length(normal), 1e-30);
    let is_valid = center_m > 0.0 && x.has_neighbor && y.has_neighbor && !x.is_edge && !y.is_edge && ray_dot_normal > 0.0;
    readings[at] = select(vec2f(0.0), vec2f(center_m, ray_dot_normal), is_valid);
}
