// march: walks a ray through the occupied parts of the scene. Import after `ray_batch`, `march_params`, `space`,
// `cell_blocks` and `occupied` of the kernel.
//
// twin      nerf/reference/march.rs
// source    occupancy: Mueller et al. 2022, appendix C; steps outside the inner cube grow to match the contraction
//
// Segments are numbered along the ray. The position of a segment follows from its number, so several threads can share
// one ray.

const FAR = 1e9;

struct Path {
    enter: f32,            // distance at which the ray enters the inner cube; `begin` of the ray if it misses the cube
    leave: f32,
    n_before: f32,         // steps before the inner cube
    n_inside: f32,
    n_segments: u32,
}

// Fraction of the steps from the inner cube to infinity that are needed to reach a distance from the cube. Steps grow
// with distance.
fn share_of(distance: f32) -> f32 { return 1.0 - 1.0 / (1.0 + distance); }
fn distance_of(share: f32) -> f32 { return 1.0 / (1.0 - share) - 1.0; }

fn path_of(march: March, ray: Ray) -> Path {
    let direction = select(ray.direction, vec3f(1.0 / FAR), abs(ray.direction) < vec3f(1.0 / FAR));
    let low = (-1.0 - ray.origin) / direction;
    let high = (1.0 - ray.origin) / direction;
    let near = min(low, high);
    let far = max(low, high);
    let enter = max(max(near.x, near.y), max(near.z, ray.begin));
    let leave = min(far.x, min(far.y, far.z));
    var path = Path(ray.begin, ray.begin, 0.0, 0.0, 0u);
    if leave > enter { path = Path(enter, leave, share_of(enter - ray.begin) / march.step, (leave - enter) / march.step, 0u); }
    // Leave out the last step, which reaches infinity.
    var n = path.n_before + path.n_inside + min(share_of(max(ray.end - path.leave, 0.0)) / march.step, 1.0 / march.step - 1.0);
    if ray.end < path.leave { n = path.n_before + (ray.end - path.enter) / march.step; }
    if ray.end < path.enter { n = path.n_before - share_of(path.enter - ray.end) / march.step; }
    path.n_segments = u32(clamp(ceil(n - ray.jitter), 0.0, 1e6));
    return path;
}

// Distance along the ray after this many steps.
fn distance_at(march: March, path: Path, steps: f32) -> f32 {
    if steps < path.n_before { return path.enter - distance_of((path.n_before - steps) * march.step); }
    let inside = steps - path.n_before;
    if inside < path.n_inside { return path.enter + inside * march.step; }
    return path.leave + distance_of((inside - path.n_inside) * march.step);
}

// Number of the segment at a distance along the ray.
fn segment_at(march: March, path: Path, distance: f32) -> u32 {
    var steps = path.n_before - share_of(max(path.enter - distance, 0.0)) / march.step;
    if distance > path.enter { steps = path.n_before + min((distance - path.enter) / march.step, path.n_inside); }
    if distance > path.leave { steps = path.n_before + path.n_inside + share_of(distance - path.leave) / march.step; }
    return u32(clamp(steps, 0.0, 1e6));
}

// Middle of a segment along the ray.
fn middle_of(march: March, ray: Ray, path: Path, ix: u32) -> vec3f {
    let steps = f32(ix) + ray.jitter;
    let inside = steps - path.n_before;
    var distance: f32;
    if inside >= 0.0 && inside + 1.0 <= path.n_inside {
        distance = path.enter + (inside + 0.5) * march.step;
    } else {
        distance = 0.5 * (distance_at(march, path, steps) + distance_at(march, path, steps + 1.0));
    }
    return ray.origin + distance * ray.direction;
}

// Start and end of a segment along the ray.
fn segment_of(march: March, ray: Ray, path: Path, ix: u32) -> vec2f {
    let steps = f32(ix) + ray.jitter;
    return vec2f(distance_at(march, path, steps), distance_at(march, path, steps + 1.0));
}

fn bit_of(first_word: u32, box: vec3u, log2_n: u32) -> bool {
    let ix = box.x + (box.y << log2_n) + (box.z << (2u * log2_n));
    return (occupied[first_word + ix / 32u] >> (ix % 32u) & 1u) == 1u;
}

// Whether the contraction of the segment from `first` to `last` lies inside the box [low, high] of the contracted space
// [-2, 2]^3. Both points are outside the inner cube, and `first` is known to be in the box. The test is conservative:
// it returns false if the dominant coordinate changes.
//
// If coordinate m is dominant (largest magnitude, same sign) at both points, it is also dominant between them. Any
// coordinate is then p = a m + b. With u = 1 / m, p contracts to (2 - u) (a + b u), which has one extremum, at u = 1 -
// a / (2 b).
fn stays_in_box(first: vec3f, last: vec3f, low: vec3f, high: vec3f) -> bool {
    let size = abs(first);
    let m = max(size.x, max(size.y, size.z));
    let axis = select(vec3f(0.0), sign(first), size == vec3f(m));
    let last_m = dot(last, axis) / dot(axis, axis);
    let last_size = abs(last);
    if m <= 1.0 || last_m <= 1.0 || last_m < max(last_size.x, max(last_size.y, last_size.z)) { return false; }
    let end = last * (2.0 - 1.0 / last_m) / last_m;
    if any(end < low) || any(end > high) { return false; }
    if last_m == m { return true; }
    let a = (last - first) / (last_m - m);
    let b = first - a * m;
    let u = 1.0 - 0.5 * a / b;
    let extremum = (2.0 - u) * (a + b * u);
    let is_between = (u > vec3f(min(1.0 / m, 1.0 / last_m))) & (u < vec3f(max(1.0 / m, 1.0 / last_m)));
    return !any(is_between & ((extremum < low) | (extremum > high)));
}

struct Visit {
    is_marked: bool,       // whether the segment is in a marked cell
    next_ix: u32,          // first segment that may be marked after this one
}

// Looks up the cell of a segment. Segments before `free_ix` count only if they are in solid cells.
fn visit(march: March, boxes: Boxes, ray: Ray, path: Path, ix: u32, end_ix: u32, free_ix: u32) -> Visit {
    let middle = middle_of(march, ray, path, ix);
    let is_inside = all(abs(middle) <= vec3f(1.0));
    var at = (middle + 2.0) / 4.0;
    if !is_inside { at = contract(middle); }
    let cell = min(vec3u(at * f32(march.n_cells)), vec3u(march.n_cells - 1u));
    let first_word = select(0u, boxes.set_words, ix < free_ix);
    // The largest empty box around the segment's midpoint.
    var log2_side = boxes.log2_block;
    if bit_of(first_word + boxes.block_word, cell >> vec3u(log2_side), boxes.log2_cells - log2_side) {
        log2_side = boxes.log2_group;
        if bit_of(first_word + boxes.group_word, cell >> vec3u(log2_side), boxes.log2_cells - log2_side) {
            log2_side = 0u;
            if bit_of(first_word, cell, boxes.log2_cells) { return Visit(true, ix + 1u); }
        }
    }
    let size = 4.0 * f32(1u << log2_side) / f32(march.n_cells);
    let low = vec3f(cell >> vec3u(log2_side)) * size - 2.0;
    let high = low + size;
    var n = 1u;
    if is_inside && all(low >= vec3f(-1.0)) && all(high <= vec3f(1.0)) {
        // Inside the inner cube, coordinates of the unit cube and of the world differ by a constant factor, so all
        // steps are equal.
        let out = (select(low, high, ray.direction > vec3f(0.0)) - middle) / ray.direction;
        let ends = select(out, vec3f(FAR), abs(ray.direction) < vec3f(1e-6));
        n = u32(clamp(min(ends.x, min(ends.y, ends.z)) / march.step + 0.5, 1.0, 4096.0)); // rounded down, with a margin
    } else {
        for (var more = select(0u, select(4u, 16u, log2_side == boxes.log2_block), log2_side > 0u); more > 1u; more /= 4u) {
            if ix + more < end_ix && stays_in_box(middle, middle_of(march, ray, path, ix + more), low, high) {
                n = more + 1u;
                break;
            }
        }
    }
    return Visit(false, select(ix + n, min(ix + n, free_ix), ix < free_ix));
}
