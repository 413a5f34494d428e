// sums: sums over the 32 lanes of a workgroup through workgroup memory, for adapters without subgroups. The kernel
// defines a function `backward`.

var<workgroup> wg_lanes: array<f32, 384>; // [LANES, 12]

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    backward(folded(wg, n_wgs), lane);
}

// Writes the sum of all lanes' gradients.
fn write_gradient_sum(lane: u32, slot: u32, mine: Gradient) {
    for (var k = 0u; k < 4u; k++) {
        wg_lanes[lane * N_PARTS_OF_GRADIENT + k] = mine.position[k];
        wg_lanes[lane * N_PARTS_OF_GRADIENT + 4u + k] = mine.conic[k];
        wg_lanes[lane * N_PARTS_OF_GRADIENT + 8u + k] = mine.color[k];
    }
    workgroupBarrier(); // All lanes have written their gradients.
    if lane < N_PARTS_OF_GRADIENT {
        var sum = 0.0;
        for (var k = 0u; k < LANES; k++) { sum += wg_lanes[k * N_PARTS_OF_GRADIENT + lane]; }
        write_gradient(slot, lane, sum);
    }
    workgroupBarrier(); // All sums are complete before the next splat's gradients are written.
}
