// camera_sums: gradients with respect to the camera, summed over the splats of a block in a fixed order.

@group(0) @binding(17) var<storage, read_write> camera_sums: array<vec4f>; // three per block

var<workgroup> wg_camera: array<vec4f, 512>; // [256, 2]
var<workgroup> wg_principal: array<vec2f, 256>;

fn add_up_camera(lane: u32, block: u32, mine: CameraGradient) {
    wg_camera[lane * 2u] = vec4f(mine.rotation, mine.focal.x);
    wg_camera[lane * 2u + 1u] = vec4f(mine.translation, mine.focal.y);
    wg_principal[lane] = mine.principal;
    workgroupBarrier(); // All lanes have written their gradients.
    for (var stride = 128u; stride > 0u; stride /= 2u) {
        if lane < stride {
            for (var part = 0u; part < 2u; part++) { wg_camera[lane * 2u + part] += wg_camera[(lane + stride) * 2u + part]; }
            wg_principal[lane] += wg_principal[lane + stride];
        }
        workgroupBarrier(); // The lower half holds the sums of both halves.
    }
    if lane == 0u {
        camera_sums[block * 3u] = wg_camera[0];
        camera_sums[block * 3u + 1u] = wg_camera[1];
        camera_sums[block * 3u + 2u] = vec4f(wg_principal[0], 0.0, 0.0);
    }
}
