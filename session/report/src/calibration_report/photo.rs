//! Photos of the target with detected and predicted corners.

use super::image_map::{ImageMap, ImagePart};
use super::page;
use crate::inline_picture::{data_uri, fit_size};
use anyhow::Context;
use calibration::PointFit;
use image::DynamicImage;
use image::imageops::FilterType;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Maximum side of an embedded photo. Corners must be visible, but a report has several photos and
/// should stay small enough to send.
const MAX_SIDE_PX: u32 = 800;
/// JPEG quality. Edges of the board look clean at this quality. A higher quality mainly enlarges
/// the page.
const QUALITY: u8 = 78;

/// An image that a report can show.
#[derive(Clone, Debug, PartialEq)]
pub enum Photo {
    /// An image file.
    File(PathBuf),
    /// A gray image in memory.
    Gray {
        /// Width and height, pixels.
        size_px: [u32; 2],
        /// Gray values, row by row.
        pixels: Vec<u8>,
    },
}

/// The images, by name.
pub type Photos = BTreeMap<String, Photo>;

/// The part of a photo around the corners, with the corners drawn over it, and a caption. Without
/// corners, the whole photo is shown. The result is empty if the photo cannot be read again.
pub(super) fn with_corners(
    photos: &Photos,
    name: &str,
    caption: &str,
    points: &[PointFit],
) -> String {
    let Some(photo) = photos.get(name) else {
        return String::new();
    };
    match embedded(photo, points) {
        Ok((uri, part)) => {
            let mut map = ImageMap::of_part(part);
            map.photo(&uri);
            map.corners(points);
            page::figure(caption, &map.svg(caption))
        }
        Err(error) => {
            log::warn!("the report shows no picture of {name}: {error:#}");
            String::new()
        }
    }
}

/// A small copy of the part of an image around the corners, as a data URI. Also returns the part.
fn embedded(photo: &Photo, points: &[PointFit]) -> anyhow::Result<(String, ImagePart)> {
    let picture = match photo {
        Photo::File(file) => read(file)?,
        Photo::Gray {
            size_px: [width, height],
            pixels,
        } => {
            let gray = image::GrayImage::from_raw(*width, *height, pixels.clone());
            gray.context("the image has fewer pixels than its size")?
                .into()
        }
    };
    let part = around(points, [picture.width(), picture.height()]);
    let ImagePart {
        first_px: [x, y],
        size_px: [width, height],
    } = part;
    let picture = picture.crop_imm(x, y, width, height);
    let small_px = fit_size(part.size_px, MAX_SIDE_PX);
    let [width, height] = small_px;
    let small = if small_px == part.size_px {
        picture
    } else {
        picture.resize_exact(width, height, FilterType::Triangle)
    };
    Ok((data_uri(&small.into_rgb8(), small_px, QUALITY)?, part))
}

fn read(file: &Path) -> anyhow::Result<DynamicImage> {
    let in_file = || format!("cannot read {}", file.display());
    let opened = std::io::BufReader::new(files::open(file).with_context(in_file)?);
    let reader = image::ImageReader::new(opened)
        .with_guessed_format()
        .with_context(in_file)?;
    reader.decode().with_context(in_file)
}

/// The part of an image that contains all corners and a margin.
fn around(points: &[PointFit], size_px: [u32; 2]) -> ImagePart {
    let range = |axis: usize| {
        let pixels = points.iter().map(|point| point.pixel[axis]);
        range_with_margin(pixels, size_px[axis])
    };
    match (range(0), range(1)) {
        (Some((x, width)), Some((y, height))) => ImagePart {
            first_px: [x, y],
            size_px: [width, height],
        },
        // Without corners, or if all are outside the image, the whole image is shown.
        _ => ImagePart {
            first_px: [0, 0],
            size_px,
        },
    }
}

/// First pixel and number of pixels of a range with a margin, inside an image of `size_px`. `None`
/// if the range is empty.
fn range_with_margin(
    pixels: impl Iterator<Item = f64> + Clone,
    size_px: u32,
) -> Option<(u32, u32)> {
    const MARGIN_FRAC: f64 = 0.2;
    let low = pixels.clone().fold(f64::INFINITY, f64::min);
    let high = pixels.fold(f64::NEG_INFINITY, f64::max);
    let margin = MARGIN_FRAC * (high - low);
    let size = f64::from(size_px);
    let [low, high] =
        [(low - margin).floor(), (high + margin).ceil()].map(|at| at.clamp(0.0, size));
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "inside the image"
    )]
    (high > low + 1.0).then_some((low as u32, (high - low) as u32))
}

/// Indices of the largest and the median value. With fewer than two values, there are fewer
/// indices.
pub(super) fn worst_and_median(values: &[f64]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|a, b| values[*b].total_cmp(&values[*a]));
    let mut chosen: Vec<usize> = order.first().copied().into_iter().collect();
    chosen.extend(
        order
            .get(order.len() / 2)
            .copied()
            .filter(|ix| !chosen.contains(ix)),
    );
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn worst_and_median_are_chosen_once() {
        assert_eq!(worst_and_median(&[1.0, 5.0, 2.0]), [1, 2]);
        assert_eq!(worst_and_median(&[1.0]), [0]);
        assert!(worst_and_median(&[]).is_empty());
    }

    #[test]
    fn unreadable_photo_is_left_out() {
        let photos = Photos::from([("a.png".to_owned(), Photo::File("does-not-exist.png".into()))]);
        assert_eq!(with_corners(&photos, "a.png", "a", &[]), "");
        assert_eq!(with_corners(&photos, "b.png", "b", &[]), "");
    }

    #[test]
    fn images_in_memory_are_shown() {
        let photo = |pixels: Vec<u8>| {
            Photos::from([(
                "a".to_owned(),
                Photo::Gray {
                    size_px: [8, 6],
                    pixels,
                },
            )])
        };
        assert!(with_corners(&photo(vec![128; 48]), "a", "a", &[]).contains("data:image/jpeg"));
        assert_eq!(with_corners(&photo(vec![128; 47]), "a", "a", &[]), "");
    }

    #[test]
    fn photos_are_cropped_to_the_target() {
        let point = |x: f64, y: f64| PointFit {
            pixel: [x, y],
            residual_px: [0.0; 2],
        };
        let part = around(&[point(100.0, 50.0), point(200.0, 90.0)], [640, 96]);
        assert_eq!(
            (part.first_px, part.size_px),
            ([80, 42], [140, 54]),
            "the margin ends at the border"
        );
        assert_eq!(around(&[], [640, 480]).size_px, [640, 480]);
    }
}
