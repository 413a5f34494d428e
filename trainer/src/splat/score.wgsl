// score: how far a picture is from an image, in 8 bits.
//
// threads   one per pixel, 256 a workgroup
// reads     view, pixels [n_pixels] (rgba8, as `finish` writes them), target_image [n_pixels] (rgba8; a = 0: not seen)
// writes    squares [n_workgroups]: sum of the squared differences of red, green and blue; pixels seen
// twin      eval/psnr.rs

#import view

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> pixels: array<u32>;
@group(0) @binding(2) var<storage, read> target_image: array<u32>;
@group(0) @binding(3) var<storage, read_write> squares: array<vec2u>;

var<workgroup> wg_sums: array<vec2u, 256>;

fn bytes_of(packed: u32) -> vec3i {
    return vec3i(vec3u(packed, packed >> 8u, packed >> 16u) & vec3u(255u));
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let group = folded(wg, n_wgs);
    let n_pixels = view.size_px.x * view.size_px.y;
    let at = group * 256u + lane;
    var own = vec2u(0u);
    if at < n_pixels && target_image[at] >= 0x01000000u {
        let difference = bytes_of(pixels[at]) - bytes_of(target_image[at]);
        own = vec2u(u32(dot(difference, difference)), 1u);
    }
    wg_sums[lane] = own;
    workgroupBarrier(); // All have told.
    for (var stride = 128u; stride > 0u; stride /= 2u) {
        if lane < stride { wg_sums[lane] += wg_sums[lane + stride]; }
        workgroupBarrier(); // This half holds what the other knew.
    }
    if lane == 0u && group * 256u < n_pixels { squares[group] = wg_sums[0]; }
}
