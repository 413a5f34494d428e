// rasterize: blend each tile's splats front to back.
//
// threads   one per PX pixels of a row, a workgroup per tile
// reads     view, status, tile_ranges, bucket_starts, sorted_splats, drawn
// writes    image [n_pixels] (premultiplied rgb, transmittance), depth [n_pixels] (premultiplied), last [n_pixels]
//           (past the last contributor, counted from the tile's first); with STATES also bucket_tiles [n_buckets],
//           bucket_color [n_buckets, 256] (what lies in front of the bucket, transmittance), bucket_depth, tile_last
// twin      splat/reference/rasterize.rs
// source    Kerbl et al. 2023, section 6; states per bucket as in Mallick et al. 2024 (Taming 3DGS)

#import view
#import model
#import projection
#import pixels
#import status

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> status: array<u32>;
@group(0) @binding(2) var<storage, read> tile_ranges: array<vec2u>;
@group(0) @binding(3) var<storage, read> bucket_starts: array<u32>;
@group(0) @binding(4) var<storage, read> sorted_splats: array<u32>;
@group(0) @binding(5) var<storage, read> drawn: array<Drawn>;
@group(0) @binding(6) var<storage, read_write> image: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> depth: array<f32>;
@group(0) @binding(8) var<storage, read_write> last: array<u32>;
@group(0) @binding(9) var<storage, read_write> bucket_tiles: array<u32>;
@group(0) @binding(10) var<storage, read_write> bucket_color: array<vec4f>;
@group(0) @binding(11) var<storage, read_write> bucket_depth: array<f32>;
@group(0) @binding(12) var<storage, read_write> tile_last: array<u32>;

override STATES: bool = true;
const BATCH = 256u;
const LANES = 256u / PX;
const LANES_PER_ROW = TILE_PX / PX;
var<workgroup> wg_drawn: array<Drawn, 256>;
var<workgroup> wg_n_done: atomic<u32>;
var<workgroup> wg_last: atomic<u32>;
var<workgroup> wg_range: vec2u;
var<workgroup> wg_all_done: u32;

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let tile = folded(wg, n_wgs);
    let in_grid = tile < view.n_tiles.x * view.n_tiles.y;
    if lane == 0u {
        wg_range = vec2u(0u);
        if in_grid && status[FAILED] == 0u { wg_range = tile_ranges[tile]; }
        atomicStore(&wg_n_done, 0u);
        atomicStore(&wg_last, 0u);
    }
    let range = workgroupUniformLoad(&wg_range); // Also orders the zeroing before anyone adds.
    let n_splats = max(range.x, range.y) - range.x;
    let corner = vec2u(tile % view.n_tiles.x, tile / view.n_tiles.x) * TILE_PX;
    let first = corner + vec2u((lane % LANES_PER_ROW) * PX, lane / LANES_PER_ROW);
    let center_x = f32(first.x) + 0.5 + RAMP;
    let center_y = f32(first.y) + 0.5;
    let on_image = (center_x < Px(f32(view.size_px.x))) & PxB(in_grid && first.y < view.size_px.y);
    var red = Px(0.0);
    var green = Px(0.0);
    var blue = Px(0.0);
    var depth_sum = Px(0.0);
    var transmittance = Px(1.0);
    var past_last = PxU(0u);
    var live = on_image;
    var counted = !any(live);
    if counted { atomicAdd(&wg_n_done, 1u); }
    var bucket = 0u;
    if STATES && in_grid {
        bucket = bucket_starts[tile];
        // All of them, also those past the last contributor: their slots hold nothing until backward says so.
        for (var i = lane; i < (n_splats + 31u) / 32u; i += LANES) { bucket_tiles[bucket + i] = tile; }
    }
    for (var batch = 0u; batch < n_splats; batch += BATCH) {
        workgroupBarrier(); // All have counted themselves done, and read the last batch.
        if lane == 0u { wg_all_done = atomicLoad(&wg_n_done); }
        if workgroupUniformLoad(&wg_all_done) == LANES { break; }
        for (var i = lane; i < BATCH; i += LANES) {
            if batch + i < n_splats { wg_drawn[i] = drawn[sorted_splats[range.x + batch + i]]; }
        }
        workgroupBarrier(); // The batch is there before anyone reads it.
        let n_in_batch = min(BATCH, n_splats - batch);
        for (var i = 0u; i < n_in_batch; i++) {
            if STATES && i % 32u == 0u {
                let at = bucket + (batch + i) / 32u;
                for (var k = 0u; k < PX; k++) {
                    bucket_color[at * 256u + lane * PX + k] = vec4f(red[k], green[k], blue[k], transmittance[k]);
                    bucket_depth[at * 256u + lane * PX + k] = depth_sum[k];
                }
            }
            if counted { continue; }
            let place = wg_drawn[i].place;
            let conic = wg_drawn[i].conic;
            let dx = place.x - center_x;
            let dy = place.y - center_y;
            let power = 0.5 * (conic.x * dx * dx + conic.z * dy * dy) + conic.y * dy * dx;
            let hit = live & (power >= Px(0.0)) & (power <= Px(0.5 * conic.w));
            if !any(hit) { continue; }
            let alpha = min(Px(MAX_ALPHA), place.w * exp(-power));
            let next = transmittance * (1.0 - alpha);
            let goes_on = next > Px(MIN_TRANSMITTANCE);
            let adds = hit & goes_on;
            let weight = select(Px(0.0), alpha * transmittance, adds);
            let color = wg_drawn[i].color;
            red += weight * color.x;
            green += weight * color.y;
            blue += weight * color.z;
            depth_sum += weight * place.z;
            transmittance = select(transmittance, next, adds);
            past_last = select(past_last, PxU(batch + i + 1u), adds);
            live = live & (goes_on | !hit);
            if !any(live) {
                counted = true;
                atomicAdd(&wg_n_done, 1u);
            }
        }
    }
    for (var k = 0u; k < PX; k++) {
        if !on_image[k] { continue; }
        let at = first.y * view.size_px.x + first.x + k;
        image[at] = vec4f(red[k], green[k], blue[k], transmittance[k]);
        depth[at] = depth_sum[k];
        last[at] = past_last[k];
    }
    if STATES {
        for (var k = 0u; k < PX; k++) { atomicMax(&wg_last, past_last[k]); }
        workgroupBarrier(); // All have told their last.
        if lane == 0u && in_grid { tile_last[tile] = atomicLoad(&wg_last); }
    }
}
