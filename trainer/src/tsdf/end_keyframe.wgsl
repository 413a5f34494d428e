// end_keyframe: counts the depth image if it was fused, otherwise stops later depth images. Then it empties the list of
// visible blocks.
//
// threads   one
// writes    status

#import field_status

@group(0) @binding(0) var<storage, read_write> status: array<u32>;

@compute @workgroup_size(1)
fn main() {
    if status[FAILED] == 0u { status[N_FUSED] += 1u; } else { status[STOPPED] = 1u; }
    status[N_VISIBLE] = 0u;
}
