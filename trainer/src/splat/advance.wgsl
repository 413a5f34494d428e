// advance: count the step, unless a buffer was too small.
//
// threads   one
// writes    status

#import status

@group(0) @binding(0) var<storage, read_write> status: array<u32>;

@compute @workgroup_size(1)
fn main() {
    if status[FAILED] == 0u { status[STEP] += 1u; }
}
