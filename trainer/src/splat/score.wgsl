// score: compare a picture with an image, both in 8 bits.
//
// threads   one per pixel, 256 per workgroup
// reads     view, pixels [n_pixels] (rgba8, as written by `finish`), target_image [n_pixels] (rgba8; a = 0: masked out)
// writes    products [n_workgroups, 3 colors]: sums over the unmasked pixels of picture^2, picture x image, image^2, and
//           the number of these pixels
// twin      eval/psnr.rs

#import view

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> pixels: array<u32>;
@group(0) @binding(2) var<storage, read> target_image: array<u32>;
@group(0) @binding(3) var<storage, read_write> products: array<vec4u>;

var<workgroup> wg_sums: array<vec4u, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let group = folded(wg, n_wgs);
    let n_pixels = view.size_px.x * view.size_px.y;
    let at = min(group * 256u + lane, n_pixels - 1u);
    let visible = group * 256u + lane < n_pixels && target_image[at] >= 0x01000000u;
    for (var color = 0u; color < 3u; color++) {
        let picture = (pixels[at] >> (8u * color)) & 255u;
        let image = (target_image[at] >> (8u * color)) & 255u;
        wg_sums[lane] = select(vec4u(0u), vec4u(picture * picture, picture * image, image * image, 1u), visible);
        workgroupBarrier(); // All products are written.
        for (var stride = 128u; stride > 0u; stride /= 2u) {
            if lane < stride { wg_sums[lane] += wg_sums[lane + stride]; }
            workgroupBarrier(); // The lower half of the lanes holds the sums of both halves.
        }
        if lane == 0u && group * 256u < n_pixels { products[group * 3u + color] = wg_sums[0]; }
        workgroupBarrier(); // The sums are read before the next color overwrites them.
    }
}
