//! Pictures that are small enough to embed in a page.

use anyhow::Context;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;

/// The largest size with the same aspect ratio and sides of at most `max_side_px`.
pub fn fit_size(size_px: [u32; 2], max_side_px: u32) -> [u32; 2] {
    let max_side = size_px[0].max(size_px[1]).max(1);
    if max_side <= max_side_px {
        return size_px;
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "smaller than the size, above 0"
    )]
    size_px.map(|side| {
        ((f64::from(side) * f64::from(max_side_px) / f64::from(max_side)).round() as u32).max(1)
    })
}

/// A JPEG as a data URI for `<img>`.
///
/// * `rgb`: three bytes per pixel, row by row.
///
/// # Errors
/// Fails if the picture cannot be encoded.
pub fn data_uri(rgb: &[u8], [width, height]: [u32; 2], quality: u8) -> anyhow::Result<String> {
    let mut bytes = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut bytes, quality);
    encoder
        .encode(rgb, width, height, ExtendedColorType::Rgb8)
        .context("cannot encode a picture as JPEG")?;
    let mut uri = String::from("data:image/jpeg;base64,");
    write_base64(&bytes, &mut uri);
    Ok(uri)
}

fn write_base64(bytes: &[u8], to: &mut String) {
    const SYMBOLS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    for group in bytes.chunks(3) {
        // Three bytes are 24 bits, which are four symbols of 6 bits. A shorter group at the end is
        // filled with zero bits, and its unused symbols are `=`.
        let bits = group
            .iter()
            .fold(0_u32, |bits, byte| bits << 8 | u32::from(*byte))
            << (8 * (3 - group.len()));
        for source_ix in 0..4 {
            let symbol = SYMBOLS[(bits >> (18 - 6 * source_ix) & 63) as usize];
            to.push(if source_ix <= group.len() {
                char::from(symbol)
            } else {
                '='
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_matches_rfc_4648() {
        for (bytes, expected) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("foobar", "Zm9vYmFy"),
        ] {
            let mut text = String::new();
            write_base64(bytes.as_bytes(), &mut text);
            assert_eq!(text, expected);
        }
    }

    #[test]
    fn pictures_keep_their_aspect_ratio() {
        assert_eq!(fit_size([1280, 720], 640), [640, 360]);
        assert_eq!(fit_size([524, 944], 640), [355, 640]);
        assert_eq!(fit_size([48, 36], 640), [48, 36]);
        assert_eq!(fit_size([9000, 2], 640), [640, 1]);
    }
}
