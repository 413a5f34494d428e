//! The depth format `compact_half`. It stores differences of logarithmic counts, compressed to a
//! zlib stream.
//!
//! Logarithmic counts have the same relative error at all distances. Most differences between
//! neighbors are then 0, and zlib finds the patterns that repeat from row to row. Predicting from
//! three neighbors gains nothing on real pictures. `web/src/layers/compact_depth.ts` is the
//! decoder.

use flate2::Compression;
use flate2::write::ZlibEncoder;
use std::io::Write;
use std::sync::LazyLock;
use trainer::PackedDepth;

/// Ratio of two consecutive counts, minus 1. Rounding changes a depth by at most half of this, 0.2
/// %. The errors of the models are larger. Twice the step saves 30 % of the bytes, and half the
/// step costs 30 % (`docs/benchmarks/2026-11-26-viewer-protocol.md`).
const LOG_STEP: f64 = 0.004;
/// Symbol of a pixel whose count follows in the second part.
const ESCAPE: u8 = 255;
/// Largest symbol of a difference between a count and its prediction.
const MAX_SYMBOL: u16 = 254;
/// Deflate level for [`Effort::Small`]. Level 6 would take four times as long and save 7 %.
const DEFLATE_LEVEL: u32 = 3;

/// How much time is spent on compression.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Effort {
    /// Takes about 1 ms per megapixel of the picture. It is for fast connections, on which the
    /// additional bytes take less time than better compression.
    Fast,
    /// Takes about 5 ms per megapixel of the picture.
    Small,
}

/// Natural logarithms of all counts.
static LOGARITHMS: LazyLock<Vec<f32>> =
    LazyLock::new(|| (0..=u16::MAX).map(|count| f32::from(count).ln()).collect());

/// A compressed depth map.
#[derive(Debug)]
pub(crate) struct CompactDepth {
    /// Width and height.
    pub(crate) size_px: [u32; 2],
    /// Depth of count 1, meters.
    pub(crate) min_m: f64,
    /// Natural logarithm of the ratio of two consecutive counts.
    pub(crate) log_step: f64,
    /// A zlib stream of symbols, one byte per pixel, and the counts of escaped pixels, 16 bits
    /// each.
    pub(crate) bytes: Vec<u8>,
}

/// Compresses a depth map.
pub(crate) fn compress(depth: &PackedDepth, effort: Effort) -> std::io::Result<CompactDepth> {
    let counts: Vec<u16> = depth
        .counts
        .chunks_exact(2)
        .map(|count| u16::from_le_bytes([count[0], count[1]]))
        .collect();
    // Logarithmic counts begin at the nearest surface, so that they are small, whatever the scale.
    let nearest = counts
        .iter()
        .copied()
        .filter(|count| *count > 0)
        .min()
        .unwrap_or(1);
    let min_m = f64::from(nearest) * depth.meters_per_count;
    let log_step = LOG_STEP.ln_1p();
    let mut symbols = Vec::with_capacity(counts.len());
    let mut escaped = Vec::new();
    // A count is predicted by the count to its left or, in the first column, by the count above it.
    let mut above = 0;
    // An empty picture must not lead to rows of length 0, which `chunks` does not allow.
    for row in counts.chunks((depth.size_px[0] as usize).max(1)) {
        let mut predicted = above;
        above = log_count(row[0], nearest, log_step);
        for &count in row {
            let code = log_count(count, nearest, log_step);
            match symbol(code, predicted) {
                Some(symbol) => symbols.push(symbol),
                None => {
                    symbols.push(ESCAPE);
                    escaped.extend(code.to_le_bytes());
                }
            }
            predicted = code;
        }
    }
    // Escaped counts come last. Between the symbols, they would break the patterns that zlib finds.
    symbols.append(&mut escaped);
    let bytes = match effort {
        Effort::Fast => fdeflate::compress_to_vec(&symbols),
        Effort::Small => {
            // About the size of the stream for depth of splats, so that the buffer rarely grows.
            let mut encoder = ZlibEncoder::new(
                Vec::with_capacity(symbols.len() / 4),
                Compression::new(DEFLATE_LEVEL),
            );
            encoder.write_all(&symbols)?;
            encoder.finish()?
        }
    };
    Ok(CompactDepth {
        size_px: depth.size_px,
        min_m,
        log_step,
        bytes,
    })
}

/// The logarithmic count, relative to the nearest count; 0 if there is no surface.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "ln(65535) / log_step is below 3000"
)]
fn log_count(count: u16, nearest: u16, log_step: f64) -> u16 {
    if count < nearest {
        return 0;
    }
    // A table, because a picture has hundreds of thousands of pixels, but there are only 65536
    // counts.
    let above = LOGARITHMS[usize::from(count)] - LOGARITHMS[usize::from(nearest)];
    // The count is rounded and increased by 1, because 0 means that there is no surface.
    (above / log_step as f32 + 1.5) as u16
}

/// The symbol of the difference from the prediction; the order of differences is 0, -1, 1, -2, 2,
/// and so on. `None` if the difference is too large, or if only one of the pixel and its prediction
/// has a surface.
fn symbol(code: u16, predicted: u16) -> Option<u8> {
    // The edge of a hole is a large jump that says nothing about the shape of the surface.
    if (code == 0) != (predicted == 0) {
        return None;
    }
    // Small differences of both signs get small symbols, as in the zigzag coding of Protocol
    // Buffers.
    let symbol = if code >= predicted {
        2 * u32::from(code - predicted)
    } else {
        2 * u32::from(predicted - code) - 1
    };
    u8::try_from(symbol)
        .ok()
        .filter(|symbol| u16::from(*symbol) <= MAX_SYMBOL)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::{CompactDepth, ESCAPE, Effort, compress};
    use flate2::read::ZlibDecoder;
    use numbers::random::Random;
    use std::io::Read;
    use trainer::PackedDepth;

    /// Decodes as `docs/reference/protocol.md` describes; depths in meters, 0 without a surface.
    pub(crate) fn decode(compact: &CompactDepth) -> Vec<f64> {
        let n = compact.size_px[0] as usize * compact.size_px[1] as usize;
        let mut bytes = Vec::new();
        ZlibDecoder::new(&*compact.bytes)
            .read_to_end(&mut bytes)
            .expect("a zlib stream");
        let mut escaped = bytes[n..]
            .chunks_exact(2)
            .map(|count| u16::from_le_bytes([count[0], count[1]]));
        let width = compact.size_px[0] as usize;
        let mut codes: Vec<u16> = Vec::new();
        for (ix, &symbol) in bytes[..n].iter().enumerate() {
            let before = if ix.is_multiple_of(width) {
                ix.checked_sub(width)
            } else {
                ix.checked_sub(1)
            };
            let predicted = before.map_or(0, |before| i32::from(codes[before]));
            codes.push(match symbol {
                ESCAPE => escaped.next().expect("a count"),
                symbol => {
                    let half = i32::from(symbol.div_ceil(2));
                    u16::try_from(predicted + if symbol % 2 == 0 { half } else { -half })
                        .expect("a count")
                }
            });
        }
        assert_eq!(escaped.next(), None, "all counts are used");
        let meters = |code: u16| compact.min_m * (compact.log_step * (f64::from(code) - 1.0)).exp();
        codes
            .into_iter()
            .map(|code| if code == 0 { 0.0 } else { meters(code) })
            .collect()
    }

    fn packed(
        size_px: [u32; 2],
        meters_per_count: f64,
        count: impl FnMut(u32) -> u16,
    ) -> PackedDepth {
        let counts = (0..size_px[0] * size_px[1])
            .map(count)
            .flat_map(u16::to_le_bytes)
            .collect();
        PackedDepth {
            size_px,
            meters_per_count,
            counts,
        }
    }

    /// Compresses with both efforts, and returns the numbers of bytes.
    fn check(depth: &PackedDepth) -> [usize; 2] {
        [Effort::Fast, Effort::Small].map(|effort| check_with(depth, effort))
    }

    fn check_with(depth: &PackedDepth, effort: Effort) -> usize {
        let compact = compress(depth, effort).expect("compressed");
        let decoded = decode(&compact);
        for (got, count) in decoded.iter().zip(depth.counts.chunks_exact(2)) {
            let meters =
                f64::from(u16::from_le_bytes([count[0], count[1]])) * depth.meters_per_count;
            assert!(
                (got - meters).abs() <= 0.0021 * meters,
                "{got} instead of {meters}"
            );
        }
        compact.bytes.len()
    }

    #[test]
    fn all_depths_survive_within_the_stated_error() {
        let mut random = Random::new(3);
        for size_px in [[1, 1], [1, 7], [9, 1], [32, 17]] {
            check(&packed(size_px, 1e-4, |_| 0));
            check(&packed(size_px, 1e-4, |_| u16::MAX));
            check(&packed(size_px, 3e-5, |_| {
                u16::try_from(random.below(65_536)).expect("16 bits")
            }));
            check(&packed(size_px, 3e-5, |ix| {
                if ix % 3 == 0 {
                    0
                } else {
                    1 + u16::try_from(ix * 7).expect("small")
                }
            }));
        }
        // Every count once.
        check(&packed([256, 256], 1e-4, |ix| {
            u16::try_from(ix).expect("16 bits")
        }));
    }

    #[test]
    fn smooth_surfaces_need_little_space() {
        // A floor that recedes from 1 m to 6 m, and a ball in front of it.
        let size_px = [640, 360];
        let depth = packed(size_px, 1e-4, |ix| {
            let (x, y) = (f64::from(ix % 640), f64::from(ix / 640));
            let from_center = (x - 300.0).hypot(y - 200.0) / 90.0;
            let meters = if from_center < 1.0 {
                0.9 - 0.1 * (1.0 - from_center * from_center).sqrt()
            } else {
                6.0 - y / 72.0
            };
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "below 6.5 m"
            )]
            let count = (meters / 1e-4).round() as u16;
            count
        });
        let [fast, small] = check(&depth);
        assert!(
            small < 12_000 && fast < 60_000,
            "{small} and {fast} bytes of {}",
            depth.counts.len()
        );
    }
}
