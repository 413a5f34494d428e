//! Depth of an image without a depth sensor, from other images with known poses.
//!
//! The image is compared with its neighbors at many inverse depths (a plane sweep: Collins, "A
//! space-sweep approach to true multi-image matching", CVPR 1996). The measure is the normalized
//! cross-correlation of small windows, averaged over several baselines (Okutomi and Kanade, "A
//! multiple-baseline stereo", PAMI 1993). Depths are kept only where one inverse depth is clearly
//! better than all others.
//!
//! The images are reduced first: the depths are where training starts, and training refines them.
#![expect(
    clippy::cast_possible_truncation,
    reason = "pixels and planes are rounded down on purpose, within ranges that are checked"
)]

use keyframe::{DepthMap, Keyframe};
use kinematics::Transform;
use nalgebra::{Matrix3, Vector3};
use numbers::{f32_of, f32s_of};
use rayon::prelude::*;
use std::sync::OnceLock;

/// Maximum width and height of the reduced images, pixels.
const MAX_SIZE_PX: u32 = 96;
/// The neighbors are chosen among this many images that are closest to the camera.
const N_NEAREST: usize = 12;
/// Maximum number of neighbors. Each costs as much time as the first one.
const N_NEIGHBORS: usize = 4;
/// Maximum angle between the optical axes of neighbors. Windows of images from very different
/// directions do not look alike.
const MAX_ANGLE_RAD: f64 = 0.45;
/// Ratio of the longest to the shortest baseline of the neighbors. The short ones reach near
/// surfaces, and the long ones are more accurate.
const MAX_BASELINE_RATIO: f64 = 3.0;
/// Shift between two inverse depths in the neighbor with the longest baseline, pixels.
const STEP_PX: f64 = 1.0;
/// Maximum shift in the neighbor with the shortest baseline, as a fraction of the image's size.
const MAX_SHIFT_FRAC: f64 = 0.33;
/// Smallest shift from which a depth is computed, in steps.
const MIN_SHIFT_STEPS: usize = 2;
/// Windows have `2 RADIUS + 1` pixels in both directions.
const RADIUS: usize = 2;
const N_WINDOW: f32 = ((2 * RADIUS + 1) * (2 * RADIUS + 1)) as f32;
/// Smallest variance of a window, of intensities from 0 to 1. Windows without texture look alike
/// everywhere.
const MIN_VARIANCE: f32 = 2e-4;
/// Smallest correlation at the best inverse depth.
const MIN_CORRELATION: f32 = 0.8;
/// By how much the best correlation must exceed those of other inverse depths. Repeated patterns
/// have several.
const MIN_MARGIN: f32 = 0.1;
/// Adjacent pixels whose inverse depths differ by less than this fraction support each other.
const SUPPORT_FRAC: f32 = 0.08;
/// Smallest number of the eight adjacent pixels that must support a depth.
const MIN_SUPPORT: usize = 4;

/// Keyframes with poses in one world. Each image is reduced at its first use.
pub(super) struct StereoImages<'a> {
    keyframes: Vec<&'a Keyframe>,
    images: Vec<OnceLock<GrayImage>>,
}

impl<'a> StereoImages<'a> {
    pub(super) fn new(keyframes: Vec<&'a Keyframe>) -> Self {
        let images = keyframes.iter().map(|_| OnceLock::new()).collect();
        Self { keyframes, images }
    }

    /// Depth of a keyframe, at a reduced resolution. `None` if no other keyframe shows the scene
    /// from a suitable place, or if no depth is certain. The keyframe itself may be among the
    /// others.
    pub(super) fn depth_of(&self, keyframe: &Keyframe) -> Option<DepthMap> {
        let reference = Reference::new(keyframe);
        let neighbors = neighbors(keyframe, &self.keyframes)
            .into_iter()
            .map(|ix| {
                let other = self.keyframes[ix];
                let image = self.images[ix].get_or_init(|| GrayImage::of(other));
                Neighbor::new(&reference.image, keyframe, other, image)
            })
            .collect::<Vec<_>>();
        sweep(&reference, &neighbors, keyframe.world_from_camera)
    }
}

/// Compares an image with its neighbors at all inverse depths.
fn sweep(
    reference: &Reference,
    neighbors: &[Neighbor<'_>],
    world_from_camera: Transform,
) -> Option<DepthMap> {
    let image = &reference.image;
    let baselines_m = || neighbors.iter().map(|neighbor| neighbor.baseline_m);
    let shortest_m = baselines_m().reduce(f64::min)?;
    let longest_m = baselines_m().reduce(f64::max)?;
    let focal_px = image.focal_px[0].max(image.focal_px[1]);
    let max_shift_px = MAX_SHIFT_FRAC * image.size().into_iter().max()? as f64;
    let step_per_m = STEP_PX / (focal_px * longest_m);
    let n_planes = (max_shift_px / (focal_px * shortest_m) / step_per_m) as usize + 1;
    let planes: Vec<Vec<f32>> = (0..n_planes)
        .into_par_iter()
        .map(|plane| correlations(reference, neighbors, plane as f64 * step_per_m))
        .collect();

    let inverse_depths: Vec<f32> = (0..image.gray.len())
        .map(|ix| best_plane(&planes, ix).map_or(0.0, |plane| plane * f32_of(step_per_m)))
        .collect();
    let supported = supported(&inverse_depths, image.width);
    let n_known = supported.iter().filter(|per_m| **per_m > 0.0).count();
    (n_known > 0).then(|| DepthMap {
        size_px: image.size().map(|n| n as u32),
        focal_px: image.focal_px,
        principal_px: image.principal_px,
        depth_m: supported
            .iter()
            .map(|per_m| if *per_m > 0.0 { 1.0 / per_m } else { 0.0 })
            .collect(),
        world_from_camera,
    })
}

/// Distance between two cameras.
fn baseline_m(a: &Keyframe, b: &Keyframe) -> f64 {
    let [a, b] = [a, b].map(|keyframe| keyframe.world_from_camera.translation.vector);
    (a - b).norm()
}

/// Indices of the keyframes that show about the same part of the scene from other places.
fn neighbors(keyframe: &Keyframe, others: &[&Keyframe]) -> Vec<usize> {
    let axis = |keyframe: &Keyframe| keyframe.world_from_camera * Vector3::z();
    let is_similar = |other: &Keyframe| axis(keyframe).angle(&axis(other)) < MAX_ANGLE_RAD;
    let mut nearest: Vec<(f64, usize)> = others
        .iter()
        .enumerate()
        .filter(|(_, other)| is_similar(other))
        .map(|(ix, other)| (baseline_m(keyframe, other), ix))
        .filter(|(baseline_m, _)| *baseline_m > 0.0)
        .collect();
    // The sort is stable, so that equal distances keep the order of arrival.
    nearest.sort_by(|a, b| a.0.total_cmp(&b.0));
    nearest.truncate(N_NEAREST);
    let longest_m = nearest.last().map_or(0.0, |(baseline_m, _)| *baseline_m);
    nearest.retain(|(baseline_m, _)| *baseline_m * MAX_BASELINE_RATIO >= longest_m);
    // Evenly distributed, and always with the longest.
    let n = nearest.len();
    let n_chosen = n.min(N_NEIGHBORS);
    (1..=n_chosen)
        .map(|number| nearest[number * n / n_chosen - 1].1)
        .collect()
}

/// A reduced image with a single channel.
struct GrayImage {
    width: usize,
    height: usize,
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    /// Intensities from 0 to 1, row by row. NaN where a pixel is masked.
    gray: Vec<f32>,
}

impl GrayImage {
    /// Reduces an image by averaging blocks of pixels. Rows and columns that fill no block are cut
    /// off.
    fn of(keyframe: &Keyframe) -> Self {
        let [full_width, full_height] = keyframe.size_px;
        let block = full_width.max(full_height).div_ceil(MAX_SIZE_PX).max(1) as usize;
        let (width, height) = (full_width as usize / block, full_height as usize / block);
        let pixel = |column: usize, row: usize| {
            let at = 4 * (row * full_width as usize + column);
            &keyframe.rgba_srgb[at..at + 4]
        };
        let mean = |ix: usize| {
            let (left, top) = (ix % width * block, ix / width * block);
            let mut sum = 0_u32;
            for row in top..top + block {
                for column in left..left + block {
                    let rgba = pixel(column, row);
                    if rgba[3] == 0 {
                        return f32::NAN;
                    }
                    sum += rgba[..3].iter().map(|value| u32::from(*value)).sum::<u32>();
                }
            }
            sum as f32 / (3 * 255 * block * block) as f32
        };
        Self {
            width,
            height,
            focal_px: keyframe.focal_px.map(|px| px / block as f64),
            principal_px: keyframe.principal_px.map(|px| px / block as f64),
            gray: (0..width * height).map(mean).collect(),
        }
    }

    fn size(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    /// Intensity at a position, in pixels from the center of the first pixel. NaN outside.
    fn at(&self, x: f32, y: f32) -> f32 {
        let is_inside =
            x >= 0.0 && y >= 0.0 && x < (self.width - 1) as f32 && y < (self.height - 1) as f32;
        if !is_inside {
            return f32::NAN;
        }
        let (column, row) = (x as usize, y as usize);
        let (right, down) = (x - column as f32, y - row as f32);
        let at = row * self.width + column;
        let mix = |at: usize| self.gray[at] * (1.0 - right) + self.gray[at + 1] * right;
        mix(at) * (1.0 - down) + mix(at + self.width) * down
    }

    /// Maps rays with `z = 1` to pixels, relative to the center of the first one.
    fn px_from_ray(&self) -> Matrix3<f64> {
        let [[fx, fy], [cx, cy]] = [self.focal_px, self.principal_px];
        Matrix3::new(fx, 0.0, cx - 0.5, 0.0, fy, cy - 0.5, 0.0, 0.0, 1.0)
    }
}

/// The image whose depth is computed, with the statistics of its windows.
struct Reference {
    image: GrayImage,
    means: Vec<f32>,
    variances: Vec<f32>,
}

impl Reference {
    fn new(keyframe: &Keyframe) -> Self {
        let image = GrayImage::of(keyframe);
        let [means, variances] = statistics(&image.gray, image.size());
        Self {
            image,
            means,
            variances,
        }
    }
}

/// Another image, and how positions in it depend on the pixel of the reference and its inverse
/// depth: `homography * (column, row, 1) + inverse_depth * epipole`, in homogeneous coordinates.
/// These are the homography of the plane at infinity and the epipole (Hartley and Zisserman,
/// "Multiple view geometry", section 13.1).
struct Neighbor<'a> {
    image: &'a GrayImage,
    baseline_m: f64,
    homography: [[f32; 3]; 3],
    epipole: [f32; 3],
}

impl<'a> Neighbor<'a> {
    /// * `reference`: the reduced image of `keyframe`.
    /// * `image`: the reduced image of `other`.
    fn new(
        reference: &GrayImage,
        keyframe: &Keyframe,
        other: &Keyframe,
        image: &'a GrayImage,
    ) -> Self {
        let other_from_camera: Transform =
            other.world_from_camera.inverse() * keyframe.world_from_camera;
        let ray_from_px = reference
            .px_from_ray()
            .try_inverse()
            .unwrap_or_else(Matrix3::identity);
        let rotation = other_from_camera.rotation.to_rotation_matrix();
        let homography = image.px_from_ray() * rotation.matrix() * ray_from_px;
        let epipole = image.px_from_ray() * other_from_camera.translation.vector;
        Self {
            image,
            baseline_m: baseline_m(keyframe, other),
            homography: [0, 1, 2]
                .map(|row| f32s_of([0, 1, 2].map(|column| homography[(row, column)]))),
            epipole: f32s_of(epipole.into()),
        }
    }

    /// The image, warped to a reference of this size whose pixels are all at an inverse depth.
    fn warped(&self, [width, height]: [usize; 2], per_m: f32) -> Vec<f32> {
        let position = |ix: usize| {
            let (column, row) = ((ix % width) as f32, (ix / width) as f32);
            let [x, y, z] = [0, 1, 2].map(|axis| {
                let [by_column, by_row, constant] = self.homography[axis];
                by_column * column + by_row * row + constant + per_m * self.epipole[axis]
            });
            if z > 0.0 {
                self.image.at(x / z, y / z)
            } else {
                f32::NAN
            }
        };
        (0..width * height).map(position).collect()
    }
}

/// Correlation of each pixel's window at an inverse depth: the mean of the better half of the
/// neighbors, because the other ones may not see the surface. NaN where no neighbor sees it.
fn correlations(reference: &Reference, neighbors: &[Neighbor<'_>], per_m: f64) -> Vec<f32> {
    let of_neighbors: Vec<Vec<f32>> = neighbors
        .iter()
        .map(|neighbor| {
            let warped = neighbor.warped(reference.image.size(), f32_of(per_m));
            correlation(reference, &warped)
        })
        .collect();
    let mean_of_better = |ix: usize| {
        let mut known: Vec<f32> = of_neighbors
            .iter()
            .map(|correlation| correlation[ix])
            .filter(|correlation| !correlation.is_nan())
            .collect();
        known.sort_by(|a, b| b.total_cmp(a));
        known.truncate(known.len().div_ceil(2));
        known.iter().sum::<f32>() / known.len() as f32
    };
    (0..reference.image.gray.len())
        .map(mean_of_better)
        .collect()
}

/// Normalized cross-correlation of the windows around each pixel, -1 to 1. NaN where a window has
/// unknown pixels, ends at the border, or has no texture.
fn correlation(reference: &Reference, other: &[f32]) -> Vec<f32> {
    let size = reference.image.size();
    let [means, variances] = statistics(other, size);
    let products = reference.image.gray.iter().zip(other);
    let products: Vec<f32> = products.map(|(a, b)| a * b).collect();
    let sums = window_sums(&products, size);
    (0..other.len())
        .map(|ix| {
            let (variance_a, variance_b) = (reference.variances[ix], variances[ix]);
            // NaN fails both comparisons.
            if variance_a > MIN_VARIANCE && variance_b > 0.25 * MIN_VARIANCE {
                let covariance = sums[ix] / N_WINDOW - reference.means[ix] * means[ix];
                covariance / (variance_a * variance_b).sqrt()
            } else {
                f32::NAN
            }
        })
        .collect()
}

/// Mean and variance of the window around each pixel. NaN where a window has unknown pixels or ends
/// at the border.
fn statistics(values: &[f32], size: [usize; 2]) -> [Vec<f32>; 2] {
    let squares: Vec<f32> = values.iter().map(|value| value * value).collect();
    let [means, mean_squares] = [values, &squares].map(|values| {
        let sums = window_sums(values, size);
        sums.iter().map(|sum| sum / N_WINDOW).collect::<Vec<f32>>()
    });
    let variances = means.iter().zip(mean_squares);
    let variances = variances
        .map(|(mean, square)| square - mean * mean)
        .collect();
    [means, variances]
}

/// Sum over the window around each pixel. NaN at the border.
fn window_sums(values: &[f32], [width, height]: [usize; 2]) -> Vec<f32> {
    let side = 2 * RADIUS + 1;
    let mut sums = vec![f32::NAN; values.len()];
    if width < side || height < side {
        return sums;
    }
    let mut rows = vec![f32::NAN; values.len()];
    for row in 0..height {
        for column in RADIUS..width - RADIUS {
            let at = row * width + column;
            rows[at] = values[at - RADIUS..=at + RADIUS].iter().sum();
        }
    }
    for row in RADIUS..height - RADIUS {
        for column in RADIUS..width - RADIUS {
            let sum = (row - RADIUS..=row + RADIUS).map(|row| rows[row * width + column]);
            sums[row * width + column] = sum.sum();
        }
    }
    sums
}

/// Number of the plane on which a pixel lies, with a fraction. `None` if no plane is clearly the
/// best, or if the pixel is too far away.
fn best_plane(planes: &[Vec<f32>], ix: usize) -> Option<f32> {
    let at = |plane: usize| planes[plane][ix];
    let better = |a: usize, b: usize| if at(b) > at(a) { b } else { a };
    let best = (0..planes.len())
        .filter(|plane| !at(*plane).is_nan())
        .reduce(better)?;
    let is_apart = |plane: &usize| plane.abs_diff(best) > 2 && !at(*plane).is_nan();
    let second = (0..planes.len()).filter(is_apart).map(at).reduce(f32::max);
    let is_clear =
        at(best) >= MIN_CORRELATION && second.is_none_or(|second| at(best) - second >= MIN_MARGIN);
    if !is_clear || best < MIN_SHIFT_STEPS || best + 1 >= planes.len() {
        return None;
    }
    // The vertex of the parabola through the best plane and its neighbors.
    let [before, here, after] = [best - 1, best, best + 1].map(at);
    let curvature = before - 2.0 * here + after;
    let offset = 0.5 * (before - after) / curvature;
    let is_peak = curvature < 0.0 && offset.abs() <= 1.0;
    is_peak.then_some(best as f32 + offset)
}

/// The inverse depths that adjacent pixels support. The others are 0.
fn supported(per_m: &[f32], width: usize) -> Vec<f32> {
    let height = per_m.len() / width;
    let n_supporters = |ix: usize| {
        let (column, row) = (ix % width, ix / width);
        let rows = row.saturating_sub(1)..(row + 2).min(height);
        let adjacent = rows.flat_map(|row| {
            let columns = column.saturating_sub(1)..(column + 2).min(width);
            columns.map(move |column| row * width + column)
        });
        adjacent
            .filter(|other| *other != ix && per_m[*other] > 0.0)
            .filter(|other| (per_m[*other] - per_m[ix]).abs() < SUPPORT_FRAC * per_m[ix])
            .count()
    };
    let kept = |ix: usize| {
        if per_m[ix] > 0.0 && n_supporters(ix) >= MIN_SUPPORT {
            per_m[ix]
        } else {
            0.0
        }
    };
    (0..per_m.len()).map(kept).collect()
}
