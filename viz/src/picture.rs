//! Packs pictures and live images into binary messages.

use crate::news::{LiveImage, LivePixels};
use crate::protocol::{BinaryHeader, ColorPart, DepthFormat, DepthPart, LiveHeader, PictureHeader, frame};
use crate::render_order::RenderOrder;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use trainer::Picture;

/// JPEG quality of the last stage: no visible blocks on textures.
const QUALITY_LAST: u8 = 92;
/// JPEG quality of everything that is replaced soon.
const QUALITY_BRIEF: u8 = 80;

/// Why a picture cannot be sent.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Unsendable {
    #[error("a {width} x {height} image needs {needed} values but has {got}")]
    Length { width: u32, height: u32, needed: usize, got: usize },
    #[error("the image cannot be encoded: {0}")]
    Encode(#[from] image::ImageError),
}

/// The binary message of one drawn stage.
pub(crate) fn pack_picture(
    order: &RenderOrder,
    mut header: PictureHeader,
    picture: &Picture,
) -> Result<Vec<u8>, Unsendable> {
    let (mut color, mut depth) = (Vec::new(), Vec::new());
    if order.color {
        let quality = if header.last { QUALITY_LAST } else { QUALITY_BRIEF };
        color = jpeg_from_rgba(picture.size_px, &picture.rgba_srgb, quality)?;
        header.color = Some(ColorPart { format: "jpeg", offset: 0, bytes: color.len() });
    }
    if let Some(format) = order.depth {
        check_length(picture.size_px, 1, picture.depth_m.len())?;
        let packed = match format {
            DepthFormat::F32 => f32_depth(picture),
            DepthFormat::U16Half => half_depth(picture),
        };
        depth = packed.bytes;
        header.depth = Some(DepthPart {
            format,
            size_px: packed.size_px,
            metres_per_count: packed.metres_per_count,
            offset: color.len(),
            bytes: depth.len(),
        });
    }
    Ok(frame(&BinaryHeader::Picture(&header), &[&color, &depth]))
}

/// JPEG bytes of a live image.
pub(crate) fn live_jpeg(image: &LiveImage) -> Result<Vec<u8>, Unsendable> {
    match &image.pixels {
        LivePixels::Jpeg(bytes) => Ok(bytes.to_vec()),
        LivePixels::Rgb(pixels) => jpeg_from_rgb(image.size_px, pixels, QUALITY_BRIEF),
        LivePixels::Rgba(pixels) => jpeg_from_rgba(image.size_px, pixels, QUALITY_BRIEF),
    }
}

/// The binary message of a live image.
pub(crate) fn pack_live_image(image: &LiveImage, jpeg: &[u8]) -> Vec<u8> {
    frame(&BinaryHeader::LiveImage(&LiveHeader::from(image)), &[jpeg])
}

fn jpeg_from_rgba(size_px: [u32; 2], rgba: &[u8], quality: u8) -> Result<Vec<u8>, Unsendable> {
    check_length(size_px, 4, rgba.len())?;
    let rgb: Vec<u8> = rgba.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
    jpeg_from_rgb(size_px, &rgb, quality)
}

fn jpeg_from_rgb(size_px: [u32; 2], rgb: &[u8], quality: u8) -> Result<Vec<u8>, Unsendable> {
    check_length(size_px, 3, rgb.len())?;
    let mut bytes = Vec::with_capacity(rgb.len() / 8);
    JpegEncoder::new_with_quality(&mut bytes, quality).encode(rgb, size_px[0], size_px[1], ExtendedColorType::Rgb8)?;
    Ok(bytes)
}

fn check_length([width, height]: [u32; 2], n_channels: usize, got: usize) -> Result<(), Unsendable> {
    let needed = width as usize * height as usize * n_channels;
    if got == needed { Ok(()) } else { Err(Unsendable::Length { width, height, needed, got }) }
}

/// Depth as it goes on the wire.
struct PackedDepth {
    size_px: [u32; 2],
    metres_per_count: f64,
    bytes: Vec<u8>,
}

fn f32_depth(picture: &Picture) -> PackedDepth {
    let bytes = picture.depth_m.iter().flat_map(|depth| depth.to_le_bytes()).collect();
    PackedDepth { size_px: picture.size_px, metres_per_count: 1.0, bytes }
}

/// Halves the size, keeping the nearest of each 2x2 pixels so that thin things in front stay; 0 is nothing.
///
/// The largest depth becomes the largest count, so the step is as fine as 16 bits allow.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "counts lie between 0 and 65535")]
fn half_depth(picture: &Picture) -> PackedDepth {
    let [width, height] = picture.size_px.map(|n| n as usize);
    let is_seen = |depth: &f32| *depth > 0.0 && depth.is_finite();
    let furthest_m = picture.depth_m.iter().copied().filter(is_seen).fold(0.0, f32::max);
    let metres_per_count = if furthest_m > 0.0 { f64::from(furthest_m) / f64::from(u16::MAX) } else { 1.0 };
    let size_px = picture.size_px.map(|n| n.div_ceil(2));
    let mut bytes = Vec::with_capacity(2 * size_px[0] as usize * size_px[1] as usize);
    for y in (0..height).step_by(2) {
        for x in (0..width).step_by(2) {
            let rows = y..(y + 2).min(height);
            let block = rows.flat_map(|row| (x..(x + 2).min(width)).map(move |column| row * width + column));
            let nearest_m = block.map(|ix| picture.depth_m[ix]).filter(is_seen).fold(f32::INFINITY, f32::min);
            let count =
                if nearest_m.is_finite() { (f64::from(nearest_m) / metres_per_count).round().max(1.0) } else { 0.0 };
            bytes.extend_from_slice(&(count as u16).to_le_bytes());
        }
    }
    PackedDepth { size_px, metres_per_count, bytes }
}

#[cfg(test)]
mod tests {
    use super::{half_depth, jpeg_from_rgba};
    use trainer::Picture;

    #[test]
    fn half_depth_keeps_the_nearest_and_marks_holes() {
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
        let picture = Picture { size_px: [5, 3], rgba_srgb: vec![0; 60], depth_m };
        let packed = half_depth(&picture);
        assert_eq!(packed.size_px, [3, 2]);
        let counts = packed.bytes.chunks_exact(2).map(|count| u16::from_le_bytes([count[0], count[1]]));
        let metres: Vec<f64> = counts.map(|count| f64::from(count) * packed.metres_per_count).collect();
        for (got, expected) in metres.iter().zip([0.5, 0.0, 4.0, 2.5, 8.0, 10.0]) {
            assert!((got - expected).abs() <= 0.5 * packed.metres_per_count + 1e-9, "{metres:?}");
        }
    }

    #[test]
    fn a_picture_without_anything_has_zero_depth() {
        let packed = half_depth(&Picture { size_px: [2, 2], rgba_srgb: vec![0; 16], depth_m: vec![0.0; 4] });
        assert_eq!(packed.bytes, [0, 0]);
    }

    #[test]
    fn a_wrong_length_is_an_error_not_a_panic() {
        let error = jpeg_from_rgba([4, 4], &[0; 63], 90).expect_err("63 bytes");
        assert_eq!(error.to_string(), "a 4 x 4 image needs 64 values but has 63");
        assert!(jpeg_from_rgba([4, 4], &[0; 64], 90).is_ok());
    }
}
