// field_insert: finds or inserts the row of a chunk. The row depends on thread timing, but no result depends on the
// row.
//
// needs     field, status and keys as arrays of atomics

// Returns the row plus one, or 0 if the table is too full.
fn insert_chunk(chunk: vec3i) -> u32 {
    let key = key_of(chunk);
    var at = hash_of(key) & (field.n_chunk_slots - 1u);
    for (var probe = 0u; probe < MAX_PROBES; probe++) {
        var there = atomicLoad(&keys[at]);
        if there == 0u {
            let exchange = atomicCompareExchangeWeak(&keys[at], 0u, key);
            if exchange.exchanged {
                widen_bounds(chunk);
                return at + 1u;
            }
            there = exchange.old_value;
        }
        if there == key { return at + 1u; }
        // If the key is still 0, the weak exchange failed spuriously and is repeated.
        if there != 0u { at = (at + 1u) & (field.n_chunk_slots - 1u); }
    }
    return 0u;
}

fn widen_bounds(chunk: vec3i) {
    atomicAdd(&status[N_CHUNKS], 1u);
    for (var axis = 0u; axis < 3u; axis++) {
        atomicMax(&status[BOUNDS_HIGH + axis], u32(BOUNDS_BIAS + chunk[axis]));
        atomicMax(&status[BOUNDS_LOW + axis], u32(BOUNDS_BIAS - chunk[axis]));
    }
}
