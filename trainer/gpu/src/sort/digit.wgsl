// digit: the eight bits of the key that a pass sorts by. For kernels that bind digit and status.
//
// Keys are reduced to 16 bits. For this, the offset from the smallest key is shifted right until the range of keys
// fits.

struct Digit {
    shift: u32,
    counter: u32,       // index into status of the number of keys
    largest: u32,       // index of the largest key; the smallest key, inverted, follows it
    max_blocks: u32,    // capacity of the counts, in blocks
}

const LAST_KEY = 0xffffffffu; // Sorted after all other keys, and excluded from the range.

struct KeyRange {
    min_key: u32,
    shift: u32,
}

fn key_range() -> KeyRange {
    let min_key = ~status[digit.largest + 1u];
    let span = max(status[digit.largest], min_key) - min_key;
    return KeyRange(min_key, max(32u - countLeadingZeros(span), 16u) - 16u);
}

fn digit_of(key: u32, key_range: KeyRange) -> u32 {
    let short = select(min((key - key_range.min_key) >> key_range.shift, 0xfffeu), 0xffffu, key == LAST_KEY);
    return (short >> digit.shift) & 255u;
}
