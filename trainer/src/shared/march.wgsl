// march: how a ray is walked through the parts of the scene that hold something. After `ray_batch`,
// `march_params` and `space`.
//
// twin      nerf/reference/march.rs
// source    occupancy: Mueller et al. 2022, appendix C; steps grow outside the inner cube as contraction shrinks them

const MOST_STEPS = 4096u;

fn step_at(march: March, at: vec3f) -> f32 {
    let size = abs(at);
    let largest = max(1.0, max(size.x, max(size.y, size.z)));
    return march.step * largest * largest;
}

fn cell_in_occupancy(march: March, at: vec3f) -> u32 {
    let cell = min(vec3u(contract(at) * f32(march.n_cells)), vec3u(march.n_cells - 1u));
    return cell.x + march.n_cells * (cell.y + march.n_cells * cell.z);
}

fn is_occupied(cell: u32) -> bool {
    return (occupied[cell / 32u] >> (cell % 32u) & 1u) == 1u;
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
        let length = step_at(march, ray.origin + t * ray.direction);
        let cell = cell_in_occupancy(march, ray.origin + (t + 0.5 * length) * ray.direction);
        if is_occupied(cell) { return Walk(t, length, false); }
        t += length;
    }
    return Walk(t, 0.0, true);
}

fn begin_of(march: March, ray: Ray) -> f32 {
    return ray.begin + ray.shift * step_at(march, ray.origin + ray.begin * ray.direction);
}
