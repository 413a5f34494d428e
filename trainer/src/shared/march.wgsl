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

// Fraction of the steps from the inner cube to infinity that are needed to reach a distance from it: steps grow with
// distance.
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

fn bit_of(first_word: u32, n: u32, cell: vec3u) -> bool {
    let ix = cell.x + n * (cell.y + n * cell.z);
    return (occupied[first_word + ix / 32u] >> (ix % 32u) & 1u) == 1u;
}

// Number of steps from `at` whose midpoints all lie in the same empty box of the unit cube; the first midpoint is in
// it. Returns one if the box extends beyond the inner cube. Only inside the inner cube do unit cube and world differ by
// a constant factor, so that all steps are equal.
fn n_empty_steps(march: March, at: vec3f, direction: vec3f, box: vec3u, n_boxes: u32) -> u32 {
    let size = 4.0 / f32(n_boxes);
    let low = vec3f(box) * size - 2.0;
    let high = low + size;
    if any(abs(at) > vec3f(1.0)) || any(low < vec3f(-1.0)) || any(high > vec3f(1.0)) { return 1u; }
    let out = (select(low, high, direction > vec3f(0.0)) - at) / direction;
    let ends = select(out, vec3f(FAR), abs(direction) < vec3f(1e-6));
    return u32(clamp(min(ends.x, min(ends.y, ends.z)) / march.step - 0.5, 1.0, 4096.0));
}

// A segment of a ray in an occupied cell. If there is none before `end_ix`, `ix` is `end_ix`.
struct RaySegment {
    ix: u32,
    begin: f32,
    end: f32,
}

// The first such segment, starting the search at number `from_ix`.
fn next_segment(march: March, ray: Ray, path: Path, from_ix: u32, end_ix: u32) -> RaySegment {
    let block_cells = block_cells_of(march.n_cells);
    let n_blocks = march.n_cells / block_cells;
    let n_words = march.n_cells * march.n_cells * march.n_cells / 32u;
    var ix = from_ix;
    while ix < end_ix {
        let begin = distance_at(march, path, f32(ix) + ray.jitter);
        let end = distance_at(march, path, f32(ix + 1u) + ray.jitter);
        let middle = contract(ray.origin + 0.5 * (begin + end) * ray.direction);
        let cell = min(vec3u(middle * f32(march.n_cells)), vec3u(march.n_cells - 1u));
        let block = cell / block_cells;
        let block_is_empty = !bit_of(n_words, n_blocks, block);
        if !block_is_empty && bit_of(0u, march.n_cells, cell) { return RaySegment(ix, begin, end); }
        let at = ray.origin + begin * ray.direction;
        ix += n_empty_steps(march, at, ray.direction, select(cell, block, block_is_empty), select(march.n_cells, n_blocks, block_is_empty));
    }
    return RaySegment(end_ix, 0.0, 0.0);
}
