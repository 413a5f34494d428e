//! Fuzz target for images in every format of cameras and recordings.

use super::input::take;
use crate::{Image, PixelFormat, YuvColors, YuvLayout, YuvMatrix, YuvRange, jpeg};
use kinematics::Stamp;

const COLORS: YuvColors = YuvColors {
    matrix: YuvMatrix::Bt601,
    range: YuvRange::Limited,
};
const FORMATS: [PixelFormat; 9] = [
    PixelFormat::Jpeg,
    PixelFormat::Png,
    PixelFormat::Rgb8,
    PixelFormat::Bgr8,
    PixelFormat::Gray8,
    PixelFormat::Yuv {
        layout: YuvLayout::Yuyv,
        colors: COLORS,
    },
    PixelFormat::Yuv {
        layout: YuvLayout::Uyvy,
        colors: COLORS,
    },
    PixelFormat::Yuv {
        layout: YuvLayout::Nv12,
        colors: COLORS,
    },
    PixelFormat::DepthU16 {
        meters_per_count: 0.001,
    },
];

/// Reads the format in one byte, then width, height and bytes per line in two bytes each, little
/// endian, then the image data.
///
/// Checks that readable images have as many pixels as declared.
pub fn pixels(mut bytes: &[u8]) {
    let [format] = take(&mut bytes);
    let format = FORMATS[usize::from(format) % FORMATS.len()];
    let [width, height, bytes_per_line] =
        std::array::from_fn(|_| u16::from_le_bytes(take(&mut bytes)));
    let size_px = [width, height].map(u32::from);
    let n_pixels = usize::from(width) * usize::from(height);
    let image = Image {
        camera: "camera".into(),
        stamp: Stamp(0),
        size_px,
        format,
        data: bytes.into(),
        exposure_secs: None,
        n_skipped: 0,
    };
    if let Ok(jpeg_bytes) = jpeg::first_image(bytes) {
        assert!(jpeg_bytes.starts_with(&[0xff, 0xd8]) && jpeg_bytes.ends_with(&[0xff, 0xd9]));
    }
    for image in [Ok(image.clone()), image.pack_rows(bytes_per_line.into())]
        .into_iter()
        .flatten()
    {
        if let Ok(rgb) = image.decode_rgb() {
            assert_eq!(rgb.len(), 3 * n_pixels);
        }
        if let Ok(depth_m) = image.decode_depth_m() {
            assert_eq!(depth_m.len(), n_pixels);
        }
    }
}
