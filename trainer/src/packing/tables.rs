//! Tables of JPEG for the transform, the quantization and the Huffman codes (ITU-T T.81, annexes A
//! and K).

use std::f64::consts::PI;

/// Quantization of luminance at quality 50, row by row (table K.1).
const LUMINANCE: [u8; 64] = [
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56,
    14, 17, 22, 29, 51, 87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113,
    92, 49, 64, 78, 87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99,
];

/// Quantization of chrominance at quality 50 in the first four rows and columns (table K.2). It is
/// 99 elsewhere.
const CHROMINANCE: [[u8; 4]; 4] = [
    [17, 18, 24, 47],
    [18, 21, 26, 66],
    [24, 26, 56, 99],
    [47, 66, 99, 99],
];

/// Numbers of codes with 1 to 16 bits, and the symbols in order of their codes (tables K.3 to K.6).
struct Huffman {
    n_codes: [u8; 16],
    symbols: &'static [u8],
}

const DC_SYMBOLS: &[u8] = &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11];

/// DC and AC codes of luminance, then of chrominance.
const HUFFMAN: [Huffman; 4] = [
    Huffman {
        n_codes: [0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0],
        symbols: DC_SYMBOLS,
    },
    Huffman {
        n_codes: [0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 125],
        symbols: &[
            0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51,
            0x61, 0x07, 0x22, 0x71, 0x14, 0x32, 0x81, 0x91, 0xa1, 0x08, 0x23, 0x42, 0xb1, 0xc1,
            0x15, 0x52, 0xd1, 0xf0, 0x24, 0x33, 0x62, 0x72, 0x82, 0x09, 0x0a, 0x16, 0x17, 0x18,
            0x19, 0x1a, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x34, 0x35, 0x36, 0x37, 0x38, 0x39,
            0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57,
            0x58, 0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75,
            0x76, 0x77, 0x78, 0x79, 0x7a, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92,
            0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a, 0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7,
            0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba, 0xc2, 0xc3,
            0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8,
            0xd9, 0xda, 0xe1, 0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf1, 0xf2,
            0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
        ],
    },
    Huffman {
        n_codes: [0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0],
        symbols: DC_SYMBOLS,
    },
    Huffman {
        n_codes: [0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 119],
        symbols: &[
            0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07,
            0x61, 0x71, 0x13, 0x22, 0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xa1, 0xb1, 0xc1, 0x09,
            0x23, 0x33, 0x52, 0xf0, 0x15, 0x62, 0x72, 0xd1, 0x0a, 0x16, 0x24, 0x34, 0xe1, 0x25,
            0xf1, 0x17, 0x18, 0x19, 0x1a, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x35, 0x36, 0x37, 0x38,
            0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56,
            0x57, 0x58, 0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74,
            0x75, 0x76, 0x77, 0x78, 0x79, 0x7a, 0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89,
            0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a, 0xa2, 0xa3, 0xa4, 0xa5,
            0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba,
            0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6,
            0xd7, 0xd8, 0xd9, 0xda, 0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf2,
            0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
        ],
    },
];

/// Position of each coefficient in zigzag order, row by row.
fn zigzag() -> [usize; 64] {
    let mut order: Vec<usize> = (0..64).collect();
    // Odd diagonals go down, and even diagonals go up.
    order.sort_by_key(|at| {
        let row = at / 8;
        let column = at % 8;
        (
            row + column,
            if (row + column) % 2 == 1 { row } else { column },
        )
    });
    let mut positions = [0; 64];
    for (position, at) in order.into_iter().enumerate() {
        positions[at] = position;
    }
    positions
}

/// Quantization of luminance and chrominance, row by row, scaled as in the software of the
/// Independent JPEG Group.
fn quantizers(quality: u8) -> [[u8; 64]; 2] {
    // Quality 50 is the table itself. Below it, percentages grow hyperbolically. Above it, they
    // fall linearly to 0, where every quantizer is 1.
    let quality = u32::from(quality.clamp(1, 100));
    let percent = if quality < 50 {
        5000 / quality
    } else {
        200 - 2 * quality
    };
    let scaled = |base: u8| {
        u8::try_from(((u32::from(base) * percent + 50) / 100).clamp(1, 255)).unwrap_or(u8::MAX)
    };
    [
        LUMINANCE.map(scaled),
        std::array::from_fn(|at| scaled(chrominance(at))),
    ]
}

/// Quantization of chrominance at quality 50, at an index row by row (table K.2).
fn chrominance(at: usize) -> u8 {
    CHROMINANCE
        .get(at / 8)
        .and_then(|row| row.get(at % 8))
        .copied()
        .unwrap_or(99)
}

/// The table of `jpeg_transform`. It contains cosines `[frequency, position]`, then reciprocal
/// quantizers of luminance and chrominance row by row, then zigzag positions row by row.
pub(super) fn transform_tables(quality: u8) -> Vec<f32> {
    let basis = (0..64).map(|at| {
        let frequency = f64::from(at / 8);
        let position = f64::from(at % 8);
        // This makes the transform orthonormal. The factor 1/4 of T.81, A.3.3 is divided between
        // the two axes.
        let norm = if at < 8 { 0.125f64.sqrt() } else { 0.5 };
        norm * ((2.0 * position + 1.0) * frequency * PI / 16.0).cos()
    });
    // The kernel multiplies, because divisions are slower.
    let reciprocals = quantizers(quality)
        .into_iter()
        .flatten()
        .map(|quantizer| 1.0 / f64::from(quantizer));
    let positions = zigzag().into_iter().map(|position| position as f64);
    basis
        .chain(reciprocals)
        .chain(positions)
        .map(numbers::f32_of)
        .collect()
}

/// The table of `jpeg_code`, for luminance, then for chrominance. It contains the codes of 16 DC
/// categories and of 256 AC symbols, with their lengths in the high 16 bits.
pub(super) fn codes() -> Vec<u32> {
    HUFFMAN
        .chunks_exact(2)
        .flat_map(|pair| [codes_of(&pair[0], 16), codes_of(&pair[1], 256)].concat())
        .collect()
}

/// Codes by symbol (T.81, annex C).
fn codes_of(huffman: &Huffman, n_symbols: usize) -> Vec<u32> {
    let mut codes = vec![0; n_symbols];
    let mut code = 0;
    let mut symbols = huffman.symbols.iter();
    // Codes of one length are successive numbers. The first code of the next length is the number
    // after the last code, with a zero appended. No code is therefore the beginning of another
    // code.
    for (n_bits, n_codes) in (1..).zip(huffman.n_codes) {
        for symbol in symbols.by_ref().take(n_codes.into()) {
            codes[usize::from(*symbol)] = n_bits << 16 | code;
            code += 1;
        }
        code <<= 1;
    }
    codes
}

/// Everything before the coded data of a file with three colors at full resolution.
pub(super) fn file_header(size_px: [u16; 2], quality: u8, mcus_per_interval: u16) -> Vec<u8> {
    let mut file = vec![0xff, 0xd8];
    // Version 1.1, an aspect ratio of 1, and no thumbnail.
    push_segment(&mut file, 0xe0, b"JFIF\0\x01\x01\0\0\x01\0\x01\0\0");
    // Quantization tables, 8 bits per entry, in zigzag order.
    let positions = zigzag();
    for (number, quantizers) in (0..).zip(quantizers(quality)) {
        let mut contents = [number; 65];
        for (position, quantizer) in positions.into_iter().zip(quantizers) {
            contents[1 + position] = quantizer;
        }
        push_segment(&mut file, 0xdb, &contents);
    }
    // Baseline frame with 8 bits per sample and three components. Each component has its number,
    // sampling factors of 1 by 1, and the number of its quantization table.
    let [width, height] = size_px.map(u16::to_be_bytes);
    let frame = [
        &[8],
        &height[..],
        &width[..],
        &[3, 1, 0x11, 0, 2, 0x11, 1, 3, 0x11, 1],
    ]
    .concat();
    push_segment(&mut file, 0xc0, &frame);
    // Huffman tables. The high half of the number is the class, DC or AC.
    for (number, huffman) in [0x00, 0x10, 0x01, 0x11].into_iter().zip(HUFFMAN) {
        push_segment(
            &mut file,
            0xc4,
            &[&[number], &huffman.n_codes[..], huffman.symbols].concat(),
        );
    }
    push_segment(&mut file, 0xdd, &mcus_per_interval.to_be_bytes());
    // One scan with all components and all 64 coefficients.
    push_segment(&mut file, 0xda, &[3, 1, 0x00, 2, 0x11, 3, 0x11, 0, 63, 0]);
    file
}

/// Appends a marker segment (T.81, B.1.1.4).
fn push_segment(file: &mut Vec<u8>, marker: u8, contents: &[u8]) {
    // The length includes its own bytes, but not the marker.
    let length = u16::try_from(contents.len() + 2).expect("segments are short");
    file.extend_from_slice(&[0xff, marker]);
    file.extend_from_slice(&length.to_be_bytes());
    file.extend_from_slice(contents);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zigzag_starts_and_ends_as_in_figure_5_of_the_standard() {
        let positions = zigzag();
        assert_eq!(positions[..8], [0, 1, 5, 6, 14, 15, 27, 28]);
        assert_eq!(positions[56..], [35, 36, 48, 49, 57, 58, 62, 63]);
    }

    #[test]
    fn huffman_tables_have_one_code_per_symbol() {
        for huffman in HUFFMAN {
            let n_codes: usize = huffman.n_codes.iter().map(|n| usize::from(*n)).sum();
            let symbols: std::collections::HashSet<_> = huffman.symbols.iter().collect();
            assert!(n_codes == huffman.symbols.len() && symbols.len() == n_codes);
            assert!(n_codes == 12 || n_codes == 162);
        }
    }
}
