//! One posed photo of a dataset, and the decoding of its files.

use crate::Error;
use crate::decode::decode_complete;
use files::Budget;
use image::{DynamicImage, ImageReader, RgbaImage};
use kinematics::{Intrinsics, Stamp, Transform};
use std::io::{Cursor, Read};
use std::path::{Path, PathBuf};

/// One posed photo on disk.
#[derive(Clone, Debug, PartialEq)]
pub struct DatasetImage {
    /// Name in the dataset, usually the path of the image inside the folder.
    pub name: String,
    /// Lens parameters of the color image at its original size.
    pub intrinsics: Intrinsics,
    /// Pose at `stamp`.
    pub world_from_camera: Transform,
    /// Time at which the photo was taken. If the dataset has no times, images are 1 ms apart in the
    /// order of their names.
    pub stamp: Stamp,
    /// The color image.
    pub image_path: PathBuf,
    /// Its depth image, if any.
    pub depth: Option<DepthFile>,
    /// Image that is 0 at pixels that must not be used.
    pub mask_path: Option<PathBuf>,
    /// The split to which the dataset assigns the image. `None` if the dataset does not list
    /// splits.
    pub listed: Option<ListedSplit>,
}

/// The use of an image according to its dataset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ListedSplit {
    /// For training.
    Train,
    /// Images that decide hyperparameters. Scores on them are not reported.
    Validation,
    /// Gives the reported scores.
    Test,
}

/// A 16-bit depth image on disk.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthFile {
    /// The file.
    pub path: PathBuf,
    /// Meters per count. A count of 0 means that the depth is unknown.
    pub meters_per_count: f64,
    /// Pose of the depth camera when the depth image was taken.
    pub world_from_camera: Transform,
}

/// The decoded files of one image.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadedImage {
    /// `[height, width, 4]`, sRGB, still distorted. Alpha is 0 at pixels that the mask or the alpha
    /// of the photo excludes, and 255 at other pixels.
    pub rgba_srgb: Vec<u8>,
    /// Depth, still distorted.
    pub depth: Option<DepthImage>,
    /// Reason why depth is missing although the image has a depth file.
    pub depth_error: Option<String>,
    /// Reason why the mask probably excludes the wrong pixels.
    pub mask_warning: Option<String>,
}

/// Decoded depth at its own size.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthImage {
    /// Lens parameters of the photo, scaled to the size of the depth image.
    pub intrinsics: Intrinsics,
    /// `[height, width]`, meters along the camera's z axis. Unknown depths are 0.
    pub depth_m: Vec<f32>,
}

impl DatasetImage {
    /// Decodes the files of this image. If only the depth image fails to decode, the photo is still
    /// returned.
    pub fn load(&self) -> Result<LoadedImage, Error> {
        let mut rgba = into_rgba(decode_file(&self.image_path, Budget::COLOR_IMAGE)?);
        self.require_size(&self.image_path, [rgba.width(), rgba.height()])?;
        for pixel in rgba.pixels_mut() {
            // Semi-transparent pixels are used. Only fully transparent pixels were cut out on
            // purpose.
            pixel.0[3] = if pixel.0[3] == 0 { 0 } else { 255 };
        }
        let mut mask_warning = None;
        if let Some(mask_path) = &self.mask_path {
            let mask = decode_file(mask_path, Budget::COLOR_IMAGE)?;
            if is_in_alpha(&mask) {
                mask_warning = Some(format!(
                    "{mask_path:?} is all black and stores its content in the alpha channel; save it as a gray image"
                ));
            }
            let mask = mask.into_luma8();
            self.require_size(mask_path, [mask.width(), mask.height()])?;
            for (pixel, mask_pixel) in rgba.pixels_mut().zip(mask.pixels()) {
                pixel.0[3] = if mask_pixel.0[0] == 0 { 0 } else { pixel.0[3] };
            }
        }
        // Depth helps training but is not necessary, so the photo is used even if its depth image
        // is broken.
        let (depth, depth_error) = match self.depth.as_ref().map(|file| self.load_depth(file)) {
            Some(Err(error)) => (None, Some(error.to_string())),
            Some(Ok(depth)) => (Some(depth), None),
            None => (None, None),
        };
        Ok(LoadedImage {
            rgba_srgb: rgba.into_raw(),
            depth,
            depth_error,
            mask_warning,
        })
    }

    fn load_depth(&self, file: &DepthFile) -> Result<DepthImage, Error> {
        // An 8-bit depth image would be a visualization with unknown scaling.
        let DynamicImage::ImageLuma16(counts) = decode_file(&file.path, Budget::DEPTH_IMAGE)?
        else {
            return Err(Error::NotDepth {
                path: file.path.clone(),
            });
        };
        #[expect(
            clippy::cast_possible_truncation,
            reason = "f32 is more precise than sensors"
        )]
        let meters_from_count = |count: &u16| (f64::from(*count) * file.meters_per_count) as f32;
        Ok(DepthImage {
            intrinsics: self.intrinsics.resized([counts.width(), counts.height()]),
            depth_m: counts.as_raw().iter().map(meters_from_count).collect(),
        })
    }

    fn require_size(&self, path: &Path, got_px: [u32; 2]) -> Result<(), Error> {
        let expected_px = self.intrinsics.size_px;
        if got_px == expected_px {
            return Ok(());
        }
        Err(Error::DatasetImageSize {
            path: path.to_owned(),
            got_px,
            expected_px,
        })
    }
}

/// Converts an image to RGBA. An RGB image is converted in place, because a copy of 134 million
/// pixels takes half a gigabyte.
fn into_rgba(image: DynamicImage) -> RgbaImage {
    match image {
        DynamicImage::ImageRgb8(rgb) => {
            let (width, height) = rgb.dimensions();
            let mut pixels = rgb.into_raw();
            let n_px = pixels.len() / 3;
            pixels.reserve_exact(n_px);
            pixels.resize(4 * n_px, 255);
            // The loop goes from the last pixel to the first, so that no pixel is overwritten
            // before it is moved.
            for ix in (0..n_px).rev() {
                let [red, green, blue] = [0, 1, 2].map(|channel| pixels[3 * ix + channel]);
                pixels[4 * ix..4 * ix + 4].copy_from_slice(&[red, green, blue, 255]);
            }
            RgbaImage::from_raw(width, height, pixels).expect("it has four bytes per pixel")
        }
        other => other.into_rgba8(),
    }
}

/// Whether a mask is black and its transparency varies. In this case, the mask is in the alpha
/// channel.
fn is_in_alpha(mask: &DynamicImage) -> bool {
    if !mask.color().has_alpha() {
        return false;
    }
    let mask = mask.to_luma_alpha8();
    // The alpha channel of such a mask contains the mask. Interpreted as a gray image, it would
    // exclude all pixels.
    let alpha = mask.pixels().next().map(|pixel| pixel.0[1]);
    mask.pixels().all(|pixel| pixel.0[0] == 0)
        && mask.pixels().any(|pixel| Some(pixel.0[1]) != alpha)
}

/// Reads the width and height of an image from its header.
pub(super) fn image_size_px(path: &Path) -> Result<[u32; 2], Error> {
    let size = open_image(path)?
        .into_dimensions()
        .map_err(|source| decode_error(path, source))?;
    Ok(size.into())
}

fn decode_file(path: &Path, budget: Budget) -> Result<DynamicImage, Error> {
    let bytes = files::read(path, budget).map_err(|source| Error::Open {
        path: path.to_owned(),
        source,
    })?;
    // The header is checked before decoding, because a small file may declare a huge image.
    let reader = ImageReader::new(Cursor::new(&bytes)).with_guessed_format();
    let size = reader
        .map_err(image::ImageError::from)
        .and_then(ImageReader::into_dimensions);
    let got_px: [u32; 2] = size.map_err(|source| decode_error(path, source))?.into();
    if budget
        .check_elements(u64::from(got_px[0]) * u64::from(got_px[1]))
        .is_err()
    {
        return Err(Error::TooManyPixels {
            path: path.to_owned(),
            got_px,
            max_px: budget.max_elements,
        });
    }
    decode_complete(&bytes, None).map_err(|source| decode_error(path, source))
}

fn open_image(path: &Path) -> Result<ImageReader<std::io::BufReader<std::fs::File>>, Error> {
    let open =
        || ImageReader::new(std::io::BufReader::new(files::open(path)?)).with_guessed_format();
    open().map_err(|source| Error::Open {
        path: path.to_owned(),
        source,
    })
}

fn decode_error(path: &Path, source: image::ImageError) -> Error {
    // The decoder only reports an unknown format. Phones save HEIC, so its name helps.
    if let Some(format) = unsupported_format(path) {
        return Error::ImageFormat {
            path: path.to_owned(),
            format,
        };
    }
    Error::DatasetImage {
        path: path.to_owned(),
        source,
    }
}

/// Name of the format of a file, if the format is known but cannot be read.
fn unsupported_format(path: &Path) -> Option<&'static str> {
    let mut start = [0; 12];
    files::open(path).ok()?.read_exact(&mut start).ok()?;
    if start.starts_with(b"\x93NUMPY") {
        return Some("NumPy");
    }
    match (&start[4..8], &start[8..]) {
        (b"ftyp", b"avif" | b"avis") => Some("AVIF"),
        (b"ftyp", b"heic" | b"heix" | b"hevc" | b"heim" | b"heis" | b"mif1" | b"msf1") => {
            Some("HEIC")
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::RgbImage;

    #[test]
    fn conversion_in_place_gives_the_same_pixels() {
        for (width, height) in [(1, 1), (3, 2), (17, 5)] {
            let bytes = (0..3 * width * height)
                .map(|ix: u32| (ix * ix % 251) as u8)
                .collect();
            let rgb = DynamicImage::from(RgbImage::from_raw(width, height, bytes).unwrap());
            let gray = DynamicImage::from(rgb.to_luma8());
            for image in [rgb, gray] {
                let (converted, expected) = (into_rgba(image.clone()), image.to_rgba8());
                assert_eq!(
                    (converted.dimensions(), converted.as_raw()),
                    (expected.dimensions(), expected.as_raw())
                );
            }
        }
    }
}
