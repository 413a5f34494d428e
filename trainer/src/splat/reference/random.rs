//! Plain CPU version of shared/random.wgsl: random numbers from a hash of a key.
//!
//! Sources: Jarzynski and Olano 2020 (PCG3D) for the hash, and Box and Muller 1958 for normal
//! numbers.

/// Three hashes of three numbers.
pub(crate) fn hash3(key: [u32; 3]) -> [u32; 3] {
    // The multiplier and increment of a linear congruential generator (Knuth and Lewis), as in
    // the source.
    let mut v = key.map(|part| part.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    mix(&mut v);
    v = v.map(|part| part ^ part >> 16);
    mix(&mut v);
    v
}

/// One round of the permutation. Each part depends on both other parts.
fn mix(v: &mut [u32; 3]) {
    v[0] = v[0].wrapping_add(v[1].wrapping_mul(v[2]));
    v[1] = v[1].wrapping_add(v[2].wrapping_mul(v[0]));
    v[2] = v[2].wrapping_add(v[0].wrapping_mul(v[1]));
}

/// Three uniform numbers in 0 <= x < 1.
pub(crate) fn uniform3(key: [u32; 3]) -> [f64; 3] {
    // The numbers have 24 bits, which f32 holds exactly, so that the kernels compute the same
    // numbers.
    hash3(key).map(|hash| f64::from(hash >> 8) / 16_777_216.0)
}

/// Three normally distributed numbers.
pub(crate) fn normal3(key: [u32; 3]) -> [f64; 3] {
    // The second key differs from the first in many bits, so that both triples are independent.
    let a = uniform3(key);
    let b = uniform3([
        key[0] ^ 0x9e37_79b9,
        key[1] ^ 0x85eb_ca6b,
        key[2] ^ 0xc2b2_ae35,
    ]);
    // `1 - a` is not 0, so the logarithm is finite.
    std::array::from_fn(|ix| {
        (-2.0 * (1.0 - a[ix]).ln()).sqrt() * (std::f64::consts::TAU * b[ix]).cos()
    })
}
