//! Packs pictures and live images into binary messages.

use crate::client::protocol::DepthFormat;
use crate::client::server_message::{
    BinaryHeader, ColorPart, DepthPart, LiveHeader, NewestKeyframeMessage, PictureHeader, frame,
};
use crate::clock::ServerClock;
use crate::pictures::compact_depth::{Effort, compress};
use crate::pictures::jpeg::{Chroma, JpegError, Layout, Pixels, downscale, encode, n_threads};
use crate::pictures::picture_times::TrainedKeyframes;
use crate::pictures::queue::{DrawnPicture, RenderJob};
use crate::pictures::view_request::ViewRequest;
use keyframe::{LiveImage, LivePixels};
use std::borrow::Cow;
use std::time::Instant;
use trainer::{JPEG_QUALITY, PackedDepth, Packing, Picture, Rendered};

/// JPEG quality of intermediate stages, which are soon replaced. With a higher quality, these
/// stages would take longer to send, and the last stage would arrive later.
const QUALITY_INTERMEDIATE: u8 = 80;
/// JPEG quality of live images. They are shown without enlargement, several times per second. They
/// are most of what an idle page receives: 56 of 62 kB/s with quality 80
/// (`docs/benchmarks/2026-11-26-viewer-protocol.md`).
const QUALITY_LIVE: u8 = 72;
/// Smaller pictures keep full color resolution, because halving it saves little and the page
/// enlarges these pictures.
const MIN_HALVED_PX: usize = 256 * 256;
/// Minimum number of depth pixels per thread. For smaller maps, another thread does not help.
const MIN_DEPTH_PX: usize = 128 * 1024;

/// Reason why a picture cannot be sent.
#[derive(Debug, thiserror::Error)]
pub(crate) enum PackError {
    #[error("a {width} x {height} depth map needs {needed} values but has {got}")]
    DepthLength {
        width: u32,
        height: u32,
        needed: usize,
        got: usize,
    },
    #[error(transparent)]
    Encode(#[from] JpegError),
    #[error("the JPEG file cannot be decoded: {0}")]
    Decode(#[from] image::ImageError),
    #[error("the depth cannot be compressed: {0}")]
    Depth(#[from] std::io::Error),
    #[error("the JPEG file has {got:?} pixels, expected {expected:?}")]
    SizeMismatch { got: [u32; 2], expected: [u32; 2] },
}

/// How a stage is packed on the GPU; `None` if the client requests another format.
pub(crate) fn packing(view_request: &ViewRequest, is_last: bool) -> Option<Packing> {
    let quality = if is_last {
        JPEG_QUALITY
    } else {
        QUALITY_INTERMEDIATE
    };
    let packing = Packing {
        jpeg_quality: view_request.color.then_some(quality),
        depth: view_request.depth.is_some(),
    };
    (view_request.depth != Some(DepthFormat::F32)).then_some(packing)
}

/// An encoded stage.
pub(crate) struct PackedPicture {
    pub(crate) job: RenderJob,
    pub(crate) header: PictureHeader,
    pub(crate) trained_on: Option<TrainedKeyframes>,
    color: Vec<u8>,
    depth: Vec<u8>,
}

impl PackedPicture {
    /// The binary message, which is sent at this time.
    pub(crate) fn message(&mut self, sent_at: Instant, clock: ServerClock) -> Vec<u8> {
        let newest = self.trained_on.and_then(|trained_on| trained_on.newest);
        self.header.newest_keyframe = newest.map(|keyframe| NewestKeyframeMessage {
            captured_millis: clock.millis(keyframe.captured_at),
            added_millis: clock.millis(keyframe.added_at),
        });
        self.header.sent_millis = clock.millis(sent_at);
        frame(
            &BinaryHeader::Picture(&self.header),
            &[&self.color, &self.depth],
        )
    }
}

/// Encodes one rendered stage.
pub(crate) fn pack_picture(
    drawn: DrawnPicture,
    effort: Option<Effort>,
) -> Result<PackedPicture, PackError> {
    let DrawnPicture {
        job,
        mut header,
        trained_on,
        rendered,
    } = drawn;
    let view_request = &*job.view_request;
    let began = Instant::now();
    // The GPU has already packed the stage, unless the client requests a format that the GPU does
    // not support.
    let (color, depth) = match rendered {
        Rendered::Packed(packed) => (packed.jpeg, packed.depth),
        Rendered::Picture(picture) => encode_picture(view_request, header.last, &picture)?,
    };
    let offset = color.as_ref().map_or(0, Vec::len);
    header.color = color.as_ref().map(|color| ColorPart {
        format: "jpeg",
        offset: 0,
        bytes: color.len(),
    });
    let depth = match depth {
        None => Vec::new(),
        Some(packed) => {
            let (part, bytes) = depth_part(view_request, packed, effort, offset)?;
            header.depth = part;
            bytes
        }
    };
    header.encode_millis = Some(began.elapsed().as_secs_f64() * 1e3);
    Ok(PackedPicture {
        job,
        header,
        trained_on,
        color: color.unwrap_or_default(),
        depth,
    })
}

/// The depth in the requested format, and its position in the payload. Both are empty if no depth
/// was requested.
fn depth_part(
    view_request: &ViewRequest,
    packed: PackedDepth,
    effort: Option<Effort>,
    offset: usize,
) -> Result<(Option<DepthPart>, Vec<u8>), PackError> {
    let format = match (view_request.depth, effort) {
        // Within a computer, compression takes longer than it saves, so depth is sent uncompressed.
        // The header names the format that is used.
        (Some(DepthFormat::CompactHalf), None) => DepthFormat::U16Half,
        (Some(requested), _) => requested,
        (None, _) => return Ok((None, Vec::new())),
    };
    if format == DepthFormat::CompactHalf {
        let compact = compress(&packed, effort.unwrap_or(Effort::Fast))?;
        let part = DepthPart {
            format,
            size_px: compact.size_px,
            meters_per_count: None,
            min_m: Some(compact.min_m),
            log_step: Some(compact.log_step),
            offset,
            bytes: compact.bytes.len(),
        };
        return Ok((Some(part), compact.bytes));
    }
    let part = DepthPart {
        format,
        size_px: packed.size_px,
        meters_per_count: Some(packed.meters_per_count),
        min_m: None,
        log_step: None,
        offset,
        bytes: packed.counts.len(),
    };
    Ok((Some(part), packed.counts))
}

/// Encodes the requested color and depth of a picture.
fn encode_picture(
    view_request: &ViewRequest,
    is_last: bool,
    picture: &Picture,
) -> Result<(Option<Vec<u8>>, Option<PackedDepth>), PackError> {
    let (color, depth) = std::thread::scope(|scope| {
        // Color and depth are encoded in parallel. Color takes most of the time and is encoded on
        // this thread.
        let depth = view_request
            .depth
            .map(|format| scope.spawn(move || pack_depth(format, picture)));
        let color = view_request.color.then(|| pack_color(picture, is_last));
        (
            color,
            depth.map(|task| task.join().expect("packing depth does not panic")),
        )
    });
    Ok((color.transpose()?, depth.transpose()?))
}

fn pack_color(picture: &Picture, is_last: bool) -> Result<Vec<u8>, JpegError> {
    let pixels = Pixels {
        size_px: picture.size_px,
        layout: Layout::Rgba,
        bytes: &picture.rgba_srgb,
    };
    // Large intermediate stages are replaced before anybody looks closely, so their chroma is
    // halved.
    let is_small = picture.rgba_srgb.len() < 4 * MIN_HALVED_PX;
    let quality = if is_last {
        JPEG_QUALITY
    } else {
        QUALITY_INTERMEDIATE
    };
    encode(
        &pixels,
        quality,
        if is_last || is_small {
            Chroma::Full
        } else {
            Chroma::Halved
        },
    )
}

/// The binary message of a live image, downscaled to `size_px`.
pub(crate) fn pack_live_image(
    image: &LiveImage,
    size_px: [u32; 2],
    clock: ServerClock,
) -> Result<Vec<u8>, PackError> {
    let jpeg = live_jpeg(image, size_px)?;
    Ok(frame(
        &BinaryHeader::LiveImage(&LiveHeader::new(image, size_px, clock)),
        &[&jpeg],
    ))
}

/// The JPEG file of a live image, downscaled to `size_px`.
pub(crate) fn live_jpeg(image: &LiveImage, size_px: [u32; 2]) -> Result<Cow<'_, [u8]>, PackError> {
    let decoded;
    let pixels = match &image.pixels {
        // The JPEG file is sent unchanged, because encoding it again would take time and reduce the
        // quality.
        LivePixels::Jpeg(file) if size_px == image.size_px => return Ok(Cow::Borrowed(file)),
        LivePixels::Jpeg(file) => {
            decoded =
                image::load_from_memory_with_format(file, image::ImageFormat::Jpeg)?.into_rgb8();
            let got = [decoded.width(), decoded.height()];
            // The header would state the intrinsics of another size.
            if got != image.size_px {
                return Err(PackError::SizeMismatch {
                    got,
                    expected: image.size_px,
                });
            }
            Pixels {
                size_px: got,
                layout: Layout::Rgb,
                bytes: decoded.as_raw(),
            }
        }
        LivePixels::Rgb(bytes) => Pixels {
            size_px: image.size_px,
            layout: Layout::Rgb,
            bytes,
        },
        LivePixels::Rgba(bytes) => Pixels {
            size_px: image.size_px,
            layout: Layout::Rgba,
            bytes,
        },
    };
    if size_px == image.size_px {
        return Ok(Cow::Owned(encode(&pixels, QUALITY_LIVE, Chroma::Halved)?));
    }
    let rgb = downscale(&pixels, size_px)?;
    Ok(Cow::Owned(encode(
        &Pixels {
            size_px,
            layout: Layout::Rgb,
            bytes: &rgb,
        },
        QUALITY_LIVE,
        Chroma::Halved,
    )?))
}

fn pack_depth(format: DepthFormat, picture: &Picture) -> Result<PackedDepth, PackError> {
    let [width, height] = picture.size_px;
    let needed = width as usize * height as usize;
    let got = picture.depth_m.len();
    if got != needed {
        return Err(PackError::DepthLength {
            width,
            height,
            needed,
            got,
        });
    }
    Ok(match format {
        DepthFormat::F32 => f32_depth(picture),
        DepthFormat::U16Half | DepthFormat::CompactHalf => {
            half_depth(picture, n_threads().min(needed / MIN_DEPTH_PX))
        }
    })
}

fn f32_depth(picture: &Picture) -> PackedDepth {
    let mut bytes = vec![0; 4 * picture.depth_m.len()];
    for (packed, depth) in bytes.chunks_exact_mut(4).zip(&picture.depth_m) {
        packed.copy_from_slice(&depth.to_le_bytes());
    }
    PackedDepth {
        size_px: picture.size_px,
        meters_per_count: 1.0,
        counts: bytes,
    }
}

/// Halves the size of a depth map. Each block of 2x2 pixels keeps its nearest depth, so that thin
/// objects in front stay visible; 0 means no depth.
///
/// The largest depth maps to the largest count, so that the step is as small as 16 bits allow.
fn half_depth(picture: &Picture, n_threads: usize) -> PackedDepth {
    let width = picture.size_px[0] as usize;
    let size_px = picture.size_px.map(|n| n.div_ceil(2));
    let out_width = size_px[0] as usize;
    let pairs_per_thread = (size_px[1] as usize).div_ceil(n_threads.max(1)).max(1);
    // Each pair of rows belongs to one thread. The length is at least 1, because `chunks` does not
    // allow a length of 0.
    let bands = picture
        .depth_m
        .chunks((2 * width * pairs_per_thread).max(1));
    // The scale of the counts is needed before any of them can be written.
    let furthest_m = std::thread::scope(|scope| {
        let tasks: Vec<_> = bands
            .clone()
            .map(|band| scope.spawn(move || max_depth(band)))
            .collect();
        tasks
            .into_iter()
            .map(|task| task.join().expect("a maximum does not panic"))
            .fold(0.0, f32::max)
    });
    let meters_per_count = if furthest_m > 0.0 {
        f64::from(furthest_m) / f64::from(u16::MAX)
    } else {
        1.0
    };
    let mut bytes = vec![0; 2 * out_width * size_px[1] as usize];
    std::thread::scope(|scope| {
        for (band, packed) in bands.zip(bytes.chunks_mut((2 * out_width * pairs_per_thread).max(1)))
        {
            scope.spawn(move || halve_band(band, width, 1.0 / meters_per_count, packed));
        }
    });
    PackedDepth {
        size_px,
        meters_per_count,
        counts: bytes,
    }
}

/// Packs the counts of a band of rows; each row of counts is made from two rows of depths.
fn halve_band(depth_m: &[f32], width: usize, counts_per_meter: f64, packed: &mut [u8]) {
    let out_width = width.div_ceil(2);
    let mut nearest_m = vec![0.0; out_width];
    for (rows, packed) in depth_m
        .chunks(2 * width)
        .zip(packed.chunks_exact_mut(2 * out_width))
    {
        let (upper, lower) = rows.split_at(width);
        // The last row of an odd height has no row below it.
        let lower = if lower.is_empty() { upper } else { lower };
        nearest_of_squares(upper, lower, &mut nearest_m);
        write_counts(&nearest_m, counts_per_meter, packed);
    }
}

/// Depth of a pixel, or infinity if it has none.
fn depth_or_infinity(depth_m: f32) -> f32 {
    // The comparison is false for NaN.
    if depth_m > 0.0 {
        depth_m
    } else {
        f32::INFINITY
    }
}

fn max_depth(depth_m: &[f32]) -> f32 {
    depth_m.iter().fold(0.0, |max_depth, &depth| {
        if depth.is_finite() {
            max_depth.max(depth)
        } else {
            max_depth
        }
    })
}

fn nearest_of_squares(upper: &[f32], lower: &[f32], nearest_m: &mut [f32]) {
    let squares = upper.chunks(2).zip(lower.chunks(2));
    for (nearest, (upper, lower)) in nearest_m.iter_mut().zip(squares) {
        // The last column of an odd width has no column to its right.
        let right_above = upper[upper.len() - 1];
        let right_below = lower[lower.len() - 1];
        let left = depth_or_infinity(upper[0]).min(depth_or_infinity(lower[0]));
        *nearest = left
            .min(depth_or_infinity(right_above))
            .min(depth_or_infinity(right_below));
    }
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "counts lie between 0 and 65535"
)]
fn write_counts(depth_m: &[f32], counts_per_meter: f64, packed: &mut [u8]) {
    for (packed, depth) in packed.chunks_exact_mut(2).zip(depth_m) {
        let count = (f64::from(*depth) * counts_per_meter + 0.5) as u16;
        // A very near surface is still a surface: 0 means that there is none.
        let count = if depth.is_finite() { count.max(1) } else { 0 };
        packed.copy_from_slice(&count.to_le_bytes());
    }
}

#[cfg(test)]
mod tests {
    use super::{half_depth, pack_live_image};
    use crate::clock::ServerClock;
    use keyframe::{LiveImage, LivePixels};
    use kinematics::Stamp;
    use std::time::Instant;
    use trainer::{PackedDepth, Picture};

    #[test]
    fn half_depth_keeps_nearest_and_holes() {
        let depth_m = vec![
            1.0,
            2.0,
            0.0,
            0.0,
            4.0, //
            3.0,
            0.5,
            0.0,
            f32::NAN,
            4.0, //
            0.0,
            2.5,
            8.0,
            9.0,
            10.0,
        ];
        let picture = Picture {
            size_px: [5, 3],
            rgba_srgb: vec![0; 60],
            depth_m,
        };
        for n_threads in [1, 2, 5] {
            check_halved(&half_depth(&picture, n_threads));
        }
    }

    fn check_halved(packed: &PackedDepth) {
        assert_eq!(packed.size_px, [3, 2]);
        let counts = packed
            .counts
            .chunks_exact(2)
            .map(|count| u16::from_le_bytes([count[0], count[1]]));
        let meters: Vec<f64> = counts
            .map(|count| f64::from(count) * packed.meters_per_count)
            .collect();
        for (got, expected) in meters.iter().zip([0.5, 0.0, 4.0, 2.5, 8.0, 10.0]) {
            assert!(
                (got - expected).abs() <= 0.5 * packed.meters_per_count + 1e-9,
                "{meters:?}"
            );
        }
    }

    #[test]
    fn empty_picture_has_zero_depth() {
        let packed = half_depth(
            &Picture {
                size_px: [2, 2],
                rgba_srgb: vec![0; 16],
                depth_m: vec![0.0; 4],
            },
            1,
        );
        assert_eq!(packed.counts, [0, 0]);
    }

    #[test]
    fn large_live_images_are_shrunk_with_intrinsics() {
        let size_px = [1280, 720];
        let rgb: Vec<u8> = (0..size_px[0] * size_px[1])
            .flat_map(|_| [200, 100, 50])
            .collect();
        let jpeg = {
            let mut file = std::io::Cursor::new(Vec::new());
            let image = image::RgbImage::from_raw(size_px[0], size_px[1], rgb.clone())
                .expect("the length fits");
            image
                .write_to(&mut file, image::ImageFormat::Jpeg)
                .expect("encoded");
            file.into_inner()
        };
        let clock = ServerClock::start();
        for pixels in [LivePixels::Rgb(rgb.into()), LivePixels::Jpeg(jpeg.into())] {
            let image = LiveImage {
                camera: "wrist".into(),
                stamp: Stamp(1),
                captured_at: Instant::now(),
                size_px,
                pixels,
                world_from_camera: None,
                focal_px: [900.0, 902.0],
                principal_px: [640.0, 360.0],
            };
            let message = pack_live_image(&image, [640, 360], clock).expect("packed");
            let n_header =
                u32::from_le_bytes([message[0], message[1], message[2], message[3]]) as usize;
            let header: serde_json::Value =
                serde_json::from_slice(&message[4..4 + n_header]).expect("JSON");
            assert_eq!(header["size_px"], serde_json::json!([640, 360]));
            assert_eq!(header["focal_px"], serde_json::json!([450.0, 451.0]));
            assert_eq!(header["principal_px"], serde_json::json!([320.0, 180.0]));
            let sent = image::load_from_memory_with_format(
                &message[4 + n_header..],
                image::ImageFormat::Jpeg,
            );
            let sent = sent.expect("a JPEG file").to_rgb8();
            assert_eq!((sent.width(), sent.height()), (640, 360));
            let [red, green, blue] = sent.get_pixel(320, 180).0;
            assert!(red.abs_diff(200) < 6 && green.abs_diff(100) < 6 && blue.abs_diff(50) < 6);
        }
    }

    /// Prints the packing time: `cargo test --release -p viz -- --ignored --nocapture packing`.
    #[test]
    #[ignore = "measures"]
    #[expect(
        clippy::print_stdout,
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a measurement"
    )]
    fn measure_packing() {
        for size_px in [[1024, 1024], [1280, 720]] {
            let n_px = size_px[0] * size_px[1];
            let wave =
                |ix: u32, period: f64| (127.0 + 100.0 * (f64::from(ix) / period).sin()) as u8;
            let noise = |ix: u32| (ix.wrapping_mul(2_654_435_761) >> 28) as u8;
            let rgba_srgb: Vec<u8> = (0..n_px)
                .flat_map(|ix| {
                    [
                        wave(ix % size_px[0], 31.0) + noise(ix),
                        wave(ix / size_px[0], 17.0),
                        wave(ix, 977.0),
                        255,
                    ]
                })
                .collect();
            let depth_m = (0..n_px).map(|ix| 1.0 + (ix % 977) as f32 * 1e-3).collect();
            let picture = Picture {
                size_px,
                rgba_srgb,
                depth_m,
            };
            let best = |work: &dyn Fn() -> usize| {
                (0..15)
                    .map(|_| {
                        let begun = Instant::now();
                        (work(), begun.elapsed().as_secs_f64() * 1e3)
                    })
                    .min_by(|a, b| a.1.total_cmp(&b.1))
                    .expect("15 runs")
            };
            let pixels = crate::pictures::jpeg::Pixels {
                size_px,
                layout: crate::pictures::jpeg::Layout::Rgba,
                bytes: &picture.rgba_srgb,
            };
            use crate::pictures::jpeg::Chroma;
            for (name, quality, chroma) in [
                ("4:4:4 q92", 92, Chroma::Full),
                ("4:2:0 q92", 92, Chroma::Halved),
                ("4:2:0 q80", 80, Chroma::Halved),
            ] {
                let (bytes, millis) = best(&|| {
                    crate::pictures::jpeg::encode(&pixels, quality, chroma)
                        .expect("encoded")
                        .len()
                });
                println!("{size_px:?} color {name}: {millis:.2} ms, {bytes} bytes");
            }
            let (bytes, millis) = best(&|| {
                half_depth(&picture, crate::pictures::jpeg::n_threads())
                    .counts
                    .len()
            });
            println!("{size_px:?} depth u16_half: {millis:.2} ms, {bytes} bytes");
            let (bytes, millis) = best(&|| {
                let rgb: Vec<u8> = picture
                    .rgba_srgb
                    .chunks_exact(4)
                    .flat_map(|pixel| [pixel[0], pixel[1], pixel[2]])
                    .collect();
                let mut file = Vec::new();
                image::codecs::jpeg::JpegEncoder::new_with_quality(&mut file, 92)
                    .encode(&rgb, size_px[0], size_px[1], image::ExtendedColorType::Rgb8)
                    .expect("encoded");
                file.len()
            });
            println!(
                "{size_px:?} color by the image crate, 4:4:4 q92: {millis:.2} ms, {bytes} bytes"
            );
        }
    }
}
