//! From the bytes of a device to plain pixels and metres.

use crate::{Error, Image, PixelFormat};
use image::{DynamicImage, ImageError, ImageFormat};
use std::io::ErrorKind;

impl Image {
    /// Whether this is a depth image.
    pub fn is_depth(&self) -> bool {
        matches!(self.format, PixelFormat::DepthU16 { .. })
    }

    /// Decodes a colour image to `[height, width, 3]`, sRGB; grey becomes equal parts of red, green and blue.
    pub fn decode_rgb(&self) -> Result<Vec<u8>, Error> {
        match self.format {
            PixelFormat::Rgb8 => self.bytes_of(3).map(<[u8]>::to_vec),
            PixelFormat::Gray8 => Ok(self.bytes_of(1)?.iter().flat_map(|gray| [*gray; 3]).collect()),
            PixelFormat::Jpeg => self.decompress(ImageFormat::Jpeg),
            PixelFormat::Png => self.decompress(ImageFormat::Png),
            PixelFormat::DepthU16 { .. } => Err(self.wrong_kind("color")),
        }
    }

    /// Decodes a depth image to `[height, width]`, metres along the camera's z axis; 0 where the sensor saw nothing. The
    /// largest count says that the reading was larger still: nothing is known there either.
    pub fn decode_depth_m(&self) -> Result<Vec<f32>, Error> {
        let PixelFormat::DepthU16 { metres_per_count } = self.format else {
            return Err(self.wrong_kind("depth"));
        };
        #[expect(
            clippy::cast_possible_truncation,
            reason = "16-bit counts keep more digits in f32 than the sensor has"
        )]
        let metres_from_count = |count: &[u8]| match u16::from_le_bytes([count[0], count[1]]) {
            u16::MAX => 0.0,
            count => (f64::from(count) * metres_per_count) as f32,
        };
        Ok(self.bytes_of(2)?.chunks_exact(2).map(metres_from_count).collect())
    }

    /// The data of an uncompressed image once its length is checked.
    fn bytes_of(&self, bytes_per_pixel: usize) -> Result<&[u8], Error> {
        let expected_bytes =
            self.size_px.iter().fold(bytes_per_pixel, |bytes, side| bytes.saturating_mul(*side as usize));
        if self.data.len() == expected_bytes {
            return Ok(&self.data);
        }
        Err(Error::ImageLength {
            camera: self.camera.to_string(),
            stamp: self.stamp,
            got_bytes: self.data.len(),
            expected_bytes,
        })
    }

    fn decompress(&self, format: ImageFormat) -> Result<Vec<u8>, Error> {
        let decoded = decode_whole(&self.data, Some(format))
            .map_err(|source| Error::Undecodable { camera: self.camera.to_string(), stamp: self.stamp, source })?
            .into_rgb8();
        let got_px = [decoded.width(), decoded.height()];
        if got_px != self.size_px {
            return Err(Error::ImageSize {
                camera: self.camera.to_string(),
                stamp: self.stamp,
                got_px,
                expected_px: self.size_px,
            });
        }
        Ok(decoded.into_raw())
    }

    fn wrong_kind(&self, wanted: &'static str) -> Error {
        Error::WrongKind { camera: self.camera.to_string(), stamp: self.stamp, wanted }
    }
}

/// Decodes an image of a format that is given or guessed; one that is cut off is an error, too: decoders of JPEG fill up with grey.
pub(crate) fn decode_whole(bytes: &[u8], format: Option<ImageFormat>) -> Result<DynamicImage, ImageError> {
    let format = format.map_or_else(|| image::guess_format(bytes), Ok)?;
    if format == ImageFormat::Jpeg && !ends(bytes) {
        return Err(ImageError::IoError(std::io::Error::new(ErrorKind::UnexpectedEof, "the JPEG is cut off")));
    }
    image::load_from_memory_with_format(bytes, format)
}

/// Whether a JPEG has its last marker (ITU-T T.81, B.1.1): it may not come before the first scan, where thumbnails have theirs.
fn ends(jpeg: &[u8]) -> bool {
    const START_OF_SCAN: u8 = 0xda;
    const END_OF_IMAGE: [u8; 2] = [0xff, 0xd9];
    let mut rest = jpeg.get(2..).unwrap_or_default();
    while let [0xff, marker, high, low, ..] = rest {
        if *marker == START_OF_SCAN {
            return rest.windows(2).any(|pair| pair == END_OF_IMAGE);
        }
        // Markers may be padded with 0xff; the length counts its own two bytes.
        let n_bytes = if *marker == 0xff { 1 } else { 2 + usize::from(u16::from_be_bytes([*high, *low])) };
        rest = rest.get(n_bytes..).unwrap_or_default();
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;
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
        image::write_buffer_with_format(&mut file, rgb, width, height, image::ExtendedColorType::Rgb8, format)
            .expect("a small picture");
        file.into_inner()
    }

    fn png_of(size_px: [u32; 2], rgb: &[u8]) -> Vec<u8> {
        file_of(ImageFormat::Png, size_px, rgb)
    }

    #[test]
    fn a_jpeg_that_is_cut_off_is_refused_wherever_it_is_cut() {
        let rgb: Vec<u8> = (0..3 * 64 * 64).map(|ix: u32| (ix * ix % 251) as u8).collect();
        let whole = file_of(ImageFormat::Jpeg, [64, 64], &rgb);
        let decode = |data: &[u8]| image(PixelFormat::Jpeg, [64, 64], data).decode_rgb();
        assert_eq!(decode(&whole).expect("whole").len(), rgb.len());
        assert!(decode(&[&whole[..], b"what a camera appends"].concat()).is_ok());
        for n_bytes in [whole.len() - 2, whole.len() * 9 / 10, whole.len() / 2, 20, 3, 0] {
            let error = decode(&whole[..n_bytes]).expect_err("cut off");
            assert!(matches!(error, Error::Undecodable { .. }), "{n_bytes}: {error}");
        }
        // A thumbnail among the first segments ends, the image does not.
        let mut with_thumbnail = [&whole[..2], &[0xff, 0xe1, 0, 6, 0xff, 0xd8, 0xff, 0xd9], &whole[2..]].concat();
        assert!(decode(&with_thumbnail).is_ok());
        with_thumbnail.truncate(whole.len() - 100);
        assert!(decode(&with_thumbnail).is_err());
    }

    #[test]
    fn color_decodes_from_every_format() {
        let rgb = [10, 20, 30, 40, 50, 60];
        assert_eq!(image(PixelFormat::Rgb8, [2, 1], &rgb).decode_rgb().expect("rgb"), rgb);
        assert_eq!(image(PixelFormat::Gray8, [2, 1], &[7, 9]).decode_rgb().expect("gray"), [7, 7, 7, 9, 9, 9]);
        assert_eq!(image(PixelFormat::Png, [2, 1], &png_of([2, 1], &rgb)).decode_rgb().expect("png"), rgb);
    }

    #[test]
    fn depth_counts_become_metres_and_what_is_not_known_is_zero() {
        let depth = image(
            PixelFormat::DepthU16 { metres_per_count: 1e-4 },
            [4, 1],
            &[0, 0, 0x10, 0x27, 0xfe, 0xff, 0xff, 0xff],
        );
        assert_eq!(depth.decode_depth_m().expect("depth"), [0.0, 1.0, 6.5534, 0.0]);
    }

    #[test]
    fn broken_images_are_named() {
        let cut = image(PixelFormat::Jpeg, [2, 1], &[0xff, 0xd8, 0xff]).decode_rgb().expect_err("cut off").to_string();
        assert!(cut.contains("wrist") && cut.contains("does not decode"), "{cut}");
        let short = image(PixelFormat::Rgb8, [2, 1], &[1, 2, 3]).decode_rgb();
        assert!(matches!(short, Err(Error::ImageLength { got_bytes: 3, expected_bytes: 6, .. })));
        let other_size = image(PixelFormat::Png, [2, 2], &png_of([2, 1], &[0; 6])).decode_rgb();
        assert!(matches!(other_size, Err(Error::ImageSize { got_px: [2, 1], .. })));
        assert!(matches!(
            image(PixelFormat::Rgb8, [1, 1], &[0; 3]).decode_depth_m(),
            Err(Error::WrongKind { wanted: "depth", .. })
        ));
    }
}
