// scan_f32: sums of f32 within a workgroup of 256 lanes, in a fixed order.

var<workgroup> wg_scan_f32: array<f32, 256>;

// Returns the sum of the values of the lanes up to and including `lane`. Every lane must call it.
fn inclusive_scan_f32(lane: u32, value: f32) -> f32 {
    wg_scan_f32[lane] = value;
    workgroupBarrier(); // The values are written before the first step reads them.
    for (var stride = 1u; stride < 256u; stride *= 2u) {
        var below = 0.0;
        if lane >= stride { below = wg_scan_f32[lane - stride]; }
        workgroupBarrier(); // All lanes have read before any lane writes.
        wg_scan_f32[lane] += below;
        workgroupBarrier(); // All lanes have written before any lane reads.
    }
    let inclusive = wg_scan_f32[lane];
    workgroupBarrier(); // The array may be reused after this.
    return inclusive;
}
