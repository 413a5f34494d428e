// lane_sums: adds up over the lanes of a subgroup in whatever order the hardware takes. Only to be measured.

fn sum_of_lanes(mine: vec4f) -> vec4f {
    return subgroupAdd(mine);
}
