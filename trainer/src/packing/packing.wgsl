// packing: sizes and tables of the kernels that pack a picture.

struct Packing {
    size_px: vec2u,
    n_mcus: vec2u,         // MCUs of 8 x 8 pixels along x and y
    n_intervals: u32,      // restart intervals
    mcus_per_interval: u32,
    words_per_interval: u32, // capacity of the coded words of an interval
    n_words: u32,          // capacity of the file's coded words
}

// Words before the coded words in `packed`.
const TOTAL_WORDS = 0u;    // coded words
const OVERFLOW = 1u;       // 1: an interval or the file was too long
const FURTHEST = 2u;       // bits of the largest depth
const HEADER_WORDS = 4u;
