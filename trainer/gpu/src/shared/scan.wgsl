// scan: sums within a workgroup of 256 lanes, in a fixed order.

const SCAN_LANES = 256u;
var<workgroup> wg_scan: array<u32, 256>;

// Returns the sum of the values of the lanes below `lane`; `total` receives the sum over all lanes. Every lane must
// call this function.
fn exclusive_scan(lane: u32, value: u32, total: ptr<function, u32>) -> u32 {
    wg_scan[lane] = value;
    workgroupBarrier(); // The values are written before the first step reads them.
    for (var stride = 1u; stride < SCAN_LANES; stride *= 2u) {
        var below = 0u;
        if lane >= stride { below = wg_scan[lane - stride]; }
        workgroupBarrier(); // All lanes have read before any lane writes.
        wg_scan[lane] += below;
        workgroupBarrier(); // All lanes have written before any lane reads.
    }
    *total = wg_scan[SCAN_LANES - 1u];
    let inclusive = wg_scan[lane];
    workgroupBarrier(); // The array may be reused after this.
    return inclusive - value;
}
