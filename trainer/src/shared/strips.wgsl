// strips: a workgroup of 8 lanes in one subgroup processes a tile in strips of two rows, 4 neighboring pixels per lane.
//
// This code is for software adapters, whose lanes read memory one after another, while a shuffle is one instruction.
// Each lane therefore reads one splat of eight and shares it by shuffles. On these adapters, a branch executes both of
// its sides, and only loops end early. Splats that do not reach a strip are therefore excluded before the loop.

const LANES = 8u;
const N_STRIPS = 8u;

#import pixels

const QUEUE = 512u;
var<workgroup> wg_queue: array<u32, QUEUE>;

// Position within the tile of the lane's first pixel of a strip.
fn strip_px(strip: u32, lane: u32) -> vec2u {
    return vec2u((lane & 3u) * PX, strip * 2u + (lane >> 2u));
}

// Whether a splat may reach two rows; the pixel centers of the first row are at `top`. The result is exact except for a
// margin that exceeds the rounding error of c - b b / a.
fn reaches_strip(position: vec4f, conic: vec4f, top: f32) -> bool {
    let dy = max(max(top - position.y, position.y - (top + 1.0)), 0.0);
    let min_distance = (conic.z - conic.y * conic.y / conic.x - 1e-5 * conic.z) * dy * dy;
    return min_distance <= conic.w;
}

fn or_of_lanes(own: u32) -> u32 {
    var all = own | subgroupShuffleXor(own, 1u);
    all |= subgroupShuffleXor(all, 2u);
    return all | subgroupShuffleXor(all, 4u);
}

fn max_of_lanes(own: u32) -> u32 {
    var all = max(own, subgroupShuffleXor(own, 1u));
    all = max(all, subgroupShuffleXor(all, 2u));
    return max(all, subgroupShuffleXor(all, 4u));
}

// Queues the tile's entries in order, starting at word `next`, until the queue might overflow or the list ends. Returns
// the number of queued entries (x) and the next word (y).
fn queue_entries(lane: u32, next: u32, tile: Tile) -> vec2u {
    workgroupBarrier(); // All lanes have finished reading the previous queue.
    var n = 0u;
    var word = next;
    while word * 32u < tile.end && n + LANES * 32u <= QUEUE {
        var bits = entries_of(tile, word + lane);
        let n_mine = countOneBits(bits);
        // This loop computes the prefix sum over the lanes by doubling the distance.
        var upto = n_mine;
        for (var stride = 1u; stride < LANES; stride *= 2u) {
            let below = subgroupShuffle(upto, max(lane, stride) - stride);
            upto += select(0u, below, lane >= stride);
        }
        var at = n + upto - n_mine;
        while bits != 0u {
            wg_queue[at] = (word + lane) * 32u + firstTrailingBit(bits);
            bits &= bits - 1u;
            at++;
        }
        n += subgroupShuffle(upto, LANES - 1u);
        word += LANES;
    }
    workgroupBarrier(); // The queue is written.
    return vec2u(n, word);
}
