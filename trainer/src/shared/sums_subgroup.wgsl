// sums: sums over the 32 lanes of a workgroup by shuffles. The kernel defines a function `backward`.

override SUBGROUP = 32u;
var<workgroup> wg_parts: array<f32, 96>; // [LANES / 4, 12], per subgroup if the workgroup has several

@compute @workgroup_size(LANES)
fn main(
    @builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u,
    @builtin(subgroup_id) subgroup: u32, @builtin(subgroup_invocation_id) sub_lane: u32,
) {
    backward(folded(wg, n_wgs), subgroup * SUBGROUP + sub_lane);
}

// Sums component 2 (lane % 2) + lane / 2 % 2 over each group of four neighboring lanes.
fn sum_of_four(lane: u32, mine: vec4f) -> f32 {
    let odd = (lane & 1u) != 0u;
    let two = select(mine.xy, mine.zw, odd) + subgroupShuffleXor(select(mine.zw, mine.xy, odd), 1u);
    let high = (lane & 2u) != 0u;
    return select(two.x, two.y, high) + subgroupShuffleXor(select(two.y, two.x, high), 2u);
}

// Writes the sum of all lanes' gradients.
fn write_gradient_sum(lane: u32, slot: u32, mine: Gradient) {
    var sum = vec3f(sum_of_four(lane, mine.position), sum_of_four(lane, mine.conic), sum_of_four(lane, mine.color));
    for (var stride = 4u; stride < min(SUBGROUP, LANES); stride *= 2u) { sum += subgroupShuffleXor(sum, stride); }
    let part = lane / 4u * 4u + 2u * (lane & 1u) + (lane & 2u) / 2u;
    var value = select(select(sum.x, sum.y, lane >= 4u), sum.z, lane >= 8u);
    if SUBGROUP < LANES {
        let sub_lane = lane % SUBGROUP;
        if sub_lane < 4u {
            let at = lane / SUBGROUP * N_PARTS_OF_GRADIENT + part % 4u;
            wg_parts[at] = sum.x;
            wg_parts[at + 4u] = sum.y;
            wg_parts[at + 8u] = sum.z;
        }
        workgroupBarrier(); // All subgroups have written their sums.
        value = 0.0;
        for (var subgroup = 0u; subgroup < LANES / SUBGROUP; subgroup++) { value += wg_parts[subgroup * N_PARTS_OF_GRADIENT + min(part, 11u)]; }
        workgroupBarrier(); // All lanes have read the sums before those of the next splat are written.
    }
    if lane < N_PARTS_OF_GRADIENT { write_gradient(slot, part, value); }
}
