//! Reads fixed-size values from the input of a fuzz target.

/// Removes the first bytes and returns them, padded with zeros if there are fewer.
pub(crate) fn take<const N: usize>(bytes: &mut &[u8]) -> [u8; N] {
    let (first, rest) = bytes.split_at(bytes.len().min(N));
    *bytes = rest;
    std::array::from_fn(|ix| first.get(ix).copied().unwrap_or(0))
}
