// peers: sets of lanes of a subgroup of up to 32.

alias Lanes = u32;

// Lanes of the subgroup with the same digit as this lane.
fn peers_of(key_digit: u32, valid: bool) -> Lanes {
    var peers = subgroupBallot(valid).x;
    for (var bit = 0u; bit < 8u; bit++) {
        let mine = (key_digit & (1u << bit)) != 0u;
        let having = subgroupBallot(mine).x;
        peers &= select(~having, having, mine);
    }
    return peers;
}

fn n_bits(mask: Lanes) -> u32 {
    return countOneBits(mask);
}

// Mask of the lanes below `lane`.
fn lanes_below(lane: u32) -> Lanes {
    return (1u << lane) - 1u;
}

fn lowest_lane(mask: Lanes) -> u32 {
    return firstTrailingBit(mask);
}
