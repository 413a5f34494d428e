// sums: adds up over the lanes of a tile through workgroup memory, where there are no subgroups; the kernel is a function
// `backward`. After `tile_queue`. All lanes walk over the same splats, so that they meet at the barriers.

var<workgroup> wg_lanes: array<f32, LANES * N_PARTS_OF_GRADIENT>;
var<workgroup> wg_parts: array<f32, BATCH * N_PARTS_OF_GRADIENT>;

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    backward(folded(wg, n_wgs), lane);
}

// The splats that any quarter touches.
fn shared_bits(lane: u32, word: u32) -> u32 {
    var bits = 0u;
    for (var quarter = 0u; quarter < 4u; quarter++) { bits |= atomicLoad(&wg_touching[quarter * 4u + word]); }
    return bits;
}

fn anyone(mine: bool) -> bool {
    return true;
}

// Takes in what every lane tells about splat `i` of the batch.
fn hand_in(lane: u32, i: u32, mine: Gradient) {
    for (var k = 0u; k < 4u; k++) {
        wg_lanes[lane * N_PARTS_OF_GRADIENT + k] = mine.place[k];
        wg_lanes[lane * N_PARTS_OF_GRADIENT + 4u + k] = mine.conic[k];
        wg_lanes[lane * N_PARTS_OF_GRADIENT + 8u + k] = mine.color[k];
    }
    workgroupBarrier(); // All have told.
    if lane < N_PARTS_OF_GRADIENT {
        var sum = 0.0;
        for (var k = 0u; k < LANES; k++) { sum += wg_lanes[k * N_PARTS_OF_GRADIENT + lane]; }
        wg_parts[i * N_PARTS_OF_GRADIENT + lane] = sum;
    }
    workgroupBarrier(); // All are summed before the next splat is told of.
}

fn sum_of_parts(i: u32, part_of_gradient: u32) -> f32 {
    if (shared_bits(0u, i / 32u) & (1u << (i % 32u))) == 0u { return 0.0; }
    return wg_parts[i * N_PARTS_OF_GRADIENT + part_of_gradient];
}
