// backward_strips: `backward` for software adapters, whose lanes access memory sequentially.
//
// threads   a workgroup of 8 per tile (see `strips`); each lane owns four of the 32 splats of a batch
// reads     same as `backward`
// writes    gradients [n_slots]: each slot is written only by its owner
// twin      splat/reference/rasterize.rs
// source    same as `backward`
//
// Strips are processed one after another. Lanes hold the state of a strip's pixels while 32 splats are processed in
// order. Shuffles sum each splat's gradient over the strip's pixels, and the lane that owns the splat adds up the sums.

#import backward_bindings
#import strips
#import coverage

const BATCH = 32u;
// State of a lane's pixels of one strip between two batches.
struct StripState {
    transmittance: Px,
    behind: Px,
}
var<workgroup> wg_strip_states: array<StripState, 64>; // [N_STRIPS, LANES]

// One splat per lane, and the sum of its gradients so far.
struct Owned {
    entry: u32,        // past the end of the list if the lane owns no splat
    splat: ProjectedSplat,
    half: vec4f,       // its conic, processed by `halved`
    sum: Gradient,     // before `finished`
}

fn owned_splat(at: u32, n_queued: u32) -> Owned {
    var owned: Owned;
    owned.entry = 0xffffffffu;
    owned.splat.conic.w = -1.0; // Reaches no pixel.
    if at < n_queued {
        owned.entry = wg_queue[at];
        owned.splat = projected_splats[entries[owned.entry].x];
        owned.half = halved(owned.splat.conic);
    }
    return owned;
}

// Sum over the 8 lanes of the subgroup in a fixed order.
fn sum_of_lanes(mine: vec4f) -> vec4f {
    var all = mine + subgroupShuffleXor(mine, 1u);
    all += subgroupShuffleXor(all, 2u);
    return all + subgroupShuffleXor(all, 4u);
}

// A lane's pixels of one strip.
struct Strip {
    center_x: Px,
    center_y: f32,
    top: f32,          // center of the strip's first row
    begin: u32,        // start of the bin's list
    past_last: u32,    // the largest `last` of the strip
}

// Processes eight splats, in order, for the strip's pixels.
fn pass_strip(lane: u32, owned: ptr<function, Owned>, strip: Strip, pixels: ptr<function, Pixels>) {
    let splat = (*owned).splat;
    let rank = (*owned).entry - strip.begin;
    let reaches = rank < strip.past_last && splat.conic.w >= 0.0 && reaches_strip(splat.position, splat.conic, strip.top);
    var reaching = or_of_lanes(select(0u, 1u << lane, reaches));
    loop {
        let some = reaching != 0u; // The loop body runs even if no splat reaches the strip.
        let i = firstTrailingBit(reaching) & 7u;
        reaching &= reaching - 1u;
        let passing = ProjectedSplat(subgroupShuffle(splat.position, i), subgroupShuffle((*owned).half, i), subgroupShuffle(splat.color, i));
        let dx = passing.position.x - strip.center_x;
        let dy = passing.position.y - strip.center_y;
        let power = power_at(passing.conic, dx, dy);
        let hit = (PxU(subgroupShuffle(rank, i)) < (*pixels).last) & within_reach(passing.conic, power) & PxB(some);
        let part = passed(pixels, hit, power, dx, dy, passing);
        let is_owner = select(0.0, 1.0, some && lane == i);
        (*owned).sum.position += is_owner * sum_of_lanes(part.position);
        (*owned).sum.conic += is_owner * sum_of_lanes(part.conic);
        (*owned).sum.color += is_owner * sum_of_lanes(part.color);
        continuing {
            break if reaching == 0u;
        }
    }
}

fn write_gradient_sum(owned: Owned, tile: Tile) {
    if owned.entry == 0xffffffffu { return; }
    let sum = finished(owned.sum, owned.half);
    let slot = slot_of(owned.entry, tile);
    for (var k = 0u; k < 4u; k++) {
        write_gradient(slot, k, sum.position[k]);
        write_gradient(slot, 4u + k, sum.conic[k]);
        write_gradient(slot, 8u + k, sum.color[k]);
    }
}

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(subgroup_invocation_id) lane: u32) {
    let tile = tile_at(folded(wg, n_wgs));
    var max_of_tile = 0u;
    for (var strip = 0u; strip < N_STRIPS; strip++) {
        let pixels = pixels_at(tile, tile.corner + strip_px(strip, lane));
        max_of_tile = max(max_of_tile, max(max(pixels.last.x, pixels.last.y), max(pixels.last.z, pixels.last.w)));
        wg_strip_states[strip * LANES + lane] = StripState(pixels.transmittance, pixels.behind);
    }
    let past_last = max_of_lanes(max_of_tile);
    var next = tile.begin / 32u;
    while next * 32u < tile.end {
        let queued = queue_entries(lane, next, tile);
        next = queued.y;
        for (var batch = 0u; batch < queued.x; batch += BATCH) {
            // Four named variables instead of an array, because arrays are stored in memory, which is slow here.
            var a = owned_splat(batch + lane, queued.x);
            var b = owned_splat(batch + lane + LANES, queued.x);
            var c = owned_splat(batch + lane + 2u * LANES, queued.x);
            var d = owned_splat(batch + lane + 3u * LANES, queued.x);
            let reached = wg_queue[batch] - tile.begin < past_last; // Otherwise, the batch is hidden: its gradients are zero.
            for (var strip_ix = 0u; strip_ix < N_STRIPS && reached; strip_ix++) {
                let first = tile.corner + strip_px(strip_ix, lane);
                var pixels = pixels_at(tile, first);
                let strip_state = wg_strip_states[strip_ix * LANES + lane];
                pixels.transmittance = strip_state.transmittance;
                pixels.behind = strip_state.behind;
                let max_of_strip = max(max(pixels.last.x, pixels.last.y), max(pixels.last.z, pixels.last.w));
                let top = f32(tile.corner.y + strip_ix * 2u) + 0.5;
                let strip = Strip(f32(first.x) + 0.5 + RAMP, f32(first.y) + 0.5, top, tile.begin, max_of_lanes(max_of_strip));
                pass_strip(lane, &a, strip, &pixels);
                pass_strip(lane, &b, strip, &pixels);
                pass_strip(lane, &c, strip, &pixels);
                pass_strip(lane, &d, strip, &pixels);
                wg_strip_states[strip_ix * LANES + lane] = StripState(pixels.transmittance, pixels.behind);
            }
            write_gradient_sum(a, tile);
            write_gradient_sum(b, tile);
            write_gradient_sum(c, tile);
            write_gradient_sum(d, tile);
        }
    }
}
