// integrate: fuses one depth image, and the matching color image, into the visible blocks.
//
// groups    any number: each processes visible blocks in turn; 64 threads, one per column along z
// reads     field, depth_view, readings [depth pixels], image [color pixels] (rgba8; a = 0 where masked), coords,
//           visible [N_VISIBLE], status (N_VISIBLE)
// writes    geometry, colors [n_blocks * 512], changed [n_blocks] (1 if a voxel changed)
// twin      tsdf/reference/integrate.rs
// source    Curless and Levoy 1996, section 3; weights: Newcombe et al. 2011 (cosine of the angle; squared here,
//           because an error across the ray moves the surface by the tangent of the angle times the error) and
//           Oleynikova et al. 2017 (Voxblox: inverse square of distance, drop behind the surface). Ours: distances are
//           measured along the surface normal, and carving reduces the weight of a voxel instead of assigning a
//           distance. A ray through a voxel shows that the voxel is free, but not how far away the nearest surface is.
// software  software adapters execute both sides of a branch, and run all lanes through a loop together, with an extra
//           iteration if the test comes first. Loops are therefore tested at their end, and colors, which few voxels of
//           a column have, are fused in a separate loop

#import field
#import field_status
#import depth_view
#import folded

@group(0) @binding(0) var<uniform> field: Field;
@group(0) @binding(1) var<uniform> depth_view: DepthView;
@group(0) @binding(2) var<storage, read> readings: array<vec2f>;
@group(0) @binding(3) var<storage, read> image: array<u32>;
@group(0) @binding(4) var<storage, read> coords: array<vec4i>;
@group(0) @binding(5) var<storage, read> visible: array<u32>;
@group(0) @binding(6) var<storage, read> status: array<u32>;
@group(0) @binding(7) var<storage, read_write> geometry: array<u32>;
@group(0) @binding(8) var<storage, read_write> colors: array<vec2u>;
@group(0) @binding(9) var<storage, read_write> changed: array<atomic<u32>>;

// Minimum cosine between ray and normal for scaling distances. Normals of steeper surfaces are mostly noise.
const MIN_RAY_DOT_NORMAL = 0.3;
// Number of observations of a solid voxel that one observation through it cancels. The first constant applies if the
// surface behind the voxel is one truncation away, the second if it is at least two away. A nearer surface may be
// caused by a pose error.
const CARVING_NEAR = 1.0;
const CARVING_FAR = 4.0;
// Colors are stored up to this distance from the surface, in voxels. Pictures and meshes do not read other colors.
const COLOR_VOXELS = 2.0;

fn reading_at(pixel: vec2i) -> vec2f {
    let inside = clamp(pixel, vec2i(0), vec2i(depth_view.depth_size_px) - 1);
    return readings[u32(inside.y) * depth_view.depth_size_px.x + u32(inside.x)];
}

// Interpolates four readings if all are valid, otherwise returns the nearest one.
fn reading_near(position_px: vec2f) -> vec2f {
    let corner = floor(position_px - 0.5);
    let share = position_px - 0.5 - corner;
    let base = vec2i(corner);
    let a = reading_at(base);
    let b = reading_at(base + vec2i(1, 0));
    let c = reading_at(base + vec2i(0, 1));
    let d = reading_at(base + vec2i(1, 1));
    let all_valid = min(min(a.x, b.x), min(c.x, d.x)) > 0.0;
    let between = mix(mix(a, b, share.x), mix(c, d, share.x), share.y);
    let nearest = select(select(a, b, share.x >= 0.5), select(c, d, share.x >= 0.5), share.y >= 0.5);
    return select(nearest, between, all_valid);
}

fn pixel_at(pixel: vec2i) -> vec4f {
    let inside = clamp(pixel, vec2i(0), vec2i(depth_view.color_size_px) - 1);
    return unpack4x8unorm(image[u32(inside.y) * depth_view.color_size_px.x + u32(inside.x)]);
}

// Color at a point, interpolated between four pixels; alpha is less than 1 outside the image or on a mask.
fn color_near(point_in_field: vec3f) -> vec4f {
    let point = color_from_field(depth_view, point_in_field);
    let position_px = depth_view.color_focal_px * point.xy / point.z + depth_view.color_principal_px;
    let inside = point.z > 0.0 && all(position_px >= vec2f(0.0)) && all(position_px < vec2f(depth_view.color_size_px));
    if !inside { return vec4f(0.0); }
    let corner = floor(position_px - 0.5);
    let share = position_px - 0.5 - corner;
    let base = vec2i(corner);
    let top = mix(pixel_at(base), pixel_at(base + vec2i(1, 0)), share.x);
    let bottom = mix(pixel_at(base + vec2i(0, 1)), pixel_at(base + vec2i(1, 1)), share.x);
    return mix(top, bottom, share.y);
}

fn fuse_color(at: u32, point_in_field: vec3f, weight_gain: u32) {
    let observed = color_near(point_in_field);
    if !(observed.a > 0.999) { return; }
    let old = colors[at];
    let weight = old.y >> 16u;
    let previous = vec3f(vec3u(old.x & 0xffffu, old.x >> 16u, old.y & 0xffffu)) / 65535.0;
    let sum = weight + weight_gain;
    let now = (previous * f32(weight) + observed.rgb * f32(weight_gain)) / f32(sum);
    let rgb = vec3u(floor(clamp(now, vec3f(0.0), vec3f(1.0)) * 65535.0 + 0.5));
    colors[at] = vec2u(rgb.x | (rgb.y << 16u), rgb.z | (min(sum, field.max_weight) << 16u));
}

// Result of fusing a reading into a voxel.
struct Fused {
    changed: bool,
    color_gain: u32,          // weight to add to its color; 0: too far from the surface
}

const UNCHANGED = Fused(false, 0u);

fn fuse(at: u32, point_in_field: vec3f) -> Fused {
    let point = depth_from_field(depth_view, point_in_field);
    let position_px = depth_view.depth_focal_px * point.xy / point.z + depth_view.depth_principal_px;
    let inside = point.z > 0.0 && all(position_px >= vec2f(0.0)) && all(position_px < vec2f(depth_view.depth_size_px));
    if !inside { return UNCHANGED; }
    let reading = reading_near(position_px);
    if !(reading.x > 0.0) { return UNCHANGED; }
    let distance_m = (reading.x - point.z) * max(reading.y, MIN_RAY_DOT_NORMAL);
    let truncation_m = truncation_at(field, reading.x);
    let ray_m = length(ray_of(depth_view, position_px));
    // The distance is measured along the ray instead of the normal. Just past the rim of an object, a ray soon leaves
    // the object again.
    let behind_m = (point.z - reading.x) * ray_m;
    if !(behind_m <= truncation_m) { return UNCHANGED; } // Hidden.
    let nearness = min(1.0, 1.0 / (reading.x * reading.x));
    let falloff = clamp((truncation_m - behind_m) / (truncation_m - field.voxel_m), 0.0, 1.0);
    let cosine = reading.y / ray_m;
    let gain_frac = nearness * cosine * cosine * falloff;
    let old = geometry[at];
    let weight = stored_weight(old);
    if distance_m > truncation_m {
        // Carving only reduces the weight of solid voxels. Its accuracy depends on the depth of the voxel, not on the
        // surface behind it.
        if weight == 0u || stored_distance(old) >= 0.0 { return UNCHANGED; }
        let carving = mix(CARVING_NEAR, CARVING_FAR, min(distance_m / truncation_m - 1.0, 1.0));
        let weight_loss = u32(max(floor(carving * WEIGHT_ONE * min(1.0, 1.0 / (point.z * point.z)) + 0.5), 1.0));
        geometry[at] = select(old - (weight_loss << 16u), 0u, weight_loss >= weight);
        return Fused(true, 0u);
    }
    let weight_gain = u32(clamp(floor(WEIGHT_ONE * gain_frac + 0.5), 1.0, WEIGHT_ONE));
    let sum = weight + weight_gain;
    let mean = (stored_distance(old) * f32(weight) + distance_m / field.scale_m * f32(weight_gain)) / f32(sum);
    let stored = i32(floor(clamp(mean, -1.0, 1.0) * 32767.0 + 0.5));
    geometry[at] = (u32(stored) & 0xffffu) | (min(sum, field.max_weight) << 16u);
    return Fused(true, select(0u, weight_gain, abs(distance_m) <= COLOR_VOXELS * field.voxel_m));
}

fn center_of(first: vec3i, z: u32) -> vec3f {
    return (vec3f(first + vec3i(0, 0, i32(z))) + 0.5) * field.voxel_m;
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let n_visible = status[N_VISIBLE];
    var at = folded(wg, n_wgs);
    if at >= n_visible { return; } // No barrier follows this return.
    loop {
        let slot = visible[at];
        let begin = slot * BLOCK_VOXELS + lane;
        let first = coords[slot].xyz * 8 + vec3i(vec3u(lane & 7u, lane >> 3u, 0u));
        var any_changed = false;
        var stale = 0u;         // Bit z: the color of voxel z must be fused.
        var gains = vec2u(0u); // Byte z: the color weight that voxel z gains, minus one.
        var z = 0u;
        loop {
            let fused = fuse(begin + z * 64u, center_of(first, z));
            any_changed = any_changed || fused.changed;
            if fused.color_gain != 0u {
                stale |= 1u << z;
                let byte = (fused.color_gain - 1u) << (8u * (z & 3u));
                gains |= select(vec2u(byte, 0u), vec2u(0u, byte), z >= 4u);
            }
            continuing {
                z++;
                break if z >= 8u;
            }
        }
        loop {
            if stale != 0u {
                let z = firstTrailingBit(stale);
                let byte = select(gains.x, gains.y, z >= 4u) >> (8u * (z & 3u));
                fuse_color(begin + z * 64u, center_of(first, z), (byte & 255u) + 1u);
            }
            continuing {
                stale &= stale - 1u;
                break if stale == 0u;
            }
        }
        if any_changed { atomicStore(&changed[slot], 1u); }
        continuing {
            at += n_wgs.x * n_wgs.y;
            break if at >= n_visible;
        }
    }
}
