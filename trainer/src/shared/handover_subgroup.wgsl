// handover: the state of the lane below, by subgroup shuffle; the workgroup is one subgroup.

struct State {
    transmittance: Px,
    behind: Px,
}

fn handed_over(lane: u32, round: u32, state: State) -> State {
    return State(subgroupShuffleUp(state.transmittance, 1u), subgroupShuffleUp(state.behind, 1u));
}
