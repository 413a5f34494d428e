// rasterize_strips: what `rasterize` does, on adapters whose lanes read memory one after the other.
//
// threads   a workgroup of 8 per tile, strip after strip (see `strips`)
// reads     view, status, tile_ranges, bucket_starts, sorted_splats, drawn
// writes    as `rasterize`
// twin      splat/reference/rasterize.rs
// source    as `rasterize`

#import view
#import model
#import projection
#import strips
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
const BUCKET = 32u;

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(subgroup_invocation_id) lane: u32) {
    let tile = folded(wg, n_wgs);
    let in_grid = tile < view.n_tiles.x * view.n_tiles.y;
    var range = vec2u(0u);
    if in_grid && status[FAILED] == 0u { range = tile_ranges[tile]; }
    let n_splats = max(range.x, range.y) - range.x;
    var bucket = 0u;
    if STATES && in_grid { bucket = bucket_starts[tile]; }
    let corner = vec2u(tile % view.n_tiles.x, tile / view.n_tiles.x) * TILE_PX;
    var tile_past_last = 0u;
    for (var strip = 0u; strip < N_STRIPS; strip++) {
        let in_tile = strip_px(strip, lane);
        let first = corner + in_tile;
        let center_x = f32(first.x) + 0.5 + RAMP;
        let center_y = f32(first.y) + 0.5;
        let top = f32(corner.y + strip * 2u) + 0.5;
        let on_image = (center_x < Px(f32(view.size_px.x))) & PxB(in_grid && first.y < view.size_px.y);
        var red = Px(0.0);
        var green = Px(0.0);
        var blue = Px(0.0);
        var depth_sum = Px(0.0);
        var transmittance = Px(1.0);
        var past_last = PxU(0u);
        var live = on_image;
        var any_live = n_splats > 0u;
        for (var begin = 0u; begin < n_splats; begin += BUCKET) {
            if STATES {
                let at = (bucket + begin / BUCKET) * 256u + in_tile.y * TILE_PX + in_tile.x;
                for (var k = 0u; k < PX; k++) {
                    bucket_color[at + k] = vec4f(red[k], green[k], blue[k], transmittance[k]);
                    bucket_depth[at + k] = depth_sum[k];
                }
            }
            let end = min(begin + BUCKET, n_splats);
            for (var part = begin; part < end && any_live; part += LANES) {
                let owned = part + lane < n_splats;
                let splat_ix = sorted_splats[range.x + min(part + lane, n_splats - 1u)];
                let place = drawn[splat_ix].place;
                let conic = drawn[splat_ix].conic;
                let color = drawn[splat_ix].color;
                var reaching = or_of_lanes(select(0u, 1u << lane, owned && reaches_strip(place, conic, top)));
                loop {
                    let some = reaching != 0u; // The loop's body runs at least once.
                    let i = firstTrailingBit(reaching) & 7u;
                    reaching &= reaching - 1u;
                    let at = subgroupShuffle(place, i);
                    let shape = subgroupShuffle(conic, i);
                    let dx = at.x - center_x;
                    let dy = at.y - center_y;
                    let power = 0.5 * (shape.x * dx * dx + shape.z * dy * dy) + shape.y * dy * dx;
                    let hit = live & (power >= Px(0.0)) & (power <= Px(0.5 * shape.w)) & PxB(some);
                    let alpha = min(Px(MAX_ALPHA), at.w * exp(-power));
                    let next = transmittance * (1.0 - alpha);
                    let goes_on = next > Px(MIN_TRANSMITTANCE);
                    let adds = hit & goes_on;
                    let weight = select(Px(0.0), alpha * transmittance, adds);
                    red += weight * subgroupShuffle(color.x, i);
                    green += weight * subgroupShuffle(color.y, i);
                    blue += weight * subgroupShuffle(color.z, i);
                    depth_sum += weight * at.z;
                    transmittance = select(transmittance, next, adds);
                    past_last = select(past_last, PxU(part + i + 1u), adds);
                    live = live & (goes_on | !hit);
                    continuing {
                        break if reaching == 0u;
                    }
                }
                any_live = or_of_lanes(select(0u, 1u, any(live))) != 0u;
            }
        }
        for (var k = 0u; k < PX; k++) {
            if !on_image[k] { continue; }
            let at = first.y * view.size_px.x + first.x + k;
            image[at] = vec4f(red[k], green[k], blue[k], transmittance[k]);
            depth[at] = depth_sum[k];
            last[at] = past_last[k];
        }
        let most = max(max(past_last.x, past_last.y), max(past_last.z, past_last.w));
        tile_past_last = max(tile_past_last, most);
    }
    if STATES {
        let n_buckets = (n_splats + BUCKET - 1u) / BUCKET;
        for (var i = lane; i < n_buckets; i += LANES) { bucket_tiles[bucket + i] = tile; }
        let past_last = max_of_lanes(tile_past_last);
        if lane == 0u && in_grid { tile_last[tile] = past_last; }
    }
}
