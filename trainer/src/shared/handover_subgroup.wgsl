// handover: the state of the lane below, by subgroup shuffle; the workgroup is one subgroup.

fn handed_over(lane: u32, round: u32, state: vec2f) -> vec2f {
    return subgroupShuffleUp(state, 1u);
}
