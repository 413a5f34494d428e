// handover: the state of the lane below, through workgroup memory; two halves take turns so that one barrier a round is enough.

struct State {
    transmittance: Px,
    behind: Px,
}

var<workgroup> wg_handover: array<State, 64>;

fn handed_over(lane: u32, round: u32, state: State) -> State {
    let half = (round & 1u) * 32u;
    wg_handover[half + lane] = state;
    workgroupBarrier(); // All states of this round are there.
    return wg_handover[half + max(lane, 1u) - 1u];
}
