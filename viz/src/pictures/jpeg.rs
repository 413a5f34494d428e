//! JPEG encoding; large images are encoded in strips on several threads.

use jpeg_encoder::{ChromaSubsamplingMethod, ColorType, Encoder, SamplingFactor};
use std::num::NonZero;

/// Minimum number of pixels per thread. For smaller images, another thread does not help.
const MIN_STRIP_PX: usize = 96 * 1024;
/// Maximum number of threads. More threads gain little for screen-sized images.
const MAX_THREADS: usize = 8;

/// Resolution of color relative to brightness.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Chroma {
    /// 4:4:4.
    Full,
    /// 4:2:0, about twice as fast and half as large, but colored edges lose sharpness.
    Halved,
}

/// Order of the channels, 8 bits each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Layout {
    /// `[height, width, 3]`.
    Rgb,
    /// `[height, width, 4]`; alpha is ignored.
    Rgba,
}

/// An image in memory.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pixels<'a> {
    /// Width and height.
    pub(crate) size_px: [u32; 2],
    /// Order of the channels.
    pub(crate) layout: Layout,
    /// The channels, row by row.
    pub(crate) bytes: &'a [u8],
}

/// Reason why an image cannot be encoded.
#[derive(Debug, thiserror::Error)]
pub(crate) enum JpegError {
    #[error("a {width} x {height} image needs {needed} values but has {got}")]
    Length {
        width: u32,
        height: u32,
        needed: usize,
        got: usize,
    },
    #[error(
        "a {width} x {height} image cannot be encoded as JPEG, which allows 1 to 65535 pixels each way"
    )]
    Size { width: u32, height: u32 },
    #[error("the image cannot be encoded: {0}")]
    Encode(#[from] jpeg_encoder::EncodingError),
}

impl Layout {
    /// Bytes per pixel.
    pub(crate) fn n_channels(self) -> usize {
        match self {
            Self::Rgb => 3,
            Self::Rgba => 4,
        }
    }
}

impl Pixels<'_> {
    /// Checks that the number of bytes matches the size.
    pub(crate) fn check(&self) -> Result<(), JpegError> {
        let [width, height] = self.size_px;
        let needed = width as usize * height as usize * self.layout.n_channels();
        let got = self.bytes.len();
        if got == needed {
            Ok(())
        } else {
            Err(JpegError::Length {
                width,
                height,
                needed,
                got,
            })
        }
    }
}

/// Number of threads for encoding a picture.
pub(crate) fn n_threads() -> usize {
    std::thread::available_parallelism()
        .map_or(1, NonZero::get)
        .min(MAX_THREADS)
}

/// Encodes a baseline JPEG file.
pub(crate) fn encode(
    pixels: &Pixels<'_>,
    quality: u8,
    chroma: Chroma,
) -> Result<Vec<u8>, JpegError> {
    let n_px = pixels.size_px[0] as usize * pixels.size_px[1] as usize;
    encode_in_strips(
        pixels,
        quality,
        chroma,
        n_threads().min(n_px / MIN_STRIP_PX),
    )
}

/// Encodes about `n_strips` strips in parallel.
///
/// A strip is a separate image with complete rows of blocks. Its scan starts and ends at a byte
/// boundary and does not depend on the previous strip, exactly as at a restart marker. Joined with
/// restart markers, the scans therefore form the scan of the whole image with a restart interval of
/// one strip (ITU-T T.81, sections B.2.4.4 and F.1.1.5).
fn encode_in_strips(
    pixels: &Pixels<'_>,
    quality: u8,
    chroma: Chroma,
    n_strips: usize,
) -> Result<Vec<u8>, JpegError> {
    pixels.check()?;
    let [width, height] = pixels.size_px;
    let (Ok(width_px), Ok(height_px)) = (u16::try_from(width), u16::try_from(height)) else {
        return Err(JpegError::Size { width, height });
    };
    if width_px == 0 || height_px == 0 {
        return Err(JpegError::Size { width, height });
    }
    // With halved chroma, a block of 8 x 8 chroma values covers 16 x 16 pixels. A strip ends with a
    // complete block, because the encoder would repeat its last row otherwise.
    let block_px: u16 = if chroma == Chroma::Full { 8 } else { 16 };
    let blocks_per_row = width_px.div_ceil(block_px);
    let n_block_rows = usize::from(height_px.div_ceil(block_px));
    // The restart interval is a 16-bit number of blocks.
    let max_rows = usize::from(u16::MAX / blocks_per_row);
    let rows_per_strip = n_block_rows.div_ceil(n_strips.max(1));
    if rows_per_strip >= n_block_rows {
        return encode_strip(
            pixels.bytes,
            pixels.layout,
            [width_px, height_px],
            quality,
            chroma,
        );
    }
    let rows_per_strip = rows_per_strip.min(max_rows);
    let row_bytes = width as usize * pixels.layout.n_channels();
    let strip_bytes = rows_per_strip * usize::from(block_px) * row_bytes;
    let strips = std::thread::scope(|scope| {
        // All threads are started before the first one is waited for.
        let tasks: Vec<_> = pixels
            .bytes
            .chunks(strip_bytes)
            .map(|bytes| {
                let rows = u16::try_from(bytes.len() / row_bytes)
                    .expect("a strip is not higher than its image");
                scope.spawn(move || {
                    encode_strip(bytes, pixels.layout, [width_px, rows], quality, chroma)
                })
            })
            .collect();
        let results = tasks
            .into_iter()
            .map(|task| task.join().expect("encoding a strip does not panic"));
        results.collect::<Result<Vec<_>, _>>()
    })?;
    let interval = u16::try_from(rows_per_strip).expect("bounded by max_rows") * blocks_per_row;
    Ok(join(&strips, height_px, interval))
}

fn encode_strip(
    bytes: &[u8],
    layout: Layout,
    [width, height]: [u16; 2],
    quality: u8,
    chroma: Chroma,
) -> Result<Vec<u8>, JpegError> {
    // Space for the headers, and for about one bit per channel value, so that the buffer rarely
    // grows.
    let mut file = Vec::with_capacity(1024 + bytes.len() / 12);
    let mut encoder = Encoder::new(&mut file, quality);
    encoder.set_sampling_factor(match chroma {
        Chroma::Full => SamplingFactor::F_1_1,
        Chroma::Halved => SamplingFactor::F_2_2,
    });
    encoder.set_chroma_subsampling_method(ChromaSubsamplingMethod::Average);
    let color = match layout {
        Layout::Rgb => ColorType::Rgb,
        Layout::Rgba => ColorType::Rgba,
    };
    encoder.encode(bytes, width, height, color)?;
    Ok(file)
}

const START_OF_FRAME: u8 = 0xC0;
const RESTART: u8 = 0xD0;
const END_OF_IMAGE: [u8; 2] = [0xFF, 0xD9];
const START_OF_SCAN: u8 = 0xDA;
const DEFINE_RESTART_INTERVAL: u8 = 0xDD;

/// Offsets of the parts of a strip's file.
struct Parts {
    /// The height in the frame header.
    height: usize,
    /// The marker of the scan header.
    scan_header: usize,
    /// The coded blocks.
    scan: usize,
}

/// Joins the files of the strips into the file of the whole image.
fn join(strips: &[Vec<u8>], height_px: u16, interval: u16) -> Vec<u8> {
    // The tables of all strips are the same, so the headers of the first one apply to the whole
    // image.
    let first = &strips[0];
    let parts = parts_of(first);
    let mut file =
        Vec::with_capacity(strips.iter().map(|strip| strip.len() + 2).sum::<usize>() + 6);
    file.extend_from_slice(&first[..parts.scan_header]);
    // The first strip has its own height.
    file[parts.height..parts.height + 2].copy_from_slice(&height_px.to_be_bytes());
    // The restart interval must come before the scan header (ITU-T T.81, section B.2.4.4).
    file.extend_from_slice(&[0xFF, DEFINE_RESTART_INTERVAL, 0, 4]);
    file.extend_from_slice(&interval.to_be_bytes());
    file.extend_from_slice(&first[parts.scan_header..parts.scan]);
    // Markers count from 0 to 7 and start again, so that decoders notice a lost one.
    for (strip, number) in strips.iter().zip((0..8).cycle()) {
        let scan = parts_of(strip).scan;
        file.extend_from_slice(&strip[scan..strip.len() - END_OF_IMAGE.len()]);
        file.extend_from_slice(&[0xFF, RESTART + number]);
    }
    // No restart follows the last strip.
    file.truncate(file.len() - 2);
    file.extend_from_slice(&END_OF_IMAGE);
    file
}

/// Iterates over the segments of a file that the encoder wrote.
fn parts_of(file: &[u8]) -> Parts {
    let mut height = 0;
    // The first segment begins after the marker for the start of the image, which has no length.
    let mut at = 2;
    // The loop ends, because the encoder always writes a scan. Files from other programs are never
    // passed to this function.
    loop {
        let length = usize::from(u16::from_be_bytes([file[at + 2], file[at + 3]]));
        match file[at + 1] {
            // Marker, length of the segment and precision come before the height.
            START_OF_FRAME => height = at + 5,
            START_OF_SCAN => {
                return Parts {
                    height,
                    scan_header: at,
                    scan: at + 2 + length,
                };
            }
            _ => {}
        }
        // The length counts itself, but not the marker.
        at += 2 + length;
    }
}

/// Downscales an image to RGB: each new pixel is the average of the area that it covers.
pub(crate) fn downscale(pixels: &Pixels<'_>, size_px: [u32; 2]) -> Result<Vec<u8>, JpegError> {
    pixels.check()?;
    let n_channels = pixels.layout.n_channels();
    let row_bytes = (pixels.size_px[0] as usize * n_channels).max(1);
    let columns = Spans::new(pixels.size_px[0], size_px[0]);
    let rows = Spans::new(pixels.size_px[1], size_px[1]);
    let mut rgb = Vec::with_capacity(3 * size_px[0] as usize * size_px[1] as usize);
    let mut row_sums = vec![0.0_f32; row_bytes];
    // The image is scaled first along columns, then along rows, so that each source value is read
    // only once for each target row.
    for row in 0..size_px[1] {
        row_sums.fill(0.0);
        for (y, weight) in rows.of(row) {
            for (sum, &value) in row_sums
                .iter_mut()
                .zip(&pixels.bytes[y * row_bytes..][..row_bytes])
            {
                *sum += weight * f32::from(value);
            }
        }
        for column in 0..size_px[0] {
            let mut color = [0.0; 3];
            for (x, weight) in columns.of(column) {
                for (sum, value) in color.iter_mut().zip(&row_sums[x * n_channels..]) {
                    *sum += weight * value;
                }
            }
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "averages of bytes"
            )]
            rgb.extend(color.map(|value| (value + 0.5) as u8));
        }
    }
    Ok(rgb)
}

/// The source pixels that each target pixel covers along one axis.
struct Spans {
    n_source: u32,
    /// Source pixels per target pixel.
    scale: f64,
}

impl Spans {
    fn new(n_source: u32, n_target: u32) -> Self {
        Self {
            n_source,
            scale: f64::from(n_source) / f64::from(n_target.max(1)),
        }
    }

    /// Index and weight of the source pixels of a target pixel. The weights add up to 1.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "positions in the source image"
    )]
    fn of(&self, target: u32) -> impl Iterator<Item = (usize, f32)> + use<> {
        let scale = self.scale;
        let begin = f64::from(target) * scale;
        // Rounding could reach beyond the last source pixel.
        let end = (begin + scale).min(f64::from(self.n_source));
        let last = (end.ceil() as u32).min(self.n_source);
        ((begin.floor() as u32)..last).map(move |at| {
            let covered = end.min(f64::from(at) + 1.0) - begin.max(f64::from(at));
            (at as usize, (covered / scale) as f32)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::{Chroma, Layout, Pixels, downscale, encode_in_strips};

    /// Smooth colors with a few sharp edges, different in every corner.
    fn scene(width: u32, height: u32, layout: Layout) -> Vec<u8> {
        let channel = |value: u32| u8::try_from(value % 256).expect("below 256");
        (0..height)
            .flat_map(|y| (0..width).map(move |x| (x, y)))
            .flat_map(|(x, y)| {
                let stripe = if (x / 13 + y / 7) % 5 == 0 { 90 } else { 0 };
                let pixel = [
                    channel(x * 160 / width + stripe),
                    channel(y * 160 / height + stripe),
                    channel(40 + x / 3),
                    9,
                ];
                pixel.into_iter().take(layout.n_channels())
            })
            .collect()
    }

    fn decode(jpeg: &[u8]) -> image::RgbImage {
        image::load_from_memory_with_format(jpeg, image::ImageFormat::Jpeg)
            .expect("a JPEG file")
            .to_rgb8()
    }

    #[test]
    fn strips_decode_like_one_image() {
        for (width, height) in [
            (160, 128),
            (161, 129),
            (1, 1),
            (7, 50),
            (16, 17),
            (333, 255),
            (15, 1000),
            (64, 8),
        ] {
            for layout in [Layout::Rgb, Layout::Rgba] {
                let bytes = scene(width, height, layout);
                let pixels = Pixels {
                    size_px: [width, height],
                    layout,
                    bytes: &bytes,
                };
                for chroma in [Chroma::Full, Chroma::Halved] {
                    let whole = decode(&encode_in_strips(&pixels, 92, chroma, 1).expect("encoded"));
                    assert_eq!((whole.width(), whole.height()), (width, height));
                    for n_strips in [2, 3, 7, 64] {
                        let joined = decode(
                            &encode_in_strips(&pixels, 92, chroma, n_strips).expect("encoded"),
                        );
                        assert!(
                            joined == whole,
                            "{width} x {height}, {layout:?}, {chroma:?}, {n_strips} strips"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn decoded_colors_are_close_to_the_source() {
        // Misalignment, a swapped channel or a shifted row would give errors in the tens.
        const MEAN_ABS: f64 = 4.0;
        for (layout, chroma) in [
            (Layout::Rgb, Chroma::Full),
            (Layout::Rgba, Chroma::Full),
            (Layout::Rgba, Chroma::Halved),
        ] {
            let bytes = scene(301, 203, layout);
            let pixels = Pixels {
                size_px: [301, 203],
                layout,
                bytes: &bytes,
            };
            let decoded = decode(&encode_in_strips(&pixels, 92, chroma, 4).expect("encoded"));
            let source = bytes
                .chunks_exact(layout.n_channels())
                .flat_map(|pixel| &pixel[..3]);
            let off: f64 = decoded
                .as_raw()
                .iter()
                .zip(source)
                .map(|(a, b)| f64::from(a.abs_diff(*b)))
                .sum();
            let mean = off / f64::from(301 * 203 * 3);
            assert!(
                mean < MEAN_ABS,
                "{layout:?}, {chroma:?}: colors differ by {mean} on average"
            );
        }
    }

    #[test]
    fn wrong_length_or_size_is_an_error() {
        let encode = |size_px, bytes: &[u8]| {
            encode_in_strips(
                &Pixels {
                    size_px,
                    layout: Layout::Rgba,
                    bytes,
                },
                90,
                Chroma::Full,
                2,
            )
        };
        let error = encode([4, 4], &[0; 63]).expect_err("63 bytes");
        assert_eq!(
            error.to_string(),
            "a 4 x 4 image needs 64 values but has 63"
        );
        assert!(encode([4, 4], &[0; 64]).is_ok());
        assert!(encode([0, 4], &[]).is_err());
        assert!(encode([70_000, 1], &vec![0; 280_000]).is_err());
    }

    #[test]
    fn downscaling_averages_the_covered_area() {
        let rgba: Vec<u8> = vec![
            10, 0, 0, 255, 20, 0, 0, 255, 99, 99, 99, 255, //
            30, 4, 0, 255, 40, 0, 8, 255, 99, 99, 99, 255,
        ];
        let pixels = Pixels {
            size_px: [3, 2],
            layout: Layout::Rgba,
            bytes: &rgba,
        };
        // Each target column covers 1.5 source columns: (10 + 30 + (20 + 40) / 2) / 3 and ((20 +
        // 40) / 2 + 2 * 99) / 3.
        let rgb = downscale(&pixels, [2, 1]).expect("downscaled");
        assert_eq!(rgb, [23, 1, 1, 76, 66, 67]);
        assert_eq!(
            downscale(&pixels, [3, 2]).expect("unchanged")[3..6],
            [20, 0, 0]
        );
        assert!(
            downscale(
                &Pixels {
                    size_px: [4, 2],
                    ..pixels
                },
                [2, 1]
            )
            .is_err()
        );
    }

    #[test]
    fn downscaling_keeps_the_mean() {
        let bytes = scene(301, 203, Layout::Rgb);
        let mean = |bytes: &[u8]| {
            bytes.iter().map(|value| f64::from(*value)).sum::<f64>() / bytes.len() as f64
        };
        for size_px in [[240, 161], [97, 65], [1, 1], [301, 1]] {
            let pixels = Pixels {
                size_px: [301, 203],
                layout: Layout::Rgb,
                bytes: &bytes,
            };
            let small = downscale(&pixels, size_px).expect("downscaled");
            assert_eq!(small.len(), 3 * (size_px[0] * size_px[1]) as usize);
            assert!(
                (mean(&small) - mean(&bytes)).abs() < 0.6,
                "{size_px:?}: {} {}",
                mean(&small),
                mean(&bytes)
            );
        }
    }
}
