// peers: sets of lanes of a subgroup of up to 128.

alias Lanes = vec4u;

// Lanes of the subgroup with the same digit as this lane.
fn peers_of(key_digit: u32, valid: bool) -> Lanes {
    var peers = subgroupBallot(valid);
    for (var bit = 0u; bit < 8u; bit++) {
        let mine = (key_digit & (1u << bit)) != 0u;
        let having = subgroupBallot(mine);
        peers &= select(~having, having, vec4<bool>(mine));
    }
    return peers;
}

fn n_bits(mask: Lanes) -> u32 {
    let n = countOneBits(mask);
    return n.x + n.y + n.z + n.w;
}

// Mask of the lanes below `lane`.
fn lanes_below(lane: u32) -> Lanes {
    let first = vec4u(0u, 32u, 64u, 96u);
    let n = clamp(vec4i(i32(lane)) - vec4i(first), vec4i(0), vec4i(32));
    return select((vec4u(1u) << vec4u(n)) - vec4u(1u), vec4u(0xffffffffu), n == vec4i(32));
}

fn lowest_lane(mask: Lanes) -> u32 {
    if mask.x != 0u { return firstTrailingBit(mask.x); }
    if mask.y != 0u { return 32u + firstTrailingBit(mask.y); }
    if mask.z != 0u { return 64u + firstTrailingBit(mask.z); }
    return 96u + firstTrailingBit(mask.w);
}
