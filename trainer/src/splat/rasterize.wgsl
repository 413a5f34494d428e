// rasterize: blend each tile's splats front to back.
//
// threads   one per pixel, a workgroup per tile
// reads     view, status, tile_ranges, bucket_starts, sorted_splats, drawn
// writes    image [n_pixels] (premultiplied rgb, transmittance), depth [n_pixels] (premultiplied), last [n_pixels]
//           (past the last contributor, counted from the tile's first); with STATES also bucket_tiles [n_buckets],
//           bucket_color [n_buckets, 256] (what lies in front of the bucket, transmittance), bucket_depth, tile_last
// twin      splat/reference/rasterize.rs
// source    Kerbl et al. 2023, section 6; states per bucket as in Mallick et al. 2024 (Taming 3DGS)

#import view
#import model
#import projection
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
var<workgroup> wg_drawn: array<Drawn, 256>;
var<workgroup> wg_n_done: atomic<u32>;
var<workgroup> wg_last: atomic<u32>;
var<workgroup> wg_range: vec2u;
var<workgroup> wg_all_done: u32;

@compute @workgroup_size(16, 16)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32, @builtin(local_invocation_id) local: vec3u) {
    let tile = folded(wg, n_wgs);
    let in_grid = tile < view.n_tiles.x * view.n_tiles.y;
    if lane == 0u {
        wg_range = vec2u(0u);
        if in_grid && status[FAILED] == 0u { wg_range = tile_ranges[tile]; }
        atomicStore(&wg_n_done, 0u);
        atomicStore(&wg_last, 0u);
    }
    let range = workgroupUniformLoad(&wg_range); // Also orders the zeroing before anyone adds.
    let n_splats = range.y - range.x;
    let pixel = vec2u(tile % view.n_tiles.x, tile / view.n_tiles.x) * TILE_PX + local.xy;
    let on_image = in_grid && pixel.x < view.size_px.x && pixel.y < view.size_px.y;
    let center_px = vec2f(pixel) + 0.5;
    var color = vec3f(0.0);
    var depth_sum = 0.0;
    var transmittance = 1.0;
    var past_last = 0u;
    var done = !on_image;
    if done { atomicAdd(&wg_n_done, 1u); }
    var bucket = 0u;
    if STATES && in_grid { bucket = bucket_starts[tile]; }
    for (var batch = 0u; batch < n_splats; batch += BATCH) {
        workgroupBarrier(); // All have counted themselves done, and read the last batch.
        if lane == 0u { wg_all_done = atomicLoad(&wg_n_done); }
        if workgroupUniformLoad(&wg_all_done) == 256u { break; }
        if batch + lane < n_splats { wg_drawn[lane] = drawn[sorted_splats[range.x + batch + lane]]; }
        workgroupBarrier(); // The batch is there before anyone reads it.
        let n_in_batch = min(BATCH, n_splats - batch);
        for (var i = 0u; i < n_in_batch; i++) {
            if STATES && i % 32u == 0u {
                let state = (bucket + (batch + i) / 32u) * 256u + lane;
                bucket_color[state] = vec4f(color, transmittance);
                bucket_depth[state] = depth_sum;
                if lane == 0u { bucket_tiles[bucket + (batch + i) / 32u] = tile; }
            }
            if done { continue; }
            let splat = wg_drawn[i];
            let offset = splat.place.xy - center_px;
            let power = 0.5 * (splat.conic.x * offset.x * offset.x + splat.conic.z * offset.y * offset.y) + splat.conic.y * offset.x * offset.y;
            let alpha = min(MAX_ALPHA, splat.place.w * exp(-power));
            if power < 0.0 || alpha < MIN_ALPHA { continue; }
            let next = transmittance * (1.0 - alpha);
            if next <= MIN_TRANSMITTANCE {
                done = true;
                atomicAdd(&wg_n_done, 1u);
                continue;
            }
            let weight = alpha * transmittance;
            color += weight * splat.color.rgb;
            depth_sum += weight * splat.place.z;
            transmittance = next;
            past_last = batch + i + 1u;
        }
    }
    if on_image {
        let at = pixel.y * view.size_px.x + pixel.x;
        image[at] = vec4f(color, transmittance);
        depth[at] = depth_sum;
        last[at] = past_last;
    }
    if STATES {
        atomicMax(&wg_last, past_last);
        workgroupBarrier(); // All have told their last.
        if lane == 0u && in_grid { tile_last[tile] = atomicLoad(&wg_last); }
    }
}
