// scan: sums within a workgroup of 256 lanes, in a fixed order.

const SCAN_LANES = 256u;
var<workgroup> wg_scan: array<u32, 256>;

// The sum of the values of the lanes below `lane`; `total` gets the sum of all. Every lane must call it.
fn exclusive_scan(lane: u32, value: u32, total: ptr<function, u32>) -> u32 {
    wg_scan[lane] = value;
    workgroupBarrier(); // The values are there before the first step reads them.
    for (var stride = 1u; stride < SCAN_LANES; stride *= 2u) {
        var below = 0u;
        if lane >= stride { below = wg_scan[lane - stride]; }
        workgroupBarrier(); // All have read before anyone writes.
        wg_scan[lane] += below;
        workgroupBarrier(); // All have written before anyone reads.
    }
    *total = wg_scan[SCAN_LANES - 1u];
    let inclusive = wg_scan[lane];
    workgroupBarrier(); // The array may be used again after this.
    return inclusive - value;
}
