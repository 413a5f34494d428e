// digit: which eight bits of the key a pass looks at. For kernels that bind digit and status.
//
// Keys are cut to 16 bits: their place between the least and the largest, as finely as 16 bits allow.

struct Digit {
    shift: u32,
    counter: u32,       // index into status of the number of keys
    largest: u32,       // of the largest key; behind it the least, inverted
    max_blocks: u32,    // blocks the counts have room for
}

const LAST_KEY = 0xffffffffu; // Comes after all others, and counts in neither.

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
