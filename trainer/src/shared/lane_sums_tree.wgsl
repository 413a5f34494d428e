// lane_sums: sums over the 8 lanes of a subgroup in a fixed order.

fn sum_of_lanes(mine: vec4f) -> vec4f {
    var all = mine + subgroupShuffleXor(mine, 1u);
    all += subgroupShuffleXor(all, 2u);
    return all + subgroupShuffleXor(all, 4u);
}
