//! Decodes device data to plain pixels and meters.

use crate::{Error, Image, PixelFormat, jpeg, yuv};
use image::error::{DecodingError, ImageFormatHint};
use image::{DynamicImage, ImageError, ImageFormat, ImageReader};
use std::borrow::Cow;
use std::io::Cursor;

impl PixelFormat {
    /// Bytes per row without padding, and number of rows. Rows that contain only chroma are
    /// included. `None` for compressed formats.
    pub(crate) fn raw_size(self, size_px: [u32; 2]) -> Option<[usize; 2]> {
        let [width, height] = size_px.map(|side| side as usize);
        let bytes_per_pixel = match self {
            Self::Jpeg | Self::Png => return None,
            Self::Yuv { layout, .. } => {
                return Some([layout.row_bytes(width), layout.n_rows(height)]);
            }
            Self::Rgb8 | Self::Bgr8 => 3,
            Self::DepthU16 { .. } => 2,
            Self::Gray8 => 1,
        };
        Some([width.saturating_mul(bytes_per_pixel), height])
    }
}

impl Image {
    /// Whether this is a depth image.
    pub fn is_depth(&self) -> bool {
        matches!(self.format, PixelFormat::DepthU16 { .. })
    }

    /// Decodes a color image to `[height, width, 3]`, sRGB. Gray images get equal red, green and
    /// blue.
    pub fn decode_rgb(&self) -> Result<Vec<u8>, Error> {
        match self.format {
            PixelFormat::Rgb8 => self.raw_bytes().map(<[u8]>::to_vec),
            PixelFormat::Bgr8 => {
                let mut rgb = self.raw_bytes()?.to_vec();
                rgb.as_chunks_mut::<3>()
                    .0
                    .iter_mut()
                    .for_each(|pixel| pixel.reverse());
                Ok(rgb)
            }
            PixelFormat::Gray8 => Ok(self
                .raw_bytes()?
                .iter()
                .flat_map(|gray| [*gray; 3])
                .collect()),
            PixelFormat::Yuv { layout, colors } => {
                Ok(yuv::rgb(layout, colors, self.size_px, self.raw_bytes()?))
            }
            PixelFormat::Jpeg => self.decompress(ImageFormat::Jpeg),
            PixelFormat::Png => self.decompress(ImageFormat::Png),
            PixelFormat::DepthU16 { .. } => Err(self.wrong_kind("color")),
        }
    }

    /// Decodes a depth image to `[height, width]`, meters along the camera's z axis. A value of 0
    /// means that the depth is unknown. A pixel with the largest count is out of range, and is also
    /// decoded to 0.
    pub fn decode_depth_m(&self) -> Result<Vec<f32>, Error> {
        let PixelFormat::DepthU16 { meters_per_count } = self.format else {
            return Err(self.wrong_kind("depth"));
        };
        Ok(self
            .raw_bytes()?
            .chunks_exact(2)
            .map(|count| meters_from_count(count, meters_per_count))
            .collect())
    }

    /// Removes the padding that a device adds after each row. The last row may also have padding.
    ///
    /// `bytes_per_line` is the distance between the starts of two rows (`bytesperline` of V4L2;
    /// chroma rows have the same stride). Compressed images are returned unchanged.
    ///
    /// # Errors
    /// If `bytes_per_line` is shorter than a row, or the data ends before the last row.
    pub fn pack_rows(mut self, bytes_per_line: usize) -> Result<Self, Error> {
        let Some([row_bytes, n_rows]) = self.format.raw_size(self.size_px) else {
            return Ok(self);
        };
        // Sizes come from devices and recordings and may be huge. Products therefore saturate
        // instead of overflowing, and the comparison below refuses an image with such a size. The
        // padding of the last row may be missing.
        let last_row = bytes_per_line.saturating_mul(n_rows.saturating_sub(1));
        let needed_bytes = last_row.saturating_add(row_bytes);
        if bytes_per_line < row_bytes || self.data.len() < needed_bytes {
            return Err(self.wrong_length(needed_bytes.max(row_bytes.saturating_mul(n_rows))));
        }
        if self.data.len() != row_bytes * n_rows {
            let mut packed = Vec::with_capacity(row_bytes * n_rows);
            for row in self.data.chunks(bytes_per_line.max(1)).take(n_rows) {
                packed.extend_from_slice(&row[..row_bytes]);
            }
            self.data = packed.into();
        }
        Ok(self)
    }

    /// Checks the length of the data of an uncompressed image, and returns the data.
    pub(crate) fn raw_bytes(&self) -> Result<&[u8], Error> {
        let expected_bytes = self
            .format
            .raw_size(self.size_px)
            .map_or(self.data.len(), |[row_bytes, n_rows]| {
                row_bytes.saturating_mul(n_rows)
            });
        if self.data.len() == expected_bytes {
            Ok(&self.data)
        } else {
            Err(self.wrong_length(expected_bytes))
        }
    }

    fn wrong_length(&self, expected_bytes: usize) -> Error {
        Error::ImageLength {
            camera: self.camera.to_string(),
            stamp: self.stamp,
            got_bytes: self.data.len(),
            expected_bytes,
        }
    }

    fn decompress(&self, format: ImageFormat) -> Result<Vec<u8>, Error> {
        match self.decode_of_size(format) {
            Ok((_, Some(decoded))) => Ok(decoded.into_rgb8().into_raw()),
            Ok((got_px, None)) => Err(Error::ImageSize {
                camera: self.camera.to_string(),
                stamp: self.stamp,
                got_px,
                expected_px: self.size_px,
            }),
            Err(source) => Err(Error::Undecodable {
                camera: self.camera.to_string(),
                stamp: self.stamp,
                source,
            }),
        }
    }

    /// Returns the size of a compressed image. Also returns the decoded image if its size is as
    /// expected.
    fn decode_of_size(
        &self,
        format: ImageFormat,
    ) -> Result<([u32; 2], Option<DynamicImage>), ImageError> {
        let file = first_complete(&self.data, format)?;
        // The size is checked first, because a few bytes can declare a huge image that takes
        // seconds to decode.
        let got_px: [u32; 2] = ImageReader::with_format(Cursor::new(&*file), format)
            .into_dimensions()?
            .into();
        if got_px != self.size_px {
            return Ok((got_px, None));
        }
        let decoded = image::load_from_memory_with_format(&file, format)?;
        Ok((got_px, Some(decoded)))
    }

    pub(crate) fn wrong_kind(&self, expected: &'static str) -> Error {
        Error::WrongKind {
            camera: self.camera.to_string(),
            stamp: self.stamp,
            expected,
        }
    }
}

/// Depth of one pixel from its two bytes.
#[expect(
    clippy::cast_possible_truncation,
    reason = "f32 is more precise than the sensor"
)]
fn meters_from_count(count: &[u8], meters_per_count: f64) -> f32 {
    match u16::from_le_bytes([count[0], count[1]]) {
        u16::MAX => 0.0,
        count => (f64::from(count) * meters_per_count) as f32,
    }
}

/// Decodes an image of a given or guessed format. From JPEG data, the first complete image is used.
/// A truncated image is an error here, whereas decoders fill the missing part with gray.
pub(crate) fn decode_complete(
    bytes: &[u8],
    format: Option<ImageFormat>,
) -> Result<DynamicImage, ImageError> {
    let format = format.map_or_else(|| image::guess_format(bytes), Ok)?;
    image::load_from_memory_with_format(&first_complete(bytes, format)?, format)
}

/// The first complete JPEG image of a buffer; other formats are returned unchanged.
fn first_complete(bytes: &[u8], format: ImageFormat) -> Result<Cow<'_, [u8]>, ImageError> {
    if format != ImageFormat::Jpeg {
        return Ok(bytes.into());
    }
    let no_image =
        |reason| ImageError::Decoding(DecodingError::new(ImageFormatHint::Exact(format), reason));
    jpeg::first_image(bytes).map_err(no_image)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{YuvColors, YuvLayout, YuvMatrix, YuvRange};
    use kinematics::Stamp;

    fn image(format: PixelFormat, size_px: [u32; 2], data: &[u8]) -> Image {
        Image {
            camera: "wrist".into(),
            stamp: Stamp(7),
            size_px,
            format,
            data: data.into(),
            exposure_secs: None,
            n_skipped: 0,
        }
    }

    fn file_of(format: ImageFormat, [width, height]: [u32; 2], rgb: &[u8]) -> Vec<u8> {
        let mut file = std::io::Cursor::new(Vec::new());
        image::write_buffer_with_format(
            &mut file,
            rgb,
            width,
            height,
            image::ExtendedColorType::Rgb8,
            format,
        )
        .expect("a small image");
        file.into_inner()
    }

    fn png_of(size_px: [u32; 2], rgb: &[u8]) -> Vec<u8> {
        file_of(ImageFormat::Png, size_px, rgb)
    }

    #[test]
    fn truncated_jpeg_is_rejected_at_any_length() {
        let rgb: Vec<u8> = (0..3 * 64 * 64)
            .map(|ix: u32| (ix * ix % 251) as u8)
            .collect();
        let complete = file_of(ImageFormat::Jpeg, [64, 64], &rgb);
        let decode = |data: &[u8]| image(PixelFormat::Jpeg, [64, 64], data).decode_rgb();
        assert_eq!(decode(&complete).expect("complete").len(), rgb.len());
        assert!(decode(&[&complete[..], b"bytes appended by a camera"].concat()).is_ok());
        for n_bytes in [
            complete.len() - 2,
            complete.len() * 9 / 10,
            complete.len() / 2,
            20,
            3,
            0,
        ] {
            let error = decode(&complete[..n_bytes]).expect_err("truncated");
            assert!(
                matches!(error, Error::Undecodable { .. }),
                "{n_bytes}: {error}"
            );
        }
        // A thumbnail in the first segments has an end marker, but the image does not.
        let mut with_thumbnail = [
            &complete[..2],
            &[0xff, 0xe1, 0, 6, 0xff, 0xd8, 0xff, 0xd9],
            &complete[2..],
        ]
        .concat();
        assert!(decode(&with_thumbnail).is_ok());
        with_thumbnail.truncate(complete.len() - 100);
        assert!(decode(&with_thumbnail).is_err());
    }

    #[test]
    fn color_decodes_from_every_format() {
        let rgb = [10, 20, 30, 40, 50, 60];
        assert_eq!(
            image(PixelFormat::Rgb8, [2, 1], &rgb)
                .decode_rgb()
                .expect("rgb"),
            rgb
        );
        assert_eq!(
            image(PixelFormat::Gray8, [2, 1], &[7, 9])
                .decode_rgb()
                .expect("gray"),
            [7, 7, 7, 9, 9, 9]
        );
        assert_eq!(
            image(PixelFormat::Png, [2, 1], &png_of([2, 1], &rgb))
                .decode_rgb()
                .expect("png"),
            rgb
        );
        assert_eq!(
            image(PixelFormat::Bgr8, [2, 1], &rgb)
                .decode_rgb()
                .expect("bgr"),
            [30, 20, 10, 60, 50, 40]
        );
        let gray = image(
            yuv(YuvLayout::Yuyv),
            [3, 1],
            &[7, 128, 9, 128, 11, 128, 0, 128],
        )
        .decode_rgb()
        .expect("yuv");
        assert_eq!(gray, [7, 7, 7, 9, 9, 9, 11, 11, 11]);
    }

    fn yuv(layout: YuvLayout) -> PixelFormat {
        PixelFormat::Yuv {
            layout,
            colors: YuvColors {
                matrix: YuvMatrix::Bt601,
                range: YuvRange::Full,
            },
        }
    }

    #[test]
    fn row_padding_is_removed_and_short_buffers_rejected() {
        let depth = PixelFormat::DepthU16 {
            meters_per_count: 1e-3,
        };
        let [yuyv, uyvy, nv12] = [YuvLayout::Yuyv, YuvLayout::Uyvy, YuvLayout::Nv12].map(yuv);
        for format in [
            PixelFormat::Rgb8,
            PixelFormat::Bgr8,
            PixelFormat::Gray8,
            depth,
            yuyv,
            uyvy,
            nv12,
        ] {
            for size_px in [[5, 3], [4, 2], [1, 1]] {
                let [row_bytes, n_rows] = format.raw_size(size_px).expect("raw");
                let tight: Vec<u8> = (1..=row_bytes * n_rows)
                    .map(|ix| ix.to_le_bytes()[0])
                    .collect();
                for padding in [0, 1, 11] {
                    let padded: Vec<u8> = tight
                        .chunks(row_bytes)
                        .flat_map(|row| [row, &[0xee; 11][..padding]].concat())
                        .collect();
                    let bytes_per_line = row_bytes + padding;
                    let pack = |data: &[u8]| image(format, size_px, data).pack_rows(bytes_per_line);
                    assert_eq!(
                        &*pack(&padded).expect("padded").data,
                        tight,
                        "{format:?} {size_px:?} {padding}"
                    );
                    // Devices may omit the padding of the last row. They may also send more bytes
                    // than they have filled.
                    assert_eq!(
                        &*pack(&padded[..padded.len() - padding])
                            .expect("no last padding")
                            .data,
                        tight
                    );
                    assert_eq!(
                        &*pack(&[&padded[..], &[0; 99]].concat())
                            .expect("an extra page")
                            .data,
                        tight
                    );
                    let short = pack(&padded[..padded.len() - padding - 1]);
                    assert!(
                        matches!(short, Err(Error::ImageLength { .. })),
                        "{format:?} {size_px:?} {padding}"
                    );
                    let narrow = image(format, size_px, &padded).pack_rows(row_bytes - 1);
                    assert!(matches!(narrow, Err(Error::ImageLength { .. })));
                }
                let short = image(format, size_px, &tight[1..]);
                let rejected = if short.is_depth() {
                    short.decode_depth_m().err()
                } else {
                    short.decode_rgb().err()
                };
                assert!(
                    matches!(rejected, Some(Error::ImageLength { .. })),
                    "{format:?} {size_px:?}"
                );
            }
        }
        assert_eq!(
            image(nv12, [5, 3], &[0; 30])
                .decode_rgb()
                .expect("three rows of luma and two of chroma")
                .len(),
            45
        );
    }

    #[test]
    fn depth_counts_convert_to_meters_and_unknown_is_zero() {
        let depth = image(
            PixelFormat::DepthU16 {
                meters_per_count: 1e-4,
            },
            [4, 1],
            &[0, 0, 0x10, 0x27, 0xfe, 0xff, 0xff, 0xff],
        );
        assert_eq!(
            depth.decode_depth_m().expect("depth"),
            [0.0, 1.0, 6.5534, 0.0]
        );
    }

    #[test]
    fn broken_images_report_camera_and_cause() {
        let cut = image(PixelFormat::Jpeg, [2, 1], &[0xff, 0xd8, 0xff])
            .decode_rgb()
            .expect_err("truncated")
            .to_string();
        assert!(
            cut.contains("wrist") && cut.contains("does not decode"),
            "{cut}"
        );
        let short = image(PixelFormat::Rgb8, [2, 1], &[1, 2, 3]).decode_rgb();
        assert!(matches!(
            short,
            Err(Error::ImageLength {
                got_bytes: 3,
                expected_bytes: 6,
                ..
            })
        ));
        let other_size = image(PixelFormat::Png, [2, 2], &png_of([2, 1], &[0; 6])).decode_rgb();
        assert!(matches!(
            other_size,
            Err(Error::ImageSize { got_px: [2, 1], .. })
        ));
        // The header alone declares an image that would take gigabytes.
        let mut huge = file_of(ImageFormat::Jpeg, [2, 1], &[0; 6]);
        let frame = huge
            .windows(2)
            .position(|pair| pair == [0xff, 0xc0])
            .expect("a frame header");
        huge[frame + 5..frame + 9].copy_from_slice(&[0x3f, 0xff, 0x3f, 0xff]);
        let huge = image(PixelFormat::Jpeg, [2, 2], &huge).decode_rgb();
        assert!(
            matches!(
                huge,
                Err(Error::ImageSize {
                    got_px: [16_383, 16_383],
                    ..
                })
            ),
            "{huge:?}"
        );
        assert!(matches!(
            image(PixelFormat::Rgb8, [1, 1], &[0; 3]).decode_depth_m(),
            Err(Error::WrongKind {
                expected: "depth",
                ..
            })
        ));
    }
}
