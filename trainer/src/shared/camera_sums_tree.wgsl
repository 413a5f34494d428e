// camera_sums: the slopes towards the camera, summed over the splats of a block in a fixed order.

@group(0) @binding(17) var<storage, read_write> camera_sums: array<vec4f>; // three a block

var<workgroup> wg_camera: array<vec4f, 768>; // [256, 3]

fn add_up_camera(lane: u32, block: u32, mine: CameraGradient) {
    wg_camera[lane * 3u] = vec4f(mine.rotation, mine.focal.x);
    wg_camera[lane * 3u + 1u] = vec4f(mine.translation, mine.focal.y);
    wg_camera[lane * 3u + 2u] = vec4f(mine.principal, 0.0, 0.0);
    workgroupBarrier(); // All have told.
    for (var stride = 128u; stride > 0u; stride /= 2u) {
        if lane < stride {
            for (var part = 0u; part < 3u; part++) { wg_camera[lane * 3u + part] += wg_camera[(lane + stride) * 3u + part]; }
        }
        workgroupBarrier(); // This half holds what the other knew.
    }
    if lane < 3u { camera_sums[block * 3u + lane] = wg_camera[lane]; }
}
