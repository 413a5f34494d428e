// scan_f32: sums of f32 within a workgroup of 256 lanes, in a fixed order.

var<workgroup> wg_scan_f32: array<f32, 256>;

// The sum of the values of the lanes up to and including `lane`. Every lane must call it.
fn inclusive_scan_f32(lane: u32, value: f32) -> f32 {
    wg_scan_f32[lane] = value;
    workgroupBarrier(); // The values are there before the first step reads them.
    for (var stride = 1u; stride < 256u; stride *= 2u) {
        var below = 0.0;
        if lane >= stride { below = wg_scan_f32[lane - stride]; }
        workgroupBarrier(); // All have read before anyone writes.
        wg_scan_f32[lane] += below;
        workgroupBarrier(); // All have written before anyone reads.
    }
    let inclusive = wg_scan_f32[lane];
    workgroupBarrier(); // The array may be used again after this.
    return inclusive;
}
