// sums: adds up over the lanes of a tile by shuffles; the kernel is a function `backward`. After `tile_queue`.

override SUBGROUP = 32u;
// Of each subgroup: [128 / SUBGROUP, BATCH, 12]. A splat has sums only where the subgroup walked over it.
var<workgroup> wg_parts: array<f32, BATCH * N_PARTS_OF_GRADIENT * (LANES / SUBGROUP)>;

@compute @workgroup_size(LANES)
fn main(
    @builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u,
    @builtin(subgroup_id) subgroup: u32, @builtin(subgroup_invocation_id) sub_lane: u32,
) {
    backward(folded(wg, n_wgs), subgroup * SUBGROUP + sub_lane);
}

// The splats that the quarters of a lane's subgroup touch.
fn shared_bits(lane: u32, word: u32) -> u32 {
    let first = lane / SUBGROUP * SUBGROUP / 32u;
    var bits = 0u;
    for (var quarter = first; quarter * 32u < (lane / SUBGROUP + 1u) * SUBGROUP; quarter++) {
        bits |= atomicLoad(&wg_touching[quarter * 4u + word]);
    }
    return bits;
}

fn anyone(mine: bool) -> bool {
    return subgroupAny(mine);
}

// The sum over each four neighbouring lanes of component 2 (lane % 2) + lane / 2 % 2.
fn sum_of_four(lane: u32, mine: vec4f) -> f32 {
    let odd = (lane & 1u) != 0u;
    let two = select(mine.xy, mine.zw, odd) + subgroupShuffleXor(select(mine.zw, mine.xy, odd), 1u);
    let high = (lane & 2u) != 0u;
    return select(two.x, two.y, high) + subgroupShuffleXor(select(two.y, two.x, high), 2u);
}

// Takes in what every lane of a subgroup tells about splat `i` of the batch.
fn hand_in(lane: u32, i: u32, mine: Gradient) {
    var sum = vec3f(sum_of_four(lane, mine.place), sum_of_four(lane, mine.conic), sum_of_four(lane, mine.color));
    for (var stride = 4u; stride < SUBGROUP; stride *= 2u) { sum += subgroupShuffleXor(sum, stride); }
    let sub_lane = lane % SUBGROUP;
    if sub_lane < 4u {
        let at = (lane / SUBGROUP * BATCH + i) * N_PARTS_OF_GRADIENT + 2u * (sub_lane & 1u) + sub_lane / 2u;
        wg_parts[at] = sum.x;
        wg_parts[at + 4u] = sum.y;
        wg_parts[at + 8u] = sum.z;
    }
}

fn sum_of_parts(i: u32, part_of_gradient: u32) -> f32 {
    var sum = 0.0;
    for (var subgroup = 0u; subgroup < LANES / SUBGROUP; subgroup++) {
        if (shared_bits(subgroup * SUBGROUP, i / 32u) & (1u << (i % 32u))) != 0u {
            sum += wg_parts[(subgroup * BATCH + i) * N_PARTS_OF_GRADIENT + part_of_gradient];
        }
    }
    return sum;
}
