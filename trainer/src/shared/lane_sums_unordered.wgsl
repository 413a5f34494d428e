// lane_sums: sums over the lanes of a subgroup in the order the hardware chooses. For benchmarks only.

fn sum_of_lanes(mine: vec4f) -> vec4f {
    return subgroupAdd(mine);
}
