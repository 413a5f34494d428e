// march: how a ray is walked through the parts of the scene that hold something. After `ray_batch`,
// `march_params` and `space`.
//
// twin      nerf/reference/march.rs
// source    occupancy: Mueller et al. 2022, appendix C; steps grow outside the inner cube as contraction shrinks them

const MOST_STEPS = 4096u;
const FAR = 1e9;
// Cells are told of one by one and, behind those, in blocks: so many along an axis.
const MOST_BLOCKS = 16u;

fn step_at(march: March, at: vec3f) -> f32 {
    let size = abs(at);
    let largest = max(1.0, max(size.x, max(size.y, size.z)));
    return march.step * largest * largest;
}

fn cell_in_occupancy(march: March, at: vec3f) -> vec3u {
    return min(vec3u(contract(at) * f32(march.n_cells)), vec3u(march.n_cells - 1u));
}

fn bit_of(first_word: u32, n: u32, cell: vec3u) -> bool {
    let ix = cell.x + n * (cell.y + n * cell.z);
    return (occupied[first_word + ix / 32u] >> (ix % 32u) & 1u) == 1u;
}

// Steps from `at` on whose middles surely lie in a box of the unit cube that holds nothing; one where the box reaches out of the inner
// cube, inside of which the unit cube and the world differ by a factor alone and all steps are alike.
fn n_empty_steps(march: March, at: vec3f, direction: vec3f, box: vec3u, n_boxes: u32) -> f32 {
    let size = 4.0 / f32(n_boxes);
    let low = vec3f(box) * size - 2.0;
    let high = low + size;
    if any(abs(at) > vec3f(1.0)) || any(low < vec3f(-1.0)) || any(high > vec3f(1.0)) { return 1.0; }
    let out = (select(low, high, direction > vec3f(0.0)) - at) / direction;
    let ends = select(out, vec3f(FAR), abs(direction) < vec3f(1e-6));
    return max(1.0, floor(min(ends.x, min(ends.y, ends.z)) / march.step - 0.5));
}

// Where a walk stands: the next piece begins at `t`.
struct Walk {
    t: f32,
    length: f32,           // of the piece that was found
    is_over: bool,
}

// Walks on to the next piece in a cell that holds something; `t` is where it begins.
fn next_piece(march: March, ray: Ray, from_t: f32) -> Walk {
    var t = from_t;
    for (var i = 0u; i < MOST_STEPS; i++) {
        if !(t < ray.end) { break; }
        let at = ray.origin + t * ray.direction;
        let length = step_at(march, at);
        let cell = cell_in_occupancy(march, at + 0.5 * length * ray.direction);
        let block_cells = max(march.n_cells / MOST_BLOCKS, 1u);
        let n_blocks = march.n_cells / block_cells;
        let n_words = march.n_cells * march.n_cells * march.n_cells / 32u;
        var n_steps: f32;
        if !bit_of(n_words, n_blocks, cell / block_cells) {
            n_steps = n_empty_steps(march, at, ray.direction, cell / block_cells, n_blocks);
        } else if !bit_of(0u, march.n_cells, cell) {
            n_steps = n_empty_steps(march, at, ray.direction, cell, march.n_cells);
        } else {
            return Walk(t, length, false);
        }
        t += n_steps * length;
    }
    return Walk(t, 0.0, true);
}

fn begin_of(march: March, ray: Ray) -> f32 {
    return ray.begin + ray.shift * step_at(march, ray.origin + ray.begin * ray.direction);
}
