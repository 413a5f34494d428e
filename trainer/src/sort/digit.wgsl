// digit: which eight bits of the key a pass looks at.

struct Digit {
    shift: u32,
    counter: u32,       // index into status of the number of keys
    max_blocks: u32,    // blocks the counts have room for
    unused: u32,
}

fn digit_of(key: u32) -> u32 {
    return (key >> digit.shift) & 255u;
}
