// sums: sums over the lanes of each subgroup in the order the hardware chooses; the kernel is a function `backward`.
// For benchmarks only, together with `gradients_unordered`.

override SUBGROUP = 32u;

@compute @workgroup_size(LANES)
fn main(
    @builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u,
    @builtin(subgroup_id) subgroup: u32, @builtin(subgroup_invocation_id) sub_lane: u32,
) {
    backward(folded(wg, n_wgs), subgroup * SUBGROUP + sub_lane);
}

// Adds the sum over all lanes of the subgroup, which has at least 16.
fn write_gradient_sum(lane: u32, slot: u32, mine: Gradient) {
    let position = subgroupAdd(mine.position);
    let conic = subgroupAdd(mine.conic);
    let color = subgroupAdd(mine.color);
    let part = lane % min(SUBGROUP, LANES);
    let four = select(select(position, conic, part >= 4u), color, part >= 8u);
    let two = select(four.xy, four.zw, (part & 2u) != 0u);
    if part < N_PARTS_OF_GRADIENT { write_gradient(slot, part, select(two.x, two.y, (part & 1u) != 0u)); }
}
