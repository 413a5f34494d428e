// cast_rays: renders the field: the first surface along each pixel's ray that faces the camera.
//
// threads   one per pixel, in squares of 8x8
// reads     view (in the field's frame), field, backdrop, status (bounds), keys, entries, geometry, colors, erased (for
//           points in voxels)
// writes    pixels [n_pixels] (rgba8; a: 255 where there is a surface), depths [n_pixels] (meters along z; 0 without a
//           surface)
// twin      tsdf/reference/cast.rs
// source    sphere tracing: Hart 1996; in truncated fields: Newcombe et al. 2011, section 3.3

#import view
#import picture_ray
#import field
#import field_status
#import field_lookup
#import space
#import erased

struct Backdrop {
    srgb: vec4f,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> field: Field;
@group(0) @binding(2) var<uniform> backdrop: Backdrop;
@group(0) @binding(3) var<storage, read> status: array<u32>;
@group(0) @binding(4) var<storage, read> keys: array<u32>;
@group(0) @binding(5) var<storage, read> entries: array<u32>;
@group(0) @binding(6) var<storage, read> geometry: array<u32>;
@group(0) @binding(7) var<storage, read> colors: array<vec2u>;
@group(0) @binding(8) var<storage, read_write> pixels: array<u32>;
@group(0) @binding(9) var<storage, read_write> depths: array<f32>;
@group(0) @binding(10) var<storage, read> erased: array<vec4u>;

const MAX_STEPS = 4096u;
const N_BISECTIONS = 8u;
const CONVERGED_VOXELS = 1e-3;           // voxels
const UNKNOWN = 1e9;

// Cache of the chunk and block looked up last.
var<private> cached_chunk: vec3i;
var<private> cached_row: u32;
var<private> cached_block: vec3i;
var<private> cached_slot: u32;

// The row of a chunk plus one. It is 0 if there is no such chunk.
fn row_of(chunk: vec3i) -> u32 {
    if any(chunk != cached_chunk) {
        cached_chunk = chunk;
        cached_row = find_row(chunk);
    }
    return cached_row;
}

// The slot of a block plus one. It is 0 if there is no such block.
fn slot_of(block: vec3i) -> u32 {
    if any(block != cached_block) {
        cached_block = block;
        cached_slot = slot_in_row(row_of(block >> vec3u(3u)), block);
    }
    return cached_slot;
}

// Index of a voxel in the pool plus one. It is 0 if the block of the voxel does not exist.
fn pool_ix_of(voxel: vec3i) -> u32 {
    let slot = slot_of(voxel >> vec3u(3u));
    if slot == 0u { return 0u; }
    return (slot - 1u) * BLOCK_VOXELS + voxel_in_block(voxel) + 1u;
}

// Distance in voxels, interpolated between eight voxel centers. UNKNOWN if any of these voxels was not observed.
fn distance_at(point: vec3f) -> f32 {
    let corner = floor(point - 0.5);
    let share = point - 0.5 - corner;
    let voxel = vec3i(corner);
    let is_inside = all((voxel & vec3i(7)) < vec3i(7)); // All eight in one block.
    var at = 0u;
    if is_inside {
        at = pool_ix_of(voxel);
        if at == 0u { return UNKNOWN; }
    }
    var sum = 0.0;
    for (var i = 0u; i < 8u; i++) {
        let offset = vec3u(i & 1u, (i >> 1u) & 1u, i >> 2u);
        var pool_ix = at + offset.x + 8u * offset.y + 64u * offset.z;
        if !is_inside {
            pool_ix = pool_ix_of(voxel + vec3i(offset));
            if pool_ix == 0u { return UNKNOWN; }
        }
        let word = geometry[pool_ix - 1u];
        if stored_weight(word) == 0u { return UNKNOWN; }
        let part = select(1.0 - share, share, offset == vec3u(1u));
        sum += part.x * part.y * part.z * stored_distance(word);
    }
    return sum * field.scale_m / field.voxel_m;
}

// Color interpolated between those of eight voxels that have a color. Gray if none of them has a color.
fn color_at(point: vec3f) -> vec3f {
    let corner = floor(point - 0.5);
    let share = point - 0.5 - corner;
    var sum = vec4f(0.0);
    for (var i = 0; i < 8; i++) {
        let offset = vec3i(i & 1, (i >> 1u) & 1, i >> 2u);
        let pool_ix = pool_ix_of(vec3i(corner) + offset);
        if pool_ix == 0u { continue; }
        let word = colors[pool_ix - 1u];
        if (word.y >> 16u) == 0u { continue; }
        let part = select(1.0 - share, share, offset == vec3i(1));
        let rgb = vec3f(vec3u(word.x & 0xffffu, word.x >> 16u, word.y & 0xffffu)) / 65535.0;
        sum += part.x * part.y * part.z * vec4f(rgb, 1.0);
    }
    return select(vec3f(0.5), sum.rgb / max(sum.a, 1e-6), sum.a > 1e-6);
}

struct Ray {
    origin: vec3f,            // voxels
    along: vec3f,             // voxels per meter of depth
    begin_m: f32,
    end_m: f32,
}

fn ray_of(pixel: vec2u) -> Ray {
    let pixel_ray = ray_of_pixel(pixel);
    var low = vec3f(0.0);
    var high = vec3f(0.0);
    for (var axis = 0u; axis < 3u; axis++) {
        low[axis] = f32(BOUNDS_BIAS - i32(status[BOUNDS_LOW + axis])) * 64.0;
        high[axis] = f32(i32(status[BOUNDS_HIGH + axis]) - BOUNDS_BIAS + 1) * 64.0;
    }
    let origin = pixel_ray.origin / field.voxel_m;
    let along = pixel_ray.along / field.voxel_m;
    let range = within_box(pixel_ray.range, origin, along, low, high);
    return Ray(origin, along, range.x, range.y);
}

// Depth at which the ray leaves the box of `size` voxels that begins at `corner`.
fn exit_depth_m(ray: Ray, corner: vec3i, size: i32) -> f32 {
    return within_box(vec2f(0.0, 1e30), ray.origin, ray.along, vec3f(corner), vec3f(corner + size)).y;
}

// Depth of the zero crossing between a point outside and a point inside.
// UNKNOWN if space between them was not observed.
fn crossing(ray: Ray, outside_m: f32, inside_m: f32, outside_distance: f32, inside_distance: f32, speed: f32) -> f32 {
    var low = vec2f(outside_m, outside_distance);
    var high = vec2f(inside_m, inside_distance);
    var at_m = inside_m;
    for (var i = 0u; i < N_BISECTIONS; i++) {
        let even = (high.x - low.x) * speed > 0.5;
        at_m = select(low.x + (high.x - low.x) * low.y / (low.y - high.y), 0.5 * (low.x + high.x), even);
        let here = distance_at(ray.origin + ray.along * at_m);
        if here == UNKNOWN { return UNKNOWN; }
        if abs(here) < CONVERGED_VOXELS { break; }
        if here >= 0.0 { low = vec2f(at_m, here); } else { high = vec2f(at_m, here); }
    }
    return at_m;
}

// Depth of the first surface that faces the camera and is not erased. UNKNOWN if there is none.
fn march(ray: Ray) -> f32 {
    let speed = length(ray.along);
    var at_m = ray.begin_m;
    // Depth and distance of the last point known to be outside. A depth of -1 means none.
    var outside = vec2f(-1.0, 0.0);
    // Steps are short up to this depth, because a long step passed an unobserved voxel.
    var short_steps_until_m = -1.0;
    for (var i = 0u; i < MAX_STEPS; i++) {
        if !(at_m < ray.end_m) { break; }
        let point = ray.origin + ray.along * at_m;
        let voxel = vec3i(floor(point));
        let slot = slot_of(voxel >> vec3u(3u));
        if slot == 0u {
            let chunk = voxel >> vec3u(6u);
            let is_empty = row_of(chunk) == 0u;
            let edge = select(8, 64, is_empty);
            let corner = select((voxel >> vec3u(3u)) * 8, chunk * 64, is_empty);
            at_m = max(at_m, exit_depth_m(ray, corner, edge)) + 0.01 / speed;
            outside.x = -1.0;
            continue;
        }
        let word = geometry[(slot - 1u) * BLOCK_VOXELS + voxel_in_block(voxel)];
        let nearest = stored_distance(word) * field.scale_m / field.voxel_m;
        let takes_short_steps = at_m < short_steps_until_m;
        // The interpolated distance would be unknown, because this voxel is one of its eight.
        if stored_weight(word) == 0u {
            at_m += select(1.0, 0.25, takes_short_steps) / speed;
            continue;
        }
        if nearest > 1.5 && !takes_short_steps {
            outside = vec2f(at_m, nearest);
            at_m += 0.8 * nearest / speed;
            continue;
        }
        let here = distance_at(point);
        if here == UNKNOWN {
            at_m += select(0.5, 0.25, takes_short_steps) / speed;
        } else if here >= 0.0 {
            outside = vec2f(at_m, here);
            at_m += select(max(0.8 * here, 0.25), 0.25, takes_short_steps) / speed;
        } else {
            if outside.x >= 0.0 {
                let found = crossing(ray, outside.x, at_m, outside.y, here, speed);
                if found != UNKNOWN {
                    if !is_erased(ray.origin + ray.along * found) { return found; }
                } else if !takes_short_steps {
                    short_steps_until_m = at_m + 0.5 / speed;
                    at_m = outside.x;
                    outside.x = -1.0;
                    continue;
                }
            }
            outside.x = -1.0;
            at_m += max(-0.8 * here, 0.5) / speed;
        }
    }
    return UNKNOWN;
}

@compute @workgroup_size(8, 8)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_id) lane: vec3u) {
    let ix = folded(wg, n_wgs);
    let n_columns = (view.size_px.x + 7u) / 8u;
    let pixel = vec2u(ix % n_columns, ix / n_columns) * 8u + lane.xy;
    if any(pixel >= view.size_px) { return; } // No barrier follows this return.
    cached_chunk = vec3i(0x7fffffff);
    cached_block = vec3i(0x7fffffff);
    let ray = ray_of(pixel);
    var depth_m = UNKNOWN;
    if status[BOUNDS_HIGH] != 0u { depth_m = march(ray); }
    let is_hit = depth_m != UNKNOWN;
    var rgb = backdrop.srgb.rgb;
    if is_hit { rgb = color_at(ray.origin + ray.along * depth_m); }
    let bytes = vec4u(floor(vec4f(clamp(rgb, vec3f(0.0), vec3f(1.0)), select(0.0, 1.0, is_hit)) * 255.0 + 0.5));
    let at = pixel.y * view.size_px.x + pixel.x;
    pixels[at] = bytes.x | (bytes.y << 8u) | (bytes.z << 16u) | (bytes.w << 24u);
    depths[at] = select(0.0, depth_m, is_hit);
}
