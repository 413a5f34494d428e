// jpeg_code: Huffman codes of each restart interval.
//
// threads   one per interval, 32 per workgroup
// reads     packing, coefficients [n_mcus, 3, 64], non_zero [n_mcus, 3, 2], codes [544] (see tables.rs)
// writes    coded [n_intervals, words_per_interval], n_coded [n_intervals] (words), packed (OVERFLOW)
// source    ITU-T T.81, section F.1.2; restart intervals in parallel as in GPUJPEG (Holub et al. 2013)
//
// An interval ends with its restart marker, or with the end of the image. Fill bytes before the marker (T.81, section
// B.1.1.2) make its length a multiple of four bytes, so that intervals are joined word by word.

#import packing
#import folded

@group(0) @binding(0) var<uniform> packing: Packing;
@group(0) @binding(1) var<storage, read> coefficients: array<i32>;
@group(0) @binding(2) var<storage, read> non_zero: array<u32>;
@group(0) @binding(3) var<storage, read> codes: array<u32>; // length in the high 16 bits; tables for luminance, then for chrominance
@group(0) @binding(4) var<storage, read_write> coded: array<u32>;
@group(0) @binding(5) var<storage, read_write> n_coded: array<u32>;
@group(0) @binding(6) var<storage, read_write> packed: array<atomic<u32>>;

const AC_CODES = 16u;      // offset of the codes of AC coefficients within a table
const TABLE_CODES = 272u;
const ZERO_RUN = 0xf0u;    // 16 zeros

// The bytes of an interval.
struct Writer {
    base: u32,             // of the interval's words
    n_bytes: u32,
    word: u32,             // bytes that do not fill a word yet
    bits: u32,             // bits that do not fill a byte yet
    n_bits: u32,
}

fn put_byte(writer: ptr<function, Writer>, byte: u32) {
    (*writer).word |= byte << (8u * ((*writer).n_bytes % 4u));
    (*writer).n_bytes++;
    if (*writer).n_bytes % 4u == 0u {
        let word = (*writer).n_bytes / 4u - 1u;
        if word < packing.words_per_interval { coded[(*writer).base + word] = (*writer).word; }
        (*writer).word = 0u;
    }
}

// Appends up to 16 bits. A zero byte is stuffed after 0xff, so that it is not read as a marker (T.81, F.1.2.3).
fn put_bits(writer: ptr<function, Writer>, bits: u32, n_bits: u32) {
    (*writer).bits = (*writer).bits << n_bits | bits;
    (*writer).n_bits += n_bits;
    while (*writer).n_bits >= 8u {
        (*writer).n_bits -= 8u;
        let byte = (*writer).bits >> (*writer).n_bits & 255u;
        put_byte(writer, byte);
        if byte == 255u { put_byte(writer, 0u); }
    }
}

// Number of bits of a value's magnitude.
fn category(value: i32) -> u32 {
    return 32u - countLeadingZeros(u32(abs(value)));
}

// Appends a code and the value's low bits. Negative values are decremented first, as F.1.2.1 specifies.
fn put_value(writer: ptr<function, Writer>, code: u32, value: i32) {
    put_bits(writer, code & 0xffffu, code >> 16u);
    let n_bits = category(value);
    put_bits(writer, u32(value - select(0, 1, value < 0)) & ((1u << n_bits) - 1u), n_bits);
}

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let interval = folded(wg, n_wgs) * 32u + lane;
    if interval >= packing.n_intervals { return; } // No barrier follows this return.
    let n_mcus = packing.n_mcus.x * packing.n_mcus.y;
    let begin = interval * packing.mcus_per_interval;
    var writer = Writer(interval * packing.words_per_interval, 0u, 0u, 0u, 0u);
    var previous = vec3i(0);
    for (var mcu = begin; mcu < min(begin + packing.mcus_per_interval, n_mcus); mcu++) {
        for (var color = 0u; color < 3u; color++) {
            let block = 3u * mcu + color;
            let table = select(0u, TABLE_CODES, color > 0u);
            let mean = coefficients[64u * block];
            let difference = mean - previous[color];
            previous[color] = mean;
            put_value(&writer, codes[table + category(difference)], difference);
            var last = 0u;
            for (var half = 0u; half < 2u; half++) {
                var bits = non_zero[2u * block + half] & select(0xffffffffu, 0xfffffffeu, half == 0u);
                while bits != 0u {
                    let order = 32u * half + firstTrailingBit(bits);
                    bits &= bits - 1u;
                    var n_zeros = order - last - 1u;
                    last = order;
                    while n_zeros > 15u {
                        let code = codes[table + AC_CODES + ZERO_RUN];
                        put_bits(&writer, code & 0xffffu, code >> 16u);
                        n_zeros -= 16u;
                    }
                    let value = coefficients[64u * block + order];
                    put_value(&writer, codes[table + AC_CODES + n_zeros * 16u + category(value)], value);
                }
            }
            if last < 63u {
                let end_of_block = codes[table + AC_CODES];
                put_bits(&writer, end_of_block & 0xffffu, end_of_block >> 16u);
            }
        }
    }
    let n_missing = (8u - writer.n_bits) % 8u;
    put_bits(&writer, (1u << n_missing) - 1u, n_missing);
    while writer.n_bytes % 4u != 2u { put_byte(&writer, 255u); }
    put_byte(&writer, 255u);
    put_byte(&writer, select(0xd0u + interval % 8u, 0xd9u, interval + 1u == packing.n_intervals));
    n_coded[interval] = writer.n_bytes / 4u;
    if writer.n_bytes / 4u > packing.words_per_interval { atomicStore(&packed[OVERFLOW], 1u); }
}
