//! Photos of the target with detected and predicted corners.

use super::image_map::ImageMap;
use super::page;
use crate::error::Context;
use crate::inline_picture::{data_uri, fit_size};
use calibration::PointFit;
use image::imageops::FilterType;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Maximum side of an embedded photo.
const MAX_SIDE_PX: u32 = 800;
const QUALITY: u8 = 78;

/// Files of the images, by name.
pub type Photos = BTreeMap<String, PathBuf>;

/// A photo with corners drawn over it, and a caption. Empty if the photo cannot be read again.
pub(super) fn with_corners(photos: &Photos, name: &str, caption: &str, points: &[PointFit]) -> String {
    let Some(file) = photos.get(name) else { return String::new() };
    match embedded(file) {
        Ok((uri, size_px)) => {
            let mut map = ImageMap::new(size_px);
            map.photo(&uri);
            map.corners(points);
            page::figure(caption, &map.svg(caption))
        }
        Err(error) => {
            log::warn!("the report shows no picture of {}: {error:#}", file.display());
            String::new()
        }
    }
}

/// A small copy of an image as a data URI, and the size of the original.
fn embedded(file: &Path) -> crate::Result<(String, [u32; 2])> {
    let in_file = || format!("cannot read {}", file.display());
    let reader = image::ImageReader::open(file).with_context(in_file)?.with_guessed_format().with_context(in_file)?;
    let picture = reader.decode().with_context(in_file)?;
    let size_px = [picture.width(), picture.height()];
    let [width, height] = fit_size(size_px, MAX_SIDE_PX);
    let small =
        if [width, height] == size_px { picture } else { picture.resize_exact(width, height, FilterType::Triangle) };
    Ok((data_uri(&small.into_rgb8(), [width, height], QUALITY)?, size_px))
}

/// Indices of the largest and the median value; fewer if there are fewer values.
pub(super) fn worst_and_median(values: &[f64]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|a, b| values[*b].total_cmp(&values[*a]));
    let mut chosen: Vec<usize> = order.first().copied().into_iter().collect();
    chosen.extend(order.get(order.len() / 2).copied().filter(|ix| !chosen.contains(ix)));
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
        let photos = Photos::from([("a.png".to_owned(), PathBuf::from("does-not-exist.png"))]);
        assert_eq!(with_corners(&photos, "a.png", "a", &[]), "");
        assert_eq!(with_corners(&photos, "b.png", "b", &[]), "");
    }
}
