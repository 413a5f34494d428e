// count_bins: find the tiles that each splat touches. For each block and bin, count the splats of the block in the bin.
//
// threads   256 per block of 256 splats in order of depth, and per window of 256 bins
// reads     view, model, depth_keys (sorted), by_depth, projected_splats
// writes    tile_counts [n_splats]; in order of depth: touched [n_splats], slot_offsets [n_splats] (within the block),
//           block_slots [n_blocks] (intersections of the block), bin_counts [n_blocks, n_bins]

#import view
#import model
#import bins
#import tiles
#import block_bins
#import scan

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> model: Model;
@group(0) @binding(2) var<storage, read> by_depth: array<u32>;
@group(0) @binding(3) var<storage, read> depth_keys: array<u32>;
@group(0) @binding(4) var<storage, read> projected_splats: array<ProjectedSplat>;
@group(0) @binding(5) var<storage, read_write> touched: array<Touched>;
@group(0) @binding(6) var<storage, read_write> tile_counts: array<u32>;
@group(0) @binding(7) var<storage, read_write> slot_offsets: array<u32>;
@group(0) @binding(8) var<storage, read_write> block_slots: array<u32>;
@group(0) @binding(9) var<storage, read_write> bin_counts: array<u32>;

const INVISIBLE = 0xffffffffu; // Same value as in project.wgsl.
@compute @workgroup_size(BLOCK)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = block_and_window(folded(wg, n_wgs), model.n_splats, view.n_tiles);
    let rank = at.block * BLOCK + lane;
    var touches = Touched(0u, 0u, 0u);
    var splat_ix = 0u;
    if rank < model.n_splats {
        splat_ix = by_depth[rank];
        if depth_keys[rank] != INVISIBLE {
            let position = projected_splats[splat_ix].position;
            let conic = projected_splats[splat_ix].conic;
            touches = tiles_touched(Ellipse(position.xy, conic.xyz, conic.w), view.n_tiles);
        }
    }
    var n_slots = 0u;
    let offset = exclusive_scan(lane, n_tiles_of(touches), &n_slots);
    set_reached_bins(lane, at, touches);
    if at.block >= at.n_blocks { return; } // Past the last barrier.
    if lane < at.n_bins { bin_counts[at.block * at.bins.x * at.bins.y + at.first_bin + lane] = n_reaching(lane, BLOCK); }
    if at.first_bin > 0u { return; }
    if lane == 0u { block_slots[at.block] = n_slots; }
    if rank < model.n_splats {
        touched[rank] = touches;
        tile_counts[splat_ix] = n_tiles_of(touches);
        slot_offsets[rank] = offset;
    }
}
