// handover: the state of the lane below, through workgroup memory; two halves take turns so that one barrier a round is enough.

var<workgroup> wg_handover: array<vec2f, 256>;

fn handed_over(lane: u32, round: u32, state: vec2f) -> vec2f {
    let half = (round & 1u) * 128u;
    wg_handover[half + lane] = state;
    workgroupBarrier(); // All states of this round are there.
    return wg_handover[half + max(lane, 1u) - 1u];
}
